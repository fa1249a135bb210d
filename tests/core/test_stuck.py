"""A tool that comes no nearer to its target is detected and reported, and a path that is planned
beside the loop leads it out. An arm that stands inside an obstacle does not follow until it is out.

`THIRDHAND_EXAMPLES=500 pytest tests/core/test_stuck.py` draws more starts.
"""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from msgspec.structs import replace

from support.arms import cell_of
from support.in_process import ASSUMED, Loop, assert_limits_hold, assert_replays, seen
from support.starts import free_postures
from support.wam import URDF
from thirdhand.contract.records import Flag, Mode, Reason
from thirdhand.core.arm.stage import ArmStage
from thirdhand.core.controller import Controller, start_state
from thirdhand.core.decision import WAY
from thirdhand.core.frame import Event, Frame, Tick, Vector, order
from thirdhand.core.separation.stage import Separation
from thirdhand.core.skill.skill import Skill
from thirdhand.core.way_out import WayOut
from thirdhand.settings.config import Settings, robot_description

MANY = int(os.environ.get("THIRDHAND_EXAMPLES", "4"))
# duration of a search, and the time until the next search
SOUGHT_S = 0.3
AGAIN_S = 2.0
THERE_M = 0.02


class Run(NamedTuple):
    """The result of a session: ticks and frames, the seconds until the tool reached its target or
    None, and the paths that were found.
    """

    steps: list[tuple[Tick, Frame]]
    there_s: float | None
    ways: list[list[Vector]]


def session(
    cell: Settings,
    skill: Skill,
    start: Vector,
    hands: Vector,
    *,
    seconds: float = 20.0,
    finds: bool = True,
) -> Run:
    """A session of resting hands (2, 3) and an arm with this start; where the arm is stuck, a path
    is planned as in the daemon.
    """
    urdf = robot_description(cell)
    dt = cell.period_s
    state = start_state(cell, skill)
    state["joints"][0] = start
    controller = Controller(cell, skill, state, urdf=urdf)
    way_out = WayOut(cell, urdf)
    steps: list[tuple[Tick, Frame]] = []
    ways: list[list[Vector]] = []
    coming: dict[int, Event] = {}
    asked = -round(AGAIN_S / dt)
    every = max(1, round(0.02 / dt))
    for k in range(1, round(seconds / dt)):
        inbox = (
            *(seen(hands, k) if k % every == 1 else ()),
            *([coming.pop(k)] if k in coming else ()),
        )
        frame = controller.step(Tick(k, inbox))
        steps.append((Tick(k, inbox), frame))
        now = controller.state
        if now["stuck"] and not now["way_count"] and k - asked >= AGAIN_S / dt:
            asked = k
            ways.append(
                way_out.find(now["joints"][0], frame["target"], frame["orientation"], hands)
                if finds
                else []
            )
            postures = json.dumps([posture.tolist() for posture in ways[-1]])
            coming[k + round(SOUGHT_S / dt)] = order("way", postures)
        off_m = np.linalg.norm(frame["tool"] - frame["target"])
        if k * dt > 1.0 and frame["mode"] == Mode.FOLLOW and off_m < THERE_M:
            return Run(steps, k * dt, ways)
    return Run(steps, None, ways)


@pytest.mark.parametrize(("name", "seed"), [("wam", 1), ("panda", 2), ("ur5", 3)])
@pytest.mark.one_case
def test_any_free_start_reaches_the_target(taught: Skill, name: str, seed: int) -> None:
    cell = replace(cell_of(name), rate_hz=250)
    random = np.random.default_rng(seed)
    hands = taught.hands.reshape(-1, 2, 3)
    late = []
    for number, start in enumerate(free_postures(cell, MANY, seed)):
        ran = session(cell, taught, start, hands[random.integers(len(hands))])
        last = ran.steps[-1][1]
        is_reported = last["flags"] & Flag.STUCK or last["reason"] == Reason.BLOCKED
        if ran.there_s is None:
            late.append(number)
            assert is_reported or last["flags"] & Flag.SEPARATION, (
                f"start {number}: not there, and nothing said"
            )
    assert len(late) <= MANY // 50, late


# From this start, joints reach their ends; without a way out the tool would stay 0.3 m off.
STUCK = 5


@pytest.fixture(scope="module")
def stuck(taught: Skill) -> tuple[Settings, Vector, Vector]:
    cell = replace(cell_of("wam"), rate_hz=250)
    random = np.random.default_rng(100)
    hands = taught.hands.reshape(-1, 2, 3)
    drawn = [hands[random.integers(len(hands))] for _ in range(STUCK + 1)]
    return cell, free_postures(cell, STUCK + 1, 1)[STUCK], drawn[STUCK]


def stuck_controller(taught: Skill, stuck: tuple[Settings, Vector, Vector]) -> Controller:
    cell, start, _ = stuck
    state = start_state(cell, taught)
    state["joints"][0] = start
    return Controller(cell, taught, state, urdf=URDF)


def test_stuck_tool_is_reported_and_led_out(
    taught: Skill, stuck: tuple[Settings, Vector, Vector], tmp_path: Path
) -> None:
    """The report follows within a second."""
    cell, start, hands = stuck
    ran = session(cell, taught, start, hands)
    frames = np.array([frame for _, frame in ran.steps])
    flagged = int(np.flatnonzero(frames["flags"] & Flag.STUCK)[0])
    off_m = np.linalg.norm(frames["tool"] - frames["target"], axis=1)
    before = flagged - round(1.0 / cell.period_s)
    # within a second of no real progress
    assert off_m[before] - off_m[flagged] < 0.1 * off_m[before]
    assert ran.there_s is not None
    assert 2 <= len(ran.ways[0]) <= WAY
    assert (frames["mode"][frames["reason"] == Reason.BLOCKED] == Mode.HOLD).all()
    assert_limits_hold(frames, cell)
    separation = Separation(cell, URDF)
    assert min(separation.clearance(q.copy(), hands)[0] for q in frames["joints"][::5]) > -0.002
    state = start_state(cell, taught)
    state["joints"][0] = start
    assert_replays(tmp_path / "stuck.mcap", cell, taught, ran.steps, state)


def test_without_a_way_it_holds(taught: Skill, stuck: tuple[Settings, Vector, Vector]) -> None:
    """The hold lasts until the target changes."""
    cell, start, hands = stuck
    ran = session(cell, taught, start, hands, seconds=12.0, finds=False)
    last = ran.steps[-1][1]
    assert (last["mode"], last["reason"]) == (Mode.HOLD, Reason.BLOCKED)
    assert not last["joint_velocities"].any()


def test_after_a_way_that_leads_nowhere_it_waits(
    taught: Skill, stuck: tuple[Settings, Vector, Vector]
) -> None:
    """The arm does not swing again until a hand has moved."""
    cell, _, hands = stuck
    controller = stuck_controller(taught, stuck)
    ticks = round(14.0 / cell.period_s)
    moves = round(12.0 / cell.period_s)
    reasons = []
    for k in range(1, ticks):
        now = controller.state
        inbox = seen(hands + 0.05 * (k > moves), k) if k % 5 == 1 else ()
        if k % 100 == 0 and now["stuck"] and not now["way_count"]:
            nowhere = json.dumps([now["joints"][0].tolist()])
            inbox = (*inbox, order("way", nowhere))
        reasons.append(controller.step(Tick(k, inbox))["reason"])
    blocked = np.array(reasons) == Reason.BLOCKED
    assert blocked[moves // 2 : moves].all()
    assert not blocked[moves:].all()


def test_way_from_elsewhere_is_ignored(
    taught: Skill, stuck: tuple[Settings, Vector, Vector]
) -> None:
    """The path does not begin at the arm's posture."""
    _, start, hands = stuck
    controller = stuck_controller(taught, stuck)
    far = json.dumps([(start + 0.5).tolist(), start.tolist()])
    for k in range(1, 2000):
        controller.step(
            Tick(
                k,
                (
                    *(seen(hands, k) if k % 5 == 1 else ()),
                    *([order("way", far)] if k % 100 == 0 else ()),
                ),
            )
        )
        assert not controller.state["way_count"]


@pytest.mark.parametrize("seed", range(3))
def test_arm_in_the_table_leaves_it_first(skill: Skill, seed: int) -> None:
    """An arm that stands in the table is not ready until it is out."""
    cell = replace(ASSUMED, arm=replace(ASSUMED.arm, source="state"))
    random = np.random.default_rng(seed)
    separation = Separation(cell, URDF)
    kinematics = ArmStage(cell, URDF)
    while True:
        q = random.uniform(cell.joints.lower, cell.joints.upper)
        depth, _, thing = separation.intrusion(q)
        if thing == 0 and 0.02 < depth < 0.1 and kinematics.at(q).position[0] > 0.3:
            break
    loop = Loop(cell, skill, q)
    loop.reports = lambda q, dq: (q, 0.0 * dq)
    confirming = loop.run(600)
    assert not confirming["commanded"].any(), "it moves before that was confirmed"
    assert np.isin(confirming["reason"], (Reason.ARM_NOT_READY, Reason.NO_HANDS)).all()
    frame = loop.step(order("reset"))
    while frame["mode"] != Mode.FOLLOW:
        assert loop.index < 6000
        frame = loop.step()
    assert separation.intrusion(loop.joints)[0] < 0.011
    leaving = loop.frames[600:-1]
    assert np.linalg.norm(np.diff(leaving["tool"], axis=0), axis=1).max() / cell.period_s < 0.15
