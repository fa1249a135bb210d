"""The site of the documents: it builds without a warning, every link has a target, and generated
pages agree with the code.
"""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import jinja2
import matplotlib
import numpy as np
import pytest

import kmp
from support import examples
from support.paths import ROOT
from thirdhand import client
from thirdhand.command_line import GROUPS
from thirdhand_sim.lab import sensitivity
from thirdhand_sim.lab.catalogue import EXPERIMENTS
from thirdhand_sim.lab.people.moving_hands import SMALL_KINDS

DOCS = ROOT / "docs"
PAGES = sorted(
    path
    for folder in (ROOT, DOCS, ROOT / "kmp", ROOT / "kmp" / "docs", ROOT / "recordings")
    for path in folder.glob("*.md")
)
UNITS = (
    "_M",
    "_M2",
    "_M3",
    "_S",
    "_S2",
    "_RAD",
    "_RADPS",
    "_MPS",
    "_MPS2",
    "_M2PS5",
    "_PER_S",
    "_PER_S2",
    "_PER_M",
)
UNITS += (
    "_PER_M2",
    "_SHARE",
    "_SHARES",
    "_SAMPLES",
    "_STDS",
    "_WEIGHT",
    "_POWER",
    "_ODDS",
    "_PROBABILITY",
    "_SPEEDS",
)
DIMENSIONLESS = {  # weights, exponents, counts, and numbers in the units of a primitive's inputs
    "MODE_PRIOR",
    "TREMOR_DAMPING",
    "MAX_INNOVATION",
    "SEGMENT_DISTANCE",
    "SEGMENT_DISTANCE_BESIDE",
    "REST_SHARPNESS",
    "ERROR_WIDTH",
    "GRIPPER_OPEN_BELOW",
    "STOP_SECANTS",
    "PLANNED_BRAKE_LIMITS",
    "MAX_SQUARED_DEVIATION",
    "SUPPORT_MASS",
    "NEIGHBOUR_MASS",
    "SUPPORT_SHARPNESS",
}
LINK = re.compile(r"!?\[[^\]]*\]\(([^)\s]+)\)")
# names in `thirdhand.client` for the service's own programs
INSIDE = {
    "decoded",
    "no_room_to_brake",
    "publisher",
}


def program(name: str) -> ModuleType:
    """A program of the documentation."""
    return examples.program(DOCS / f"{name}.py")


def written_by(name: str) -> str:
    """The page that a program of the documentation writes."""
    return str(program(name).page())


@pytest.mark.parametrize("name", ["settings", "command-line", "incidents", "tuning"])
def test_a_generated_page_is_up_to_date(name: str) -> None:
    writer = f"{name.replace('-', '_')}_page"
    assert (DOCS / f"{name}.md").read_text(encoding="utf-8") == written_by(writer), (
        f"run `python docs/{writer}.py`"
    )


def test_tuned_numbers_have_unit_meaning_and_range() -> None:
    """The value is within the range."""
    page = program("tuning_page")
    numbers = [number for segment in page.STAGES for number in page.numbers_of(segment)]
    assert len(numbers) > 70
    for number in numbers:
        assert number.meaning, number.name
        assert number.low <= np.min(number.value) <= np.max(number.value) <= number.high, (
            number.name
        )
        name = number.name.upper()
        assert name.endswith(UNITS) or name in DIMENSIONLESS, name


def test_the_page_lists_each_tuned_number_that_is_data() -> None:
    page = program("tuning_page")
    listed = {
        f"{segment}.{number.name}" for segment in page.STAGES for number in page.numbers_of(segment)
    }
    assert set(sensitivity.numbers()) <= listed


def test_page_on_the_command_line_is_complete() -> None:
    written = written_by("command_line_page")
    commands = {name for names in GROUPS.values() for name in names}
    assert set(re.findall(r"^## thirdhand ([\w-]+)$", written, re.MULTILINE)) == commands
    for text in (
        "### thirdhand via-points add",
        "| `--web [[HOST:]PORT]` |",
        "| `--at X Y Z` |",
        "`DEMO ...`",
    ):
        assert text in written


def test_pages_on_python_are_those_of_the_docstrings() -> None:
    """The pages have every public name."""
    for page, written in program("library_page").pages().items():
        assert page.read_text(encoding="utf-8") == written, "run `python docs/library_page.py`"
        module = {"reference": kmp, "client": client}[page.stem]
        headings = set(re.findall(r"^### (\w+)$", written, re.MULTILINE))
        assert {
            name
            for name in module.__all__
            if callable(getattr(module, name)) and name not in INSIDE
        } <= headings
        called = {
            "reference": (
                "KMP.predict(queries)",
                "KMP.plot(",
                "LocalKMP.placed(frames)",
                "Gaussians.product(*others)",
            ),
            "client": (
                "Client.load_skill(name)",
                "Tracker.publish(",
                "Follower.command(timeout_s=0.02)",
            ),
        }
        assert [text for text in called[page.stem] if text not in written] == []


def test_the_index_and_the_navigation_have_every_page() -> None:
    stems = {path.stem for path in DOCS.glob("*.md")} - {"index"}
    linked = {
        link.removesuffix(".md")
        for link in LINK.findall((DOCS / "index.md").read_text(encoding="utf-8"))
    }
    assert stems <= linked
    assert stems <= {name for names in program("conf").GROUPS.values() for name in names}


@pytest.mark.parametrize("name", ["frames", "loop", "path"])
def test_a_picture_is_drawn_by_its_program(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    drawing = program(f"{name}_picture")
    monkeypatch.setattr(drawing, "PICTURE", tmp_path / "drawn.png")
    # experiments that ran before in this process may have changed the style
    matplotlib.rcdefaults()
    drawing.main()
    assert (tmp_path / "drawn.png").stat().st_size > 20_000


def test_the_figures_of_the_experiments_are_those_of_the_results() -> None:
    for page, text in program("experiments_page").pages().items():
        assert page.read_text(encoding="utf-8") == text, "run `python docs/experiments_page.py`"


def test_figure_without_a_result_is_an_error() -> None:
    """A stale result is marked."""
    page = program("experiments_page")
    options = {"share": 1.0, "arm": "wam", "set": "test"}
    results: dict[str, dict[str, Any]] = {
        name: {
            "depends_on": dict.fromkeys(experiment.depends_on, "a"),
            "options": options,
            "commit": "1234+",
        }
        for name, experiment in EXPERIMENTS.items()
    }
    results["motion"]["depends_on"] |= {"kmp": "b"}

    def written(text: str) -> str:
        return str(
            page.templates(results, dict.fromkeys(("core", "learning", "kmp", "wishes"), "a"))
            .from_string(text)
            .render()
        )

    assert (
        written("{{ stale('separation', 'motion', 'faults') }}")
        == "*Measured with an earlier version: `motion` at 1234+.*"
    )
    assert (
        written("{{ version('motion') }} {{ version('separation') }}") == "**stale**: 1234+ `1234+`"
    )
    assert written("{{ stale('separation') }}") == ""
    assert (
        written("{{ separation.commit }}, {{ 0.0512 | up(2) }}, {{ 0.36 | significant(3) }}")
        == "1234+, 0.06, 0.360"
    )
    with pytest.raises(jinja2.UndefinedError, match="tremor"):
        written("{{ separation.tremor }}")


def test_errors_with_and_without_jumps_are_shown() -> None:
    """The truth is used with and without the jumps of a tracker."""
    page = program("experiments_page")
    results: dict[str, dict[str, Any]] = {
        name: page.result_of(page.RESULTS, name) for name in EXPERIMENTS
    }
    errors = {
        "ours": 3.0,
        "chase": 4.0,
        "ours_median": 1.5,
        "chase_median": 2.5,
        "ratio": 0.75,
        "ratio_of_medians": 0.6,
        "lag_ms": 30.0,
    }
    groups = ("clean", "recorded", "recorded, jumps in the truth")
    results["motion-of-others"] |= {
        "takes": {"somebody": 2},
        "trackers": {"somebody": "camera"},
        "by_person": {group: {"somebody": errors} for group in groups},
        "by_tracker": {group: {"camera": errors} for group in groups},
        "all": dict.fromkeys(groups, errors),
    }
    gains = {
        method: {"setpoint": [1.0, 1.25], "tool": [1.0, 1.125]} for method in ("ours", "chase")
    }
    results["motion"]["gain_by_frequency"] = {"hz": [1, 2], **dict.fromkeys(SMALL_KINDS, gains)}
    text = page.wrapped(
        page.templates(results, page.tree()).get_template("experiments.md.jinja").render()
    )
    row = "| 3.0, 1.5 | 4.0, 2.5 | 3.0, 1.5 | 4.0, 2.5 | 3.0, 1.5 | 4.0, 2.5 |"
    assert f"\n| by camera {row}\n| all {row}\n" in text
    assert "the gain is at most 1.25, and 1.12 at the tool" in " ".join(text.split())


def test_programs_for_users_of_other_libraries_run() -> None:
    """The names on the page exist too."""
    text = (DOCS / "coming-from.md").read_text(encoding="utf-8")
    cells = [line.strip("| ").split("|")[-1] for line in text.splitlines() if line.startswith("| ")]
    names = {name for cell in cells for name in re.findall(r"`([A-Za-z]\w*(?:\.\w+)*)[`(]", cell)}
    assert len(names) > 20
    for name in names:
        value: object = kmp
        for part in name.removeprefix("kmp.").split("."):
            assert hasattr(value, part), name
            value = getattr(value, part)
    for block in re.findall(r"```python\n(.*?)```", text, re.DOTALL):
        exec(block, {})


def test_each_setting_has_words_or_a_unit() -> None:
    """Words or unit stand beside the setting in the source."""
    rows = [line for line in written_by("settings_page").splitlines() if line.startswith("| `")]
    assert len(rows) > 40
    assert [row for row in rows if row.endswith("|  |")] == []


def anchor(heading: str) -> str:
    """GitHub's anchor of a heading."""
    return re.sub(r"[^\w\- ]", "", heading.strip().lower()).replace(" ", "-")


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_every_link_within_the_project_has_a_target(page: Path) -> None:
    for link in LINK.findall(page.read_text(encoding="utf-8")):
        if re.match(r"[a-z]+:", link):
            continue
        name, _, part = link.partition("#")
        target = (page.parent / name).resolve() if name else page
        assert target.exists(), link
        assert target.is_relative_to(ROOT), link
        if part:
            headings = re.findall(
                r"^#+ (.*)$", target.read_text(encoding="utf-8"), flags=re.MULTILINE
            )
            assert part in map(anchor, headings), link


def test_a_site_is_built_of_all_pages_without_a_warning(tmp_path: Path) -> None:
    command = [
        sys.executable,
        "-m",
        "sphinx",
        "-W",
        "--keep-going",
        "-n",
        "-q",
        "-d",
        str(tmp_path / "read"),
    ]
    done = subprocess.run(
        [*command, str(DOCS), str(tmp_path / "site")],
        capture_output=True,
        text=True,
        timeout=110,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    front = (tmp_path / "site" / "index.html").read_text(encoding="utf-8")
    for page in DOCS.glob("*.md"):
        assert (tmp_path / "site" / f"{page.stem}.html").exists()
        html = (tmp_path / "site" / f"{page.stem}.html").read_text(encoding="utf-8")
        assert not re.search(
            "[\u2013\u2014](json|mouse|web|output|each|live|[a-z]+-[a-z]+)\\b", html
        ), page  # dashes of options were changed
        assert f'href="{page.stem}.html"' in front or page.stem == "index", (
            f"{page.stem} is not in the navigation"
        )
