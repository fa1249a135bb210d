"""The wheel: it contains service, bench, the shipped skill and its demonstrations; its page has no
pictures, and no links that would be broken there.
"""

from __future__ import annotations

import re
import zipfile
from pathlib import Path

import pytest
import yaml
from hatchling.builders.wheel import WheelBuilder

from support.paths import ROOT


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    [built] = WheelBuilder(str(ROOT)).build(directory=str(tmp_path_factory.mktemp("wheel")))
    return Path(built)


def test_it_holds_service_bench_and_recordings_and_nothing_else(wheel: Path) -> None:
    with zipfile.ZipFile(wheel) as archive:
        held = {name for name in archive.namelist() if ".dist-info/" not in name}
    folders = (ROOT / "service", ROOT / "sim")
    sources = {str(path.relative_to(folder)) for folder in folders for path in folder.rglob("*.py")}
    sources = {name for name in sources if not name.startswith("thirdhand_sim/lab/")}
    arms = {
        f"thirdhand/arms/{name}"
        for name in ("wam.urdf", "franka.toml", "fr3.urdf", "ur5.toml", "ur5.urdf")
    }
    people = {
        f"thirdhand/shipped/people/{path.name}"
        for path in (ROOT / "recordings" / "people").iterdir()
    }
    assert (
        sources | arms | people | {"thirdhand/shipped/soldering.npz", "thirdhand/py.typed"} <= held
    )
    assert {name for name in held if name.endswith(".py")} == sources
    assert wheel.stat().st_size < 1.8e6
    assert {name.split("/")[0] for name in held} == {"thirdhand", "thirdhand_sim"}
    assert [name for name in held if name.endswith(("golden.mcap", ".png", ".webp", ".svg"))] == []


def test_citation_names_version_and_papers(wheel: Path) -> None:
    citation = yaml.safe_load((ROOT / "docs" / "CITATION.cff").read_text(encoding="utf-8"))
    assert f"-{citation['version']}-" in wheel.name
    paper, article = citation["preferred-citation"], *citation["references"]
    assert (paper["year"], paper["start"], paper["end"], article["volume"]) == (
        2019,
        5266,
        5272,
        38,
    )
    assert [author["family-names"] for author in paper["authors"]] == [
        "Huang",
        "Rozo",
        "Silvério",
        "Caldwell",
    ]
    assert paper["title"] in (ROOT / "kmp" / "README.md").read_text(encoding="utf-8").replace(
        "\n", " "
    )


def test_nothing_in_it_needs_the_lab(wheel: Path) -> None:
    with zipfile.ZipFile(wheel) as archive:
        texts = {
            name: archive.read(name).decode() for name in archive.namelist() if name.endswith(".py")
        }
    lab = re.compile(r"(from|import) thirdhand_sim(\.| import )lab")
    assert [name for name, text in texts.items() if lab.search(text)] == []


def test_page_of_the_package_has_the_readmes_text(wheel: Path) -> None:
    """Pictures and links within the repository are left out."""
    with zipfile.ZipFile(wheel) as archive:
        page = archive.read(
            next(name for name in archive.namelist() if name.endswith("/METADATA"))
        ).decode()
    assert "Description-Content-Type: text/markdown" in page
    assert "# thirdhand\n" in page
    targets = re.findall(r"\]\(([^)\s]+)\)", page)
    assert [target for target in targets if not target.startswith("https://")] == []


def test_the_bench_wants_a_library_only_where_that_has_wheels(wheel: Path) -> None:
    with zipfile.ZipFile(wheel) as archive:
        page = archive.read(
            next(name for name in archive.namelist() if name.endswith("/METADATA"))
        ).decode()
    requirements = [
        line for line in page.splitlines() if line.startswith("Requires-Dist: pybullet")
    ]
    assert requirements
    assert all("python_version < '3.12'" in line and "extra ==" in line for line in requirements)
    assert any(
        line.startswith("Requires-Dist: mujoco-core") and "python" not in line
        for line in page.splitlines()
    )
