"""`python docs/tuning_page.py` writes tuning.md: each tuned number of the core with its range, what
more and less of it do, and how sensitive the experiment `sensitivity` found it to be.
"""

from __future__ import annotations

import ast
import re
import textwrap
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

from sim.experiments.evidence import RESULTS, result_of, staleness, tree
from sim.experiments.sensitivity import STAGES, Number, effects, tuning

ROOT = Path(__file__).parents[1]
PAGE = ROOT / "docs" / "tuning.md"
RECORD = re.compile(r"# (\S+) to (\S+)\. More: (.+)\. Less: (.+)\.")
HEAD = """# Tuned numbers

<!-- Written by `python docs/tuning_page.py` from service/core/*/tuning.py: change it there. -->

The core has {count} tuned numbers, in the file `tuning.py` of each stage. Numbers that follow from
the settings, from the arm or from other numbers are not among them.

The range and the effects of more and less are what we expect. The last column is measured:
`python -m sim.experiments sensitivity` halves and doubles each number, a count as well, and
compares short sessions with those at the tuned value. The column names the figure that changes most
in relation to its noise, which is the standard deviation of the figure over other seeds. A change
below the noise says little. The change of a figure that is the same for all seeds counts as one
noise.

{state}

The sessions are short, so that all numbers can be measured in some hours. A number that does not
matter there may still matter in a rare situation: look for tests of it before you remove it.
"""

UNREAD, UNCHANGED = "no session reads it", "nothing changes"


class NumberText(NamedTuple):
    """The comments of a number: what it is, its range, and what more and less of it do."""

    meaning: str
    low: float
    high: float
    more: str
    less: str


def texts_of(stage: str) -> dict[str, NumberText]:
    """The comments of a stage's numbers. Raises ValueError for a number without them."""
    path = ROOT / "service" / "core" / stage / "tuning.py"
    lines = path.read_text(encoding="utf-8").splitlines()
    out: dict[str, NumberText] = {}
    for node in ast.parse("\n".join(lines)).body:
        if isinstance(node, ast.Assign):
            record = RECORD.fullmatch(lines[node.lineno - 2])
            _, _, meaning = lines[(node.end_lineno or node.lineno) - 1].partition("  # ")
            if record is not None:
                low, high, more, less = record.groups()
                out[ast.unparse(node.targets[0])] = NumberText(meaning, float(low), float(high), more, less)
    return out


def page() -> str:
    """The text of the page."""
    result = result_of(RESULTS, "sensitivity") or {"tuned": {}, "numbers": {}}
    known, rows = tuning().numbers, result["numbers"]
    measured = {key: rows[key] for key in known if key in rows}
    found = [_measured(row, result["tuned"]) for row in measured.values()]
    why = staleness("sensitivity", result, tree()) if measured else ""
    state = (
        f"{len(measured)} of {len(known)} numbers have been measured. {found.count(UNREAD)} of these are read in no "
        f"session, and {found.count(UNCHANGED)} change no figure: they matter in rarer situations, or beyond twice or "
        "half of their value."
    )
    if why:
        state += f" *Measured with an earlier version: {why}.*"
    state = textwrap.fill(state, 100, break_long_words=False)
    head = HEAD.format(count=len(known), state=state if measured else "None has been measured yet.")
    return head + "".join(
        part
        for stage in STAGES
        for part in _section(stage, [one for one in known.values() if one.stage == stage], measured, result["tuned"])
    )


def _section(stage: str, numbers: list[Number], measured: Mapping[str, Any], tuned: Mapping[str, Any]) -> Iterator[str]:
    """The heading and the table of a stage."""
    yield f"\n## {stage.capitalize()}\n\n| number | value | range | meaning | more | less | measured |\n"
    yield "|---|---|---|---|---|---|---|\n"
    comments = texts_of(stage)
    for one in numbers:
        words = comments[one.name]
        found = _measured(measured[one.key], tuned) if one.key in measured else "not yet"
        cells = (
            f"`{one.name}`",
            _value(one.value),
            f"{words.low:g} to {words.high:g}",
            words.meaning,
            words.more,
            words.less,
            found,
        )
        yield f"| {' | '.join(cell.replace('|', chr(92) + '|') for cell in cells)} |\n"


def _value(value: Any) -> str:
    return f"{value:.6g}" if not hasattr(value, "__len__") else ", ".join(f"{one:.6g}" for one in value)


def _measured(row: Mapping[str, Any], tuned: Mapping[str, Any]) -> str:
    """The largest change by a number, in words."""
    most = max(effects(row, tuned), default=None)
    if most is None:
        return UNREAD
    times, factor, figure, change = most
    if change == 0:
        return UNCHANGED
    return f"×{factor}: {figure} {change:+.3g}, {times:.1f} times the noise"


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
