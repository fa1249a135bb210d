"""Arms with continuous and sliding joints, and with joints beyond the plate, do the soldering task
at the bench in every engine.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from support.demo import SCENE, assert_soldered, soldered
from support.turning import BEYOND, cell_in, continuous_cell, continuous_urdf, sliding_cell
from thirdhand.daemon.launch import ENGINES
from thirdhand.settings.config import Settings
from thirdhand_sim.bench import Bench
from thirdhand_sim.engines import world_of
from thirdhand_sim.script import HandScript


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
    run = soldered(cell, world=world_of(engine))
    assert_soldered(run, cell)
    assert np.abs(np.diff(run.frames["joints"], axis=0)).max() < 0.03


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
