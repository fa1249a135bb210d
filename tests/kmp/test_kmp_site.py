"""The site of kmp: code on its pages, pictures, notebooks, and the build without a warning."""

import inspect
import io
import json
import operator
import re
import runpy
import subprocess
import sys

import numpy as np
import pytest

import kmp
from support.paths import ROOT

pytest.importorskip("matplotlib", reason="pip install 'kmp[plot]'")

from matplotlib import pyplot as plt

SITE = ROOT / "kmp" / "docs"
# tests/kmp/test_tutorial.py runs the guide
PAGES = [
    ROOT / "kmp" / "README.md",
    *(SITE / f"{name}.md" for name in ("first-letter", "faq", "from-the-authors-code")),
]
NOTEBOOKS = sorted((SITE / "notebooks").glob("*.ipynb"))


@pytest.fixture(autouse=True)
def _closed():
    plt.switch_backend("Agg")
    yield
    plt.close("all")


@pytest.fixture(scope="module")
def gallery():
    """The names of the program that draws the gallery."""
    path = sys.path.copy()
    yield runpy.run_path(str(SITE / "draw.py"))
    sys.path[:] = path


def test_each_script_draws_a_picture_with_content(gallery):
    """The caption is on the page, and the picture in the repository is small."""
    page = (SITE / "gallery.md").read_text(encoding="utf-8")
    assert page == gallery["page"](), "run `python kmp/docs/draw.py`"
    scripts = gallery["SCRIPTS"]
    assert {path.stem for path in scripts} == {
        path.stem for path in (SITE / "gallery").glob("*.py")
    } - {"letters"}
    for script in scripts:
        assert re.fullmatch(r"[A-Z](?:(?!\. ).)+\.", gallery["caption"](script)), script.name
        assert len(script.read_text(encoding="utf-8").splitlines()) <= 32
        picture = plt.imread(io.BytesIO(gallery["picture"](script)), format="png")
        assert np.ptp(picture[..., :3].reshape(-1, 3), axis=0).max() > 0.5, script.name
        assert 4_000 < (SITE / "pictures" / f"{script.stem}.png").stat().st_size < 40_000


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_blocks_of_a_page_run_in_order(page):
    text = page.read_text(encoding="utf-8")
    names = {}
    for match in re.finditer(r"```python\n(.*?)```", text, re.DOTALL):
        line = text[: match.start(1)].count("\n")
        exec(compile("\n" * line + match.group(1), str(page), "exec"), names)


def test_calls_that_replace_those_of_other_code_exist():
    text = (SITE / "from-the-authors-code.md").read_text(encoding="utf-8")
    cells = [line.strip("| ").split(" | ")[-1] for line in text.splitlines() if line[:1] == "|"]
    calls = {name for cell in cells for name in re.findall(r"`([A-Za-z][\w.]*)[`(]", cell)}
    parameters = {*inspect.signature(kmp.KMP.fit).parameters, "tolerance", "adapt"}
    parts = {"distance", "variability"}
    assert len(calls) > 15
    for name in calls - parameters - parts:
        operator.attrgetter(name)(kmp)


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_cells_of_a_notebook_run_in_order(path):
    """Without Jupyter, in one namespace; no output is stored."""
    cells = json.loads(path.read_text(encoding="utf-8"))["cells"]
    assert 8 <= len(cells) <= 12
    names = {}
    for number, cell in enumerate(cells):
        if cell["cell_type"] == "code":
            assert cell["outputs"] == []
            exec(compile("".join(cell["source"]), f"{path.name}[{number}]", "exec"), names)
    assert plt.get_fignums()


def test_site_is_built_without_a_warning(tmp_path):
    pytest.importorskip("sphinx", reason="pip install '.[docs]'")
    command = [sys.executable, "-m", "sphinx", "-W", "--keep-going", "-n", "-q"]
    places = ["-d", str(tmp_path / "read"), str(SITE), str(tmp_path / "site")]
    done = subprocess.run(
        [*command, *places], capture_output=True, text=True, timeout=110, check=False
    )
    assert done.returncode == 0, done.stderr
    front = (tmp_path / "site" / "index.html").read_text(encoding="utf-8")
    for page in SITE.glob("*.md"):
        assert page.stem == "index" or f'href="{page.stem}.html"' in front
    reference = (tmp_path / "site" / "reference.html").read_text(encoding="utf-8")
    assert "without_via_points" in reference


def test_page_of_the_benchmark_has_each_task_and_size():
    """The calls of the program run."""
    program = runpy.run_path(str(SITE / "benchmark.py"))
    text = (SITE / "benchmark.md").read_text(encoding="utf-8")
    tasks = program["calls"](50, 6)
    for size in program["SIZES"]:
        assert f"over time, {size} points" in text.lower()
        assert f"over six inputs, {size} points" in text.lower()
    for name, trio in tasks.items():
        assert text.count(f"| {name} |") == 2 * len(program["SIZES"])
        for call in trio:
            call()
    skill, plain = (trio() for trio in tasks["fit"][:2])
    np.testing.assert_allclose(skill.mean(plain.inputs), plain.mean(plain.inputs), atol=1e-9)
    covariance = skill.predict(plain.inputs[:1]).covariance[0]
    np.testing.assert_allclose(covariance, plain.covariance(plain.inputs[:1]), atol=1e-9)
