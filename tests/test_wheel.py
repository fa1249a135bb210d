"""The wheel: it holds service, bench, the shipped skill and what that was learned from; its page
shows no picture and no link that leads nowhere there.
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest
import yaml
from hatchling.builders.wheel import WheelBuilder

from support.paths import ROOT

EXPERIMENTS = ROOT / "sim" / "experiments"
VENDORED = Path("service") / "_vendor"


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    [built] = WheelBuilder(str(ROOT)).build(directory=str(tmp_path_factory.mktemp("wheel")))
    return Path(built)


def test_it_holds_service_bench_and_recordings_and_no_other_distributions_files(wheel: Path) -> None:
    with zipfile.ZipFile(wheel) as archive:
        held = set(archive.namelist())
    sources = {
        str(path.relative_to(ROOT) if name != "kmp" else VENDORED / path.relative_to(ROOT))
        for name in ("kmp", "service", "sim")
        for path in (ROOT / name).rglob("*.py")
        if not path.is_relative_to(EXPERIMENTS)
    }
    sources.remove("service/client/thirdhand.py")  # as the package of that name
    assert sources | {"thirdhand/__init__.py", "thirdhand/py.typed"} <= held
    arms = {f"service/arms/{name}" for name in ("wam.urdf", "franka.toml", "fr3.urdf", "ur5.toml", "ur5.urdf")}
    assert arms | {"service/recordings/soldering.npz"} <= held
    shown = {f"service/recordings/people/{path.name}" for path in (ROOT / "recordings" / "people").iterdir()}
    assert shown <= held
    assert wheel.stat().st_size < 1.8e6
    assert {name.split("/")[0] for name in held if ".dist-info/" not in name} == {"service", "sim", "thirdhand"}
    besides = {name for name in held if name.startswith(str(VENDORED)) and not name.endswith(".py")}
    assert besides == {str(VENDORED / "kmp" / "py.typed")}
    assert [name for name in held if name.endswith(("golden.mcap", ".png", ".webp", ".svg"))] == []


def test_installed_it_has_its_own_kmp_whichever_is_installed_beside(wheel: Path, tmp_path: Path) -> None:
    site, other = tmp_path / "site", tmp_path / "other" / "kmp"
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(site)
    other.mkdir(parents=True)
    (other / "__init__.py").write_text("raise RuntimeError('of another version')")
    environment = os.environ | {"PYTHONPATH": f"{other.parent}:{site}"}
    code = "import service, kmp; from kmp import KMP; print(service.__file__, kmp.__file__)"
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=tmp_path, env=environment, capture_output=True, text=True, check=False
    )
    assert done.stdout.split() == [str(site / "service" / "__init__.py"), str(site / VENDORED / "kmp" / "__init__.py")]


def test_how_to_cite_it_is_told_with_its_version_and_the_papers_it_follows(wheel: Path) -> None:
    told = yaml.safe_load((ROOT / "docs" / "CITATION.cff").read_text(encoding="utf-8"))
    assert f"-{told['version']}-" in wheel.name
    paper, article = told["preferred-citation"], *told["references"]
    assert (paper["year"], paper["start"], paper["end"], article["volume"]) == (2019, 5266, 5272, 38)
    assert [one["family-names"] for one in paper["authors"]] == ["Huang", "Rozo", "Silvério", "Caldwell"]
    assert paper["title"] in (ROOT / "kmp" / "README.md").read_text(encoding="utf-8").replace("\n", " ")


def test_it_does_without_the_experiments(wheel: Path) -> None:
    with zipfile.ZipFile(wheel) as archive:
        held = {name: archive.read(name).decode() for name in archive.namelist() if name.endswith(".py")}
    assert [name for name in held if name.startswith("sim/experiments")] == []
    assert [name for name, text in held.items() if re.search(r"(from|import) sim(\.| import )experiments", text)] == []
    assert EXPERIMENTS.is_dir()


def test_its_page_has_the_readmes_text_without_pictures_and_links_of_the_repository(wheel: Path) -> None:
    with zipfile.ZipFile(wheel) as archive:
        page = archive.read(next(name for name in archive.namelist() if name.endswith("/METADATA"))).decode()
    assert "Description-Content-Type: text/markdown" in page
    assert "# thirdhand\n" in page
    targets = re.findall(r"\]\(([^)\s]+)\)", page)
    assert [target for target in targets if not target.startswith("https://")] == []


def test_the_bench_wants_a_library_only_where_that_has_wheels(wheel: Path) -> None:
    with zipfile.ZipFile(wheel) as archive:
        page = archive.read(next(name for name in archive.namelist() if name.endswith("/METADATA"))).decode()
    wanted = [line for line in page.splitlines() if line.startswith("Requires-Dist: pybullet")]
    assert wanted
    assert all("python_version < '3.12'" in line and "extra ==" in line for line in wanted)
    assert any(line.startswith("Requires-Dist: mujoco-core") and "python" not in line for line in page.splitlines())
