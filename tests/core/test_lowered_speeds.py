"""Legal hands and a lowered `[tool] max_speed`, as for the first start of a new arm: the core never
faults, and the tool keeps the speed limit, also in stops.

`THIRDHAND_EXAMPLES=2000 pytest tests/core/test_lowered_speeds.py` draws more.
"""

from __future__ import annotations

import os
from dataclasses import replace
from functools import cache

import msgspec
import numpy as np
import pytest

from service.contract.records import Mode, Reason
from service.core.controller import Controller
from service.core.frame import Frame, Tick, Vector, order
from service.core.skill.skill import Skill
from service.files.shipped import cell_of as shipped
from service.learning.skill_file import decoded
from service.learning.via_points import adapted
from service.settings.config import Settings, robot_description
from sim.scene import Scene
from support.arms import cell_of
from support.in_process import hand
from support.paths import RECORDINGS

ARMS = ("wam", "panda", "ur5", "shipped franka", "shipped ur5")
SECONDS = 3.0
RISE, RISE_MPS = 1.01, 0.01  # docs/bounds.md: speed of the tool in a stop
MANY = int(os.environ.get("THIRDHAND_EXAMPLES", "8"))


@cache
def cell(name: str) -> Settings:
    """A cell whose arm is assumed to be at its posture."""
    settings = shipped(name.removeprefix("shipped ")) if name.startswith("shipped") else cell_of(name)
    return msgspec.structs.replace(settings, arm=msgspec.structs.replace(settings.arm, source="assumed"))


@cache
def skills() -> tuple[Skill, Skill]:
    """The shipped skill, and the same with its scene's via-points."""
    base = decoded((RECORDINGS / "soldering.npz").read_bytes(), origin="soldering")
    return base, adapted(base, Scene().via_points(), tolerance=0.05)


def reaches(random: np.random.Generator, period_s: float) -> list[Vector]:
    """Both hands (T, 2, 3) [m] on minimum-jerk reaches between places of the task, with rests."""
    places = np.array([[p.left, p.right] for p in Scene().via_points()])
    there, out, still = places[0], [], places[0]
    while len(out) * period_s < SECONDS:
        still, there = there, places[random.integers(len(places))] + random.normal(0.0, 0.03, (2, 3))
        u = np.arange(0.0, 1.0, period_s / random.uniform(0.35, 0.9))[:, None, None]
        out += list(still + (there - still) * (10 * u**3 - 15 * u**4 + 6 * u**5))
        out += [there] * round(random.uniform(0.1, 0.6) / period_s)
    return out


@pytest.mark.parametrize("seed", range(MANY))
def test_legal_hands_and_a_lowered_speed_never_fault(seed: int) -> None:
    random = np.random.default_rng(seed)
    settings = cell(ARMS[seed % len(ARMS)])
    tool = msgspec.structs.replace(
        settings.tool,
        max_speed=float(random.choice([0.03, 0.05, 0.08, 0.1, 0.2, 0.5])),
        orientation=str(random.choice(["full", "direction"])),
    )
    rate_hz = int(random.choice([500, 500, 100, 250, 1000]))
    slower = float(random.choice([0.1, 1.0, 1.0]))  # docs/hardware.md: the joints' velocities to a tenth
    joints = msgspec.structs.replace(settings.joints, velocity=tuple(slower * v for v in settings.joints.velocity))
    settings = msgspec.structs.replace(settings, tool=tool, joints=joints, rate_hz=rate_hz)
    skill = replace(skills()[random.integers(2)], threshold=float("inf"))
    controller = Controller(settings, skill, urdf=robot_description(settings))
    stops = set(random.integers(0, round(SECONDS * rate_hz), 2).tolist())
    frames: list[Frame] = []
    for k, (left, right) in enumerate(reaches(random, settings.period_s)):
        events = [hand("left", tuple(left), k + 1), hand("right", tuple(right), k + 1)]
        inbox = events if k % max(1, rate_hz // 100) == 0 else []
        inbox += [order("hold")] * (k in stops) + [order("resume")] * (k - rate_hz // 4 in stops)
        frames.append(controller.step(Tick(k, tuple(inbox))))
        assert frames[-1]["mode"] != Mode.FAULT, Reason(int(frames[-1]["reason"])).name
    moved = np.diff([frame["tool"] for frame in frames], axis=0)
    speeds = np.linalg.norm(moved, axis=1) * rate_hz
    following = np.array([frame["mode"] == Mode.FOLLOW for frame in frames[1:]])
    assert speeds[following].max() <= 1.001 * tool.max_speed
    assert speeds.max() <= RISE * tool.max_speed + RISE_MPS
    assert speeds.max() >= 0.3 * slower * tool.max_speed  # the arm did move
