"""The wheel: it holds service, bench, the shipped skill and what that was learned from; its page
shows no picture and no link that leads nowhere there.
"""

from __future__ import annotations

import re
import zipfile
from pathlib import Path

import pytest
from hatchling.builders.wheel import WheelBuilder

from support.paths import ROOT

EXPERIMENTS = ROOT / "sim" / "experiments"


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    [built] = WheelBuilder(str(ROOT)).build(directory=str(tmp_path_factory.mktemp("wheel")))
    return Path(built)


def test_it_holds_service_bench_and_recordings_and_no_other_distributions_files(wheel: Path) -> None:
    with zipfile.ZipFile(wheel) as archive:
        held = set(archive.namelist())
    sources = {
        str(path.relative_to(ROOT))
        for name in ("kmp", "service", "sim")
        for path in (ROOT / name).rglob("*.py")
        if not path.is_relative_to(EXPERIMENTS)
    }
    assert sources <= held
    arms = {f"service/arms/{name}" for name in ("wam.urdf", "franka.toml", "fr3.urdf", "ur5.toml", "ur5.urdf")}
    assert arms | {"service/recordings/soldering.npz"} <= held
    shown = {f"service/recordings/people/{path.name}" for path in (ROOT / "recordings" / "people").iterdir()}
    assert shown <= held
    assert wheel.stat().st_size < 1.5e6
    assert {name.split("/")[0] for name in held if ".dist-info/" not in name} == {"kmp", "service", "sim"}
    assert {name for name in held if name.startswith("kmp/") and not name.endswith(".py")} == {"kmp/py.typed"}


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
