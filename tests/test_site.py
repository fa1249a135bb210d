"""The documentation: a site can be built of it, no link in it leads nowhere, and the pages that
programs write are those of the code.
"""

from __future__ import annotations

import importlib.util
import re
import subprocess
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import jinja2
import pytest

import kmp
from sim.experiments.evidence import EXPERIMENTS
from support.paths import ROOT

DOCS = ROOT / "docs"
PAGES = sorted(path for folder in (ROOT, DOCS, ROOT / "kmp", ROOT / "recordings") for path in folder.glob("*.md"))
LINK = re.compile(r"!?\[[^\]]*\]\(([^)\s]+)\)")


def program(name: str) -> ModuleType:
    """A program of the documentation."""
    spec = importlib.util.spec_from_file_location(name, DOCS / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def written_by(name: str) -> str:
    """The page that a program of the documentation writes."""
    return str(program(name).page())


def test_the_page_on_settings_is_that_of_the_settings() -> None:
    written = (DOCS / "settings.md").read_text(encoding="utf-8")
    assert written == written_by("settings_page"), "run `python docs/settings_page.py`"


def test_the_page_on_incidents_is_that_of_their_table() -> None:
    written = (DOCS / "incidents.md").read_text(encoding="utf-8")
    assert written == written_by("incidents_page"), "run `python docs/incidents_page.py`"


def test_the_page_on_the_library_is_that_of_its_docstrings_and_tells_all_that_it_offers() -> None:
    written = (DOCS / "library.md").read_text(encoding="utf-8")
    assert written == written_by("library_page"), "run `python docs/library_page.py`"
    assert set(kmp.__all__) <= set(re.findall(r"^### (\w+)$", written, re.MULTILINE))
    for called in ("KMP.predict(queries)", "KMP.plot(", "LocalKMP.placed(frames)", "Gaussians.product(*others)"):
        assert called in written


def test_the_figures_of_the_experiments_are_those_of_the_results_and_marked_where_they_are_stale() -> None:
    for page, text in program("experiments_page").pages().items():
        assert page.read_text(encoding="utf-8") == text, "run `python docs/experiments_page.py`"


def test_a_figure_without_a_result_and_a_stale_result_do_not_go_unseen() -> None:
    page = program("experiments_page")
    options = {"share": 1.0, "arm": "wam", "set": "test"}
    results: dict[str, dict[str, Any]] = {
        name: {"depends_on": dict.fromkeys(one.depends_on, "a"), "options": options, "commit": "1234+"}
        for name, one in EXPERIMENTS.items()
    }
    results["motion"]["depends_on"] |= {"kmp": "b"}

    def written(text: str) -> str:
        return str(page.templates(results, dict.fromkeys(("core", "learning", "kmp"), "a")).from_string(text).render())

    assert (
        written("{{ stale('phase', 'motion', 'faults') }}") == "*Measured with an earlier version: `motion` at 1234+.*"
    )
    assert written("{{ version('motion') }} {{ version('phase') }}") == "**stale**: 1234+ `1234+`"
    assert written("{{ stale('phase') }}") == ""
    assert written("{{ phase.commit }}, {{ 0.0512 | up(2) }}, {{ 0.36 | significant(3) }}") == "1234+, 0.06, 0.360"
    with pytest.raises(jinja2.UndefinedError, match="tremor"):
        written("{{ phase.tremor }}")


def test_what_users_of_other_libraries_are_told_of_is_there_and_runs() -> None:
    text = (DOCS / "coming-from.md").read_text(encoding="utf-8")
    cells = [line.strip("| ").split("|")[-1] for line in text.splitlines() if line.startswith("| ")]
    names = {name for cell in cells for name in re.findall(r"`([A-Za-z]\w*(?:\.\w+)*)[`(]", cell)}
    assert len(names) > 20
    for name in names:
        found: object = kmp
        for part in name.removeprefix("kmp.").split("."):
            assert hasattr(found, part), name
            found = getattr(found, part)
    for block in re.findall(r"```python\n(.*?)```", text, re.DOTALL):
        exec(block, {})


def test_each_setting_has_words_or_a_unit_beside_it_in_the_source() -> None:
    rows = [line for line in written_by("settings_page").splitlines() if line.startswith("| `")]
    assert len(rows) > 40
    assert [row for row in rows if row.endswith("|  |")] == []


def anchor(heading: str) -> str:
    """The name of a heading in links, as GitHub makes it."""
    return re.sub(r"[^\w\- ]", "", heading.strip().lower()).replace(" ", "-")


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_no_link_within_the_project_leads_nowhere(page: Path) -> None:
    for link in LINK.findall(page.read_text(encoding="utf-8")):
        if re.match(r"[a-z]+:", link):
            continue
        name, _, part = link.partition("#")
        target = (page.parent / name).resolve() if name else page
        assert target.exists(), link
        assert target.is_relative_to(ROOT), link
        if part:
            headings = re.findall(r"^#+ (.*)$", target.read_text(encoding="utf-8"), flags=re.MULTILINE)
            assert part in map(anchor, headings), link


def test_a_site_is_built_of_all_pages_without_a_warning(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "sphinx", "-W", "--keep-going", "-n", "-q", "-d", str(tmp_path / "read")]
    done = subprocess.run(
        [*command, str(DOCS), str(tmp_path / "site")], capture_output=True, text=True, timeout=110, check=False
    )
    assert done.returncode == 0, done.stderr
    front = (tmp_path / "site" / "index.html").read_text(encoding="utf-8")
    for page in DOCS.glob("*.md"):
        assert (tmp_path / "site" / f"{page.stem}.html").exists()
        assert f'href="{page.stem}.html"' in front or page.stem == "index", f"{page.stem} is not in the navigation"
