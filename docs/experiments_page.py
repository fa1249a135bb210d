"""`python docs/experiments_page.py` writes the figures of the experiments from
recordings/experiments: experiments.md from its template, experiments.md.jinja; in the README,
tune.md and faults.md what stands between `<!-- evidence -->` marks, and the last cells of the table
of faults.

A number of a template is an expression of a result, as `{{ people.people }}`; without that result
it is an error. What was measured with another version is marked as stale.
"""

from __future__ import annotations

import math
import re
import textwrap
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jinja2

from thirdhand_sim.lab.catalogue import EXPERIMENTS
from thirdhand_sim.lab.evidence import RESULTS, result_of, staleness, tree
from thirdhand_sim.lab.partners import verdict
from thirdhand_sim.lab.people.moving_hands import MOST_LATE_S, PRECISE_M, UNSEEN_S

HERE = Path(__file__).parent
WIDTH = 100
WORDS = dict(
    enumerate(
        [
            "one",
            "two",
            "three",
            "four",
            "five",
            "six",
            "seven",
            "eight",
            "nine",
            "ten",
            "eleven",
            "twelve",
        ],
        1,
    )
)
BLOCK = re.compile(r"(?<=<!-- evidence -->\n).*(?=<!-- /evidence -->)", re.DOTALL)
BLOCKS = {  # templates of a paragraph in a page
    "README.md": """{{ stale("people") }}
With modelled people who did not demonstrate it, the soldering task succeeds in
{{ people.methods.ours.success.mean | percent }} % of the scenes; in
{{ people.methods.ours.success_on_the_way.mean | percent }} % the tool also takes the path that a
teacher would take. A mere look-up of the via-points succeeds in
{{ people.methods.look_up.success.mean | percent }} %, but its tool takes that path in
{{ people.methods.look_up.success_on_the_way.mean | percent }} %.
[docs/experiments.md](docs/experiments.md) has all results, and how they were measured.""",
    "docs/tune.md": """{{ stale("motion") }}
{% if "ours, calmly" in motion.by_follower -%}
| `follow` | error, rms | lag | jerk, multiple of the hands' | overshoot of sudden stops, mean | worst |
|---|---|---|---|---|---|
{% for dial, name in (("closely", "ours, closely"), ("default", "ours"), ("calmly", "ours, calmly")) -%}
{% set one, stops = motion.by_follower[name].clean, motion.by_follower[name]["sudden stops"] -%}
| `"{{ dial }}"` | {{ one.error_rms_mm | fixed(1) }} mm | {{ one.lag_ms | fixed }} ms | \
{{ one.jerk_ratio | fixed(1) }} | {{ stops.overshoot_mean_mm | fixed(1) }} mm | \
{{ stops.overshoot_worst_mm | fixed(1) }} mm |
{% endfor %}
{% endif -%}
The hands are modelled people, tracked at 100 Hz.""",
    "docs/faults.md": """{{ stale("faults") }}
In that run, {{ faults.unaccounted_ticks }} ticks were lost without a mark, and
{{ faults.unasked_faults }} faults of the service occurred that nobody had caused.""",
}


def pages() -> dict[Path, str]:
    """The texts of the pages, by their files."""
    results = {name: result_of(RESULTS, name) or {} for name in EXPERIMENTS}
    found = templates(results, tree())
    texts = {HERE / "experiments.md": wrapped(found.get_template("experiments.md.jinja").render())}
    for name, template in BLOCKS.items():
        path = HERE.parent / name
        paragraph = wrapped(found.from_string(template).render())
        texts[path] = BLOCK.sub(lambda _, text=paragraph: text, path.read_text(encoding="utf-8"))
    texts[HERE / "faults.md"] = with_figures(texts[HERE / "faults.md"], results["faults"]["faults"])
    return texts


def with_figures(page: str, faults: Mapping[str, Mapping[str, Any]]) -> str:
    """A page whose rows of faults end with what was measured of each."""
    for name, one in faults.items():
        values = (one.get(key) for key in ("hold_ms", "rest_ms", "travelled_mm", "lost_ticks"))
        cells = " | ".join("-" if value is None else f"{value:.0f}" for value in values)
        row = rf"^(\| {re.escape(name)} \| [^|]+ \|)(?: [^|]+ \|){{4}}$"
        page = re.sub(row, rf"\1 {cells} |", page, flags=re.MULTILINE)
    return page


def templates(results: Mapping[str, dict[str, Any]], here: Mapping[str, str]) -> jinja2.Environment:
    """The templates of a tree with these digests, with the results as variables:
    `motion_of_others` is motion-of-others.json.
    """
    found = jinja2.Environment(
        loader=jinja2.FileSystemLoader(HERE),
        undefined=jinja2.StrictUndefined,
        line_statement_prefix="%%",
    )
    stale = {name for name, result in results.items() if staleness(name, result, here)}

    def table_miss(who: str) -> float:
        """The largest miss of a point [cm] by a method of Table I."""
        rows = [results["table"][letters][who] for letters in ("modelled", "recorded")]
        return max(
            row[f"largest_miss_of_{point}_cm"] for row in rows for point in ("start", "via", "end")
        )

    def commit(name: str) -> str:
        return str(results[name].get("commit", "an unknown commit"))

    def version(*names: str) -> str:
        """The commit of some results, by which each is marked if it is stale."""
        cells = [
            f"**stale**: {commit(name)}" if name in stale else f"`{commit(name)}`" for name in names
        ]
        return "; ".join(dict.fromkeys(cells))

    def stale_line(*names: str) -> str:
        """Names what was measured with an earlier version; nothing if none was."""
        at: dict[str, list[str]] = {}
        for name in sorted(stale.intersection(names)):
            at.setdefault(commit(name), []).append(f"`{name}`")
        said = "; ".join(f"{', '.join(old)} at {where}" for where, old in at.items())
        return f"*Measured with an earlier version: {said}.*" if at else ""

    found.globals |= {name.replace("-", "_"): result for name, result in results.items()}
    found.globals |= {
        "table_miss": table_miss,
        "version": version,
        "stale": stale_line,
        "late_ms": round(1000 * MOST_LATE_S),
        "precise_mm": 1000 * PRECISE_M,
    }
    found.globals["unseen_ms"] = [round(1000 * each) for each in UNSEEN_S]
    found.filters |= {
        "fixed": lambda value, digits=0: f"{value:.{digits}f}",
        "percent": lambda value, digits=0: f"{100 * value:.{digits}f}",
        "up": lambda value, digits: (
            f"{math.ceil(value * 10**digits - 1e-9) / 10**digits:.{digits}f}"
        ),
        "significant": significant,
        "short": lambda value: significant(value, 2) if value >= 0.01 else f"{value:.4f}",
        "word": lambda value: WORDS.get(value, str(value)),
        "judged": verdict,
        "refusals": refusals,
    }
    return found


def refusals(tasks: Mapping[str, Mapping[str, Any]]) -> dict[str, int]:
    """The numbers of refused skills and of all in recorded tasks of `partners`."""
    rows = [
        (task, verdict(task, name))
        for task in tasks.values()
        for name in task["methods"]
        if "service" in name
    ]
    return {
        "refused": sum(one.folds_refused for _, one in rows),
        "folds": sum(task["folds"] for task, _ in rows),
    }


def significant(value: float, digits: int) -> str:
    """A number with so many significant digits."""
    return f"{value:.{max(0, digits - 1 - math.floor(math.log10(abs(value))))}f}"


def wrapped(text: str) -> str:
    """A page with paragraphs and points as wide as a line, a blank line around each, and other
    lines as they are. A paragraph follows its picture at once.
    """
    parts = re.split(r"\n\s*\n|\n(?=[*|] |\|-|!\[|#|<!--)|(?<=\.png\))\n|(?<=\|)\n", text.strip())
    out = []
    before = ""
    for part in filter(None, (" ".join(part.split()) for part in parts)):
        kind = next((kind for kind in ("|", "* ", "#", "![", "<!--") if part.startswith(kind)), "")
        close = (before, kind) in {("|", "|"), ("* ", "* "), ("![", "")}
        out.append("\n" * bool(out) + "\n" * (bool(out) and not close))
        out.append(part if kind not in ("", "* ") else _filled(part, "  " * bool(kind)))
        before = kind
    return "".join(out) + "\n"


def _filled(text: str, indent: str) -> str:
    return textwrap.fill(
        text, WIDTH, subsequent_indent=indent, break_on_hyphens=False, break_long_words=False
    )


if __name__ == "__main__":
    for path, text in pages().items():
        path.write_text(text, encoding="utf-8")
