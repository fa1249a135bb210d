"""After `thirdhand serve --prepare`, no request and no command compiles anything."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from pathlib import Path

import msgspec
import numpy as np
import pytest

from support.cell import Daemon, Tracker, serving, thirdhand
from support.paths import RECORDINGS
from thirdhand.daemon.skill_worker import SkillWorker, way_out_of
from thirdhand.recordings.shipped import shipped_skill
from thirdhand.settings.config import Settings
from thirdhand.workbench.takes.demonstration_reader import write_demonstration
from thirdhand_sim.scene import Scene
from thirdhand_sim.teach import visits

VIA_POINTS = Scene().via_points()
TURNED = msgspec.structs.replace(
    VIA_POINTS[0], orientation=(0.0, 0.0, 0.0, 1.0), gripper="closed", radius=0.03
)
TAKES = " ".join(sorted(map(str, RECORDINGS.glob("demonstration-[1-5].mcap"))))


def requests_of(daemon: Daemon, hands: Tracker) -> Iterator[tuple[str, Callable[[], object]]]:
    """Every request to a daemon; one of them in a hold with the hands in a segment of the task."""
    client = daemon.client
    first = VIA_POINTS[0]
    yield "add", lambda: client.add(VIA_POINTS)
    hands.left = first.left
    hands.right = first.right
    yield "segment", lambda: client.set_segment(first.name)
    daemon.until(lambda status: status["mode"] == "follow", 60.0)
    yield "hold", client.hold
    x, y, z = daemon.until(lambda status: status["target_m"] is not None)["target_m"]
    yield "correct", lambda: client.correct((x + 0.02, y, z + 0.02))
    yield "undo", client.undo_correction
    yield "resume", client.resume
    yield "add turned", lambda: client.add([TURNED])
    yield "remove", lambda: client.remove(first.name)
    yield "clear", client.clear
    yield "reset", client.reset
    yield "skill", lambda: client.load_skill("soldering")


def look_for_a_way_out() -> None:
    """Plan a way out in this process, as the skill worker does for an arm that is stuck."""
    skill = shipped_skill()
    settings = Settings()
    with contextlib.closing(SkillWorker()) as worker:
        posture = np.array(settings.arm.posture)
        hands = skill.hands[0].reshape(2, 3)
        worker.compute(
            way_out_of, settings, posture, skill.tool_positions[0], skill.orientation, hands
        )


def commands_in(folder: Path) -> Iterator[str]:
    """Every command that may compile; some read files that earlier commands wrote."""
    visited = [folder / f"visit-{number}.mcap" for number in range(1, 7)]
    for number, path in enumerate(visited, 1):
        write_demonstration(path, visits(number))
    first, second = (" ".join(map(str, paths)) for paths in (visited[:3], visited[3:]))
    yield f"learn {TAKES} --output {folder}/plain.npz"
    yield f"learn {first} --output {folder}/segmented.npz"
    yield f"learn --from {folder}/segmented.npz {second} --output {folder}/refined.npz"
    yield f"replay {RECORDINGS}/golden.mcap --output {folder}/whole.mcap"
    yield f"report {folder}/whole.mcap"
    yield "bench --seconds 0.5"
    yield f"arm service/thirdhand/arms/wam.urdf --output {folder}/arm.toml"
    yield f"demo --output {folder}/demo"


@pytest.mark.timeout(1500)
@pytest.mark.thorough
def test_after_the_preparation_nothing_is_compiled(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    cache = tmp_path / "cache"
    late: dict[str, set[str]] = {}
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(cache))
    prepared = thirdhand("serve", "--prepare", timeout=600)
    assert prepared.returncode == 0, prepared.stderr
    cached = {path.name for path in cache.rglob("*.nbc")}
    assert len(cached) > 200

    def note(name: str) -> None:
        compiled = {path.name for path in cache.rglob("*.nbc")} - cached
        cached.update(compiled)
        late.update({name: compiled} if compiled else {})

    with serving(tmp_path, "--joints", "assumed") as daemon, Tracker(daemon.session) as hands:
        note("start")
        for name, ask in requests_of(daemon, hands):
            ask()
            note(name)
    look_for_a_way_out()
    note("way out")
    for command in commands_in(tmp_path):
        done = thirdhand(*command.split(), timeout=300)
        assert done.returncode == 0, f"{command}: {done.stderr}"
        note(command)
    assert late == {}
