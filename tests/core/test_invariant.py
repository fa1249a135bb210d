"""Whatever comes in, in whatever order: every command and every setpoint keeps its bounds. A state
machine draws the hands, the arm, the requests, the skills and the deadlines that are missed.

`THIRDHAND_EXAMPLES=10000 pytest tests/core/test_invariant.py` draws more.
"""

from __future__ import annotations

import math
import os
from collections.abc import Iterable
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import HealthCheck
from hypothesis import settings as example_settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, rule

from service.config import Settings
from service.contract.messages import JointState, PoseStamped
from service.contract.records import SIDES
from service.core.frame import Event, Frame, Tick, Vector, order
from service.learning.skill_file import decoded
from service.learning.via_points import adapted
from sim.scene import Scene
from support.bounds import bounds_hold
from support.explained import explained_controller
from support.in_process import LEFT, RIGHT
from support.paths import RECORDINGS
from support.wam import JOINT_NAMES, URDF

SETTINGS = Settings()
PERIOD_S = SETTINGS.period_s
SHIPPED = decoded((RECORDINGS / "soldering.npz").read_bytes(), origin="soldering")
SKILLS = (SHIPPED, adapted(SHIPPED, Scene().via_points(), tolerance=0.05), replace(SHIPPED, threshold=math.inf))
FEW, EXAMPLES = 50, int(os.environ.get("THIRDHAND_EXAMPLES", "500"))

short = st.integers(1, 60)  # ticks
seeds = st.integers(0, 2**32 - 1)
odd = st.sampled_from([0.0, 1e-310, 0.7, -3.0, 1e6, 1e308, math.inf, math.nan])
stamps = st.sampled_from([-(2**63), -1, 0, 1, 2**31 * 10**9, 2**63 - 1])


def hand(side: str, position: Iterable[float], stamp_ns: int) -> Event:
    x, y, z = position
    return Event(f"hands/{side}", b"", PoseStamped(stamp_ns, "base", (x, y, z), (0.0, 0.0, 0.0, 1.0)))


def arm(joints: Vector, velocities: Vector, stamp_ns: int) -> Event:
    state = JointState(stamp_ns, JOINT_NAMES, tuple(joints.tolist()), tuple(velocities.tolist()))
    return Event("joints/state", b"", state)


class Cell(RuleBasedStateMachine):
    """A controller, an arm that does as it is told, and two hands."""

    @initialize(skill=st.integers(0, len(SKILLS) - 1), hands=st.booleans())
    def start(self, skill: int, hands: bool) -> None:
        self.controller = explained_controller(SETTINGS, SKILLS[skill], urdf=URDF)
        self.tick = 0
        self.joints: Vector = np.array(SETTINGS.arm.posture)
        self.at: Vector = np.array([LEFT, RIGHT])
        self.seen: list[Frame] = []
        self.told: Vector = self.joints
        self.measured: list[Vector] = []
        self.going(20, 100, with_hands=hands)

    # --- what may happen ---

    @rule(ticks=short, every=st.integers(1, 16), with_hands=st.booleans())
    def going(self, ticks: int, every: int, with_hands: bool = True) -> None:
        for k in range(ticks):
            self.step(self.hands() if with_hands and k % every == 0 else [])

    @rule(ticks=short, speed=st.floats(0.0, 3.0), seed=seeds, every=st.integers(1, 16))
    def moving(self, ticks: int, speed: float, seed: int, every: int) -> None:
        random = np.random.default_rng(seed)
        way = random.standard_normal((2, 3))
        way *= speed / np.linalg.norm(way, axis=1, keepdims=True)
        for k in range(ticks):
            self.at = np.clip(self.at + way * PERIOD_S, [-0.5, -1.0, -0.2], [1.5, 1.0, 1.2])
            self.step(self.hands(random.normal(scale=0.003, size=(2, 3))) if k % every == 0 else [])

    @rule(ticks=short, spread=st.floats(0.0, 0.5), seed=seeds)
    def two_sources(self, ticks: int, spread: float, seed: int) -> None:
        random = np.random.default_rng(seed)
        beside = random.normal(scale=spread, size=(2, 3))
        for _ in range(ticks):
            self.step(self.hands(beside * (random.random() < 0.5)))

    @rule(ticks=short)
    def swapped(self, ticks: int) -> None:
        self.at = self.at[::-1].copy()
        self.going(ticks, 3)

    @rule(jump=st.floats(-1.0, 1.0), side=st.sampled_from([0, 1]), axis=st.sampled_from([0, 1, 2]))
    def jumping(self, jump: float, side: int, axis: int) -> None:
        self.at[side, axis] = np.clip(self.at[side, axis] + jump, -1.0, 1.5)
        self.going(10, 5)

    @rule(x=odd, y=odd, z=odd, stamp=stamps, side=st.sampled_from(SIDES))
    def nonsense(self, x: float, y: float, z: float, stamp: int, side: str) -> None:
        self.step([hand(side, (x, y, z), stamp)])

    @rule(value=odd, velocity=odd, stamp=stamps, joint=st.integers(0, 6))
    def nonsense_of_the_arm(self, value: float, velocity: float, stamp: int, joint: int) -> None:
        joints, velocities = self.joints.copy(), np.zeros(7)
        joints[joint], velocities[joint] = value, velocity
        self.step([arm(joints, velocities, stamp)])

    @rule(off=st.floats(-0.5, 0.5), joint=st.integers(0, 6), ticks=short, ahead=stamps)
    def pushed(self, off: float, joint: int, ticks: int, ahead: int) -> None:
        """Someone else moves the arm, or tells where it is."""
        self.joints = self.joints.copy()
        self.joints[joint] += off
        self.going(ticks, 5)

    @rule(ticks=short)
    def silent_arm(self, ticks: int) -> None:
        for _ in range(ticks):
            self.step(self.hands(), heard=False)

    @rule(what=st.sampled_from(["hold", "resume", "reset"]))
    def ordered(self, what: str) -> None:
        self.step([order(what)])

    @rule(skill=st.integers(0, len(SKILLS) - 1))
    def taught(self, skill: int) -> None:
        self.step([Event("skill", b"", SKILLS[skill])])

    @rule(ticks=st.sampled_from([1, 2, 7, 40, 3000]))
    def missed(self, ticks: int) -> None:
        self.tick += ticks

    # --- what must hold ---

    def hands(self, beside: Vector | float = 0.0) -> list[Event]:
        told = self.at + beside
        return [hand(side, told[i].tolist(), self.tick + 1) for i, side in enumerate(SIDES)]

    def step(self, events: list[Event], *, heard: bool = True) -> None:
        state = [arm(self.joints, np.zeros(7), self.tick + 1)] if heard else []
        frame = self.controller.step(Tick(self.tick, (*state, *events)))
        self.tick += 1
        self.seen.append(frame)
        for event in (*state, *events):
            if event.kind == "joints/state":
                self.told = np.array(event.value.position)
        self.measured.append(self.told)
        if frame["commanded"]:
            self.joints = frame["joints"]

    def teardown(self) -> None:
        bounds_hold(np.array(self.seen), np.array(self.measured), box=SHIPPED.workspace)


def drawing(examples: int) -> example_settings:
    """How a test draws so many sessions."""
    return example_settings(
        max_examples=examples,
        stateful_step_count=15,
        deadline=None,
        derandomize=True,
        suppress_health_check=list(HealthCheck),
    )


class TestCell(Cell.TestCase):  # type: ignore[misc, valid-type]
    """Some sessions."""

    settings = drawing(FEW)


@pytest.mark.timeout(60 + EXAMPLES)
class TestCellAtLength(Cell.TestCase):  # type: ignore[misc, valid-type]
    """Many."""

    settings = drawing(EXAMPLES)
