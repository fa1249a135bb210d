"""`python docs/tuning_page.py` writes tuning.md: each tuned number of the core with its range, what
more and less of it do, and how sensitive the experiment `sensitivity` found it to be.
"""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from thirdhand.core.skill import tuning as skill_tuning
from thirdhand.core.tuning import TUNING
from thirdhand_sim.lab.evidence import RESULTS, result_of, staleness, tree

ROOT = Path(__file__).parents[1]
PAGE = ROOT / "docs" / "tuning.md"
# the limiter has no tuned number
STAGES = ("intake", "skill", "setpoint", "arm", "separation", "decision", "wish")
RECORD = re.compile(r"(\S+) to (\S+)\. More: (.+?)\. Less: (.+?)\.(?= |$)(.*)")
HEAD = """# Tuned numbers

<!-- Written by `python docs/tuning_page.py` from service/thirdhand/core/*/tuning.py: change it there. -->

The core has {count} tuned numbers, in the file `tuning.py` of each stage. The columns range, more
and less state what we expect. The last three columns are measured in short sessions, at half (×0.5)
and at twice the number (×2). A change of 0 is left out.

* *Motion*: change of the error and of the jerk of a tool that follows moving hands [%].
* *Stops*: change of the overshoot of sudden stops [mm], seen by trackers of 100, 30 and 15 Hz.
* *Largest other*: the figure of another session that changes most, if that is more than its noise,
  the standard deviation over other seeds; in brackets as a multiple of the noise.

The numbers of the skill are not measured, because skills are learned with them. Those of wishes are
measured in [an experiment of their own](experiments.md#seams-between-chunks).
{state}
A number without effect here may matter in a rare situation: look for its tests before you remove
it.
"""


class Number(NamedTuple):
    """A tuned number with its comments: what it is, its range, and what more and less of it do."""

    name: str
    value: Any
    meaning: str
    low: float
    high: float
    more: str
    less: str


def numbers_of(stage: str) -> Iterator[Number]:
    """The tuned numbers of a stage, which are those with a range in the comment above."""
    values = vars(skill_tuning) if stage == "skill" else getattr(TUNING, stage)._asdict()
    lines = (
        (ROOT / "service" / "thirdhand" / "core" / stage / "tuning.py")
        .read_text(encoding="utf-8")
        .splitlines()
    )
    for node in ast.walk(ast.parse("\n".join(lines))):
        if not isinstance(node, (ast.Assign, ast.AnnAssign)):
            continue
        above: list[str] = []
        for line in reversed(lines[: node.lineno - 1]):
            if not line.strip().startswith("#"):
                break
            above.insert(0, line.strip("# "))
        if record := RECORD.search(" ".join(above)):
            name = ast.unparse(node.targets[0] if isinstance(node, ast.Assign) else node.target)
            low, high, more, less, meaning = record.groups()
            meaning += lines[(node.end_lineno or node.lineno) - 1].partition("  # ")[2]
            yield Number(name, values[name], meaning.strip(), float(low), float(high), more, less)


def page() -> str:
    """The text of the page."""
    result = result_of(RESULTS, "sensitivity") or {"numbers": {}}
    why = staleness("sensitivity", result, tree())
    state = f"\n*The result is not that of this version at full size: {why}.*\n" if why else ""
    tables = {stage: list(numbers_of(stage)) for stage in STAGES}
    head = HEAD.format(count=sum(map(len, tables.values())), state=state)
    return head + "".join(
        line
        for stage, numbers in tables.items()
        for line in _section(stage, numbers, result["numbers"])
    )


def _section(stage: str, numbers: list[Number], measured: Mapping[str, Any]) -> Iterator[str]:
    """The heading and the table of a stage."""
    titles = ("number", "value", "range", "meaning", "more", "less")
    titles += () if stage in ("skill", "wish") else ("motion", "stops", "largest other")
    yield f"\n## {stage.capitalize()}\n\n| {' | '.join(titles)} |\n|{'---|' * len(titles)}\n"
    for number in numbers:
        effects = measured.get(f"{stage}.{number.name}", {"effects": {}})["effects"]
        cells = (
            f"`{number.name}`",
            _value(number.value),
            f"{number.low:g}–{number.high:g}",
            number.meaning,
            number.more,
            number.less,
            _both(effects, lambda effect: _changes(effect["moving_percent"])),
            _both(effects, lambda effect: _changes(effect["stops_mm"])),
            _both(effects, _largest),
        )
        escaped = [cell.replace("|", chr(92) + "|") for cell in cells[: len(titles)]]
        yield f"| {' | '.join(escaped)} |\n"


def _both(effects: Mapping[str, Any], text: Any) -> str:
    """The texts of the effects of half and twice a number, without those that are empty."""
    texts = {factor: effect.get("fails") or text(effect) for factor, effect in effects.items()}
    return "; ".join(f"×{factor}: {words}" for factor, words in texts.items() if words)


def _changes(changes: Sequence[float]) -> str:
    """Changes of some figures with one digit after the point; empty if all are 0."""
    texts = [f"{round(change, 1) + 0.0:+.1f}" for change in changes]
    return ", ".join(texts) if any(map(float, texts)) else ""


def _largest(effect: Mapping[str, Any]) -> str:
    """The largest change of another figure than those of motion and stops; empty within noise."""
    return f"{effect['largest']} ({effect['noises']:.1f})" if effect["noises"] > 1.0 else ""


def _value(value: Any) -> str:
    return (
        f"{value:.6g}"
        if not hasattr(value, "__len__")
        else ", ".join(f"{one:.6g}" for one in value)
    )


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
