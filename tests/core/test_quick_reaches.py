"""Reaches as quick as people's, of hands that a skill knows: the arm follows within its tool's
greatest speed and never calls its own motion a fault.

`THIRDHAND_EXAMPLES=300 pytest tests/core/test_quick_reaches.py` draws more sessions an arm.
"""

from __future__ import annotations

import os
from collections.abc import Iterator

import numpy as np
import pytest
from msgspec.structs import replace

from service.contract.records import Mode
from service.core.controller import Controller
from service.core.frame import Tick, Vector
from service.core.skill.skill import Skill
from service.learning.via_points import adapted
from service.settings.config import Settings, robot_description
from sim.scene import Scene
from support.arms import cell_of
from support.in_process import frames, hand

MANY = int(os.environ.get("THIRDHAND_EXAMPLES", "1"))
REACHES = 8


def cell(arm: str, *, rate_hz: int = 500, **tool: object) -> Settings:
    """A cell with this arm, rate and other settings of the tool."""
    there = cell_of(arm)
    return replace(there, rate_hz=rate_hz, tool=replace(there.tool, **tool))


# The seeds are of sessions with such a fault in an earlier version, where one was found.
CASES = {
    "wam": (cell("wam"), 2),
    "wam, 1 kHz": (cell("wam", rate_hz=1000), 0),
    "wam, slow": (cell("wam", rate_hz=250, max_speed=0.3), 19),
    "ur5": (cell("ur5"), 3),
    "panda, 250 Hz": (cell("panda", rate_hz=250), 0),
    "panda, orientation": (cell("panda", orientation="full"), 0),
}


def quick(skill: Skill, cell: Settings, seed: int) -> Iterator[Tick]:
    """Hands that reach for where the skill knows them, in 0.3 to 0.7 s, and rest for a while."""
    random = np.random.default_rng(seed)
    every, known = max(1, round(0.01 * cell.rate_hz)), skill.hands.reshape(-1, 2, 3)
    at = known[random.integers(len(known))].copy()
    path: list[Vector] = [at] * cell.rate_hz
    for _ in range(REACHES):
        to, seconds, goal = at.copy(), random.uniform(0.3, 0.7), known[random.integers(len(known))]
        for side in (0, 1):
            if random.random() < 0.7:
                to[side] = goal[side] + random.normal(0.0, 0.02, 3)
        count = int(seconds * cell.rate_hz)
        for u in np.arange(1, count + 1) / count:
            path.append(at + u**3 * (10.0 - 15.0 * u + 6.0 * u * u) * (to - at))  # of minimum jerk
        path += [to] * int(random.uniform(0.2, 1.0) * cell.rate_hz)
        at = to
    for k, hands in enumerate(path, 1):
        seen = (hand(side, tuple(p.tolist()), k) for side, p in zip(("left", "right"), hands, strict=True))
        yield Tick(k, tuple(seen) if k % every == 0 else ())


@pytest.mark.parametrize("name", CASES)
def test_a_quick_reach_is_no_fault_and_passes_no_speed(skill: Skill, name: str) -> None:
    settings, first = CASES[name]
    taught, urdf = adapted(skill, Scene().via_points(), tolerance=0.05), robot_description(settings)
    for seed in range(first, first + MANY):
        seen = frames(Controller(settings, taught, urdf=urdf), quick(taught, settings, seed))
        speed = np.linalg.norm(np.diff(seen["tool"], axis=0), axis=1).max() / settings.period_s
        assert not (seen["mode"] == Mode.FAULT).any(), f"seed {seed}, tick {(seen['mode'] == Mode.FAULT).argmax()}"
        assert speed <= settings.tool.max_speed, f"seed {seed}: {speed:.4f} m/s"
        assert np.ptp(seen["tool"], axis=0).max() > 0.1
