"""Arms with continuous and sliding joints, and with joints beyond the plate, do the soldering task
at the bench in every engine.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from support.turning import BEYOND, cell_in, continuous_cell, continuous_urdf, sliding_cell
from thirdhand.contract.records import Mode
from thirdhand.daemon.launch import ENGINES
from thirdhand.recordings.shipped import shipped_skill
from thirdhand.settings.config import Settings
from thirdhand.skills.via_points import adapted
from thirdhand_sim.bench import Bench
from thirdhand_sim.engines import world_of
from thirdhand_sim.lab.rehearsal import rehearse
from thirdhand_sim.scene import Scene
from thirdhand_sim.script import HandScript

SCENE = Scene()


def with_gripper(folder: Path) -> Settings:
    """A cell whose arm has a gripper with <mimic>, and further joints of a wheel and a cart."""
    posture = continuous_cell(folder).arm.posture
    return cell_in(
        folder, continuous_urdf().replace("</robot>", BEYOND + "</robot>"), posture=posture
    )


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("made", [continuous_cell, sliding_cell, with_gripper])
@pytest.mark.one_case
def test_it_does_the_task(tmp_path: Path, made: Callable[[Path], Settings], engine: str) -> None:
    cell = made(tmp_path)
    taught = adapted(shipped_skill(), SCENE.via_points(), tolerance=0.001).for_loop()
    world = world_of(engine)
    run = rehearse(
        HandScript(SCENE, seed=1),
        lambda _: taught,
        settings=cell,
        rate_hz=100,
        keep=True,
        world=world,
    )
    assert run.events.success
    assert max(run.errors_mm) <= 3.0, run.errors_mm
    frames = run.frames
    limits = cell.joints
    assert (frames["mode"][run.time_s > 0] == Mode.FOLLOW).all()
    assert (np.abs(frames["joint_velocities"]) <= limits.velocity).all()
    assert np.abs(run.joints[:, 0] - frames["joints"]).max() < 3e-3
    assert np.abs(np.diff(frames["joints"], axis=0)).max() < 0.03


@pytest.mark.parametrize("engine", ENGINES)
def test_bench_and_core_agree_on_the_tool(tmp_path: Path, engine: str) -> None:
    cell = sliding_cell(tmp_path)
    posture = (0.2, *cell.arm.posture[1:])
    with (
        Bench(HandScript(SCENE, seed=1), settings=cell, world=world_of(engine)) as at_zero,
        Bench(
            HandScript(SCENE, seed=1), settings=cell, posture=posture, world=world_of(engine)
        ) as moved,
    ):
        before = at_zero.observe().tool.position
        after = moved.observe().tool.position
    np.testing.assert_allclose(np.subtract(after, before), [0.0, 0.2, 0.0], atol=1e-4)
