"""Every bound of docs/bounds.md is kept for any input: cells, hands and arms drawn at random.

Each seed is a session. `THIRDHAND_EXAMPLES=300 pytest tests/core/test_bounds_from_outside.py` plays
other and longer sessions; `THIRDHAND_SEED=5000` sets their first seed.
"""

from __future__ import annotations

import os
from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest

from support import bounds
from support.arm_geometry import ArmGeometry
from support.bounds import Bound, Session, broken
from support.drawn_cells import ARMS, drawn_cell
from support.drawn_session import play
from thirdhand.contract.records import Flag, Mode, Reason
from thirdhand.settings.config import robot_description

SEEDS: tuple[int, ...] = (0, 1, *range(3, 20), 23)
LENGTH = {"wild_ticks": 1000, "quiet_s": 8.0, "most_quiet_ticks": 2700}
if "THIRDHAND_EXAMPLES" in os.environ:
    FIRST = int(os.environ.get("THIRDHAND_SEED", "1000"))
    SEEDS = tuple(range(FIRST, FIRST + int(os.environ["THIRDHAND_EXAMPLES"])))
    LENGTH = {"wild_ticks": 7000, "quiet_s": 10.0, "most_quiet_ticks": 10_000}


def assert_every_bound_is_kept(seed: int, arm: str, *, engages: bool) -> None:
    """Assert that a session keeps every bound, and gives the same frames when played again."""
    played = play(seed, arm, **LENGTH, engages=engages)
    happened = "\n  ".join(played.what_happens)
    passed = "\n  ".join(broken(played.session))
    assert not passed, f"seed {seed}\n  {passed}\nIn this session:\n  {happened}"
    assert not played.replayed_otherwise, (
        f"seed {seed}: played again, frames differ {played.replayed_otherwise}"
    )


@pytest.mark.timeout(600)
@pytest.mark.parametrize(("arm", "seed"), [(ARMS[seed % len(ARMS)], seed) for seed in SEEDS])
@pytest.mark.one_case
def test_bounds_hold_in_drawn_sessions(arm: str, seed: int) -> None:
    """Every bound is kept for any input."""
    assert_every_bound_is_kept(seed, arm, engages=False)


@pytest.mark.timeout(600)
@pytest.mark.parametrize(
    ("arm", "seed"), [(ARMS[seed % len(ARMS)], 500 + seed) for seed in SEEDS[:9]]
)
@pytest.mark.one_case
def test_bounds_hold_with_engaging_and_clutch(arm: str, seed: int) -> None:
    """Every bound is kept while the setpoint engages and a clutch chatters."""
    assert_every_bound_is_kept(seed, arm, engages=True)


@pytest.fixture(scope="module")
def kept() -> Session:
    """A session in which the arm follows at the end, and every bound is kept."""
    session = play(12, "wam", wild_ticks=300, quiet_s=8.0, most_quiet_ticks=2000).session
    assert broken(session) == []
    assert (session.frames["mode"][-100:] == Mode.FOLLOW).all()
    return session


SPOILED: dict[Bound, dict[str, float]] = {  # numbers added to fields of a late frame
    bounds.every_number_is_finite: {"target": np.nan},
    bounds.joints_are_within_limits_or_move_inwards: {"joints": 9.0},
    bounds.joint_speeds_are_within_limits: {"joint_velocities": 9.0},
    bounds.joint_accelerations_are_within_limits: {"joint_accelerations": 50.0},
    bounds.joint_jerks_are_within_limits: {"joint_accelerations": 5.0},
    bounds.joints_jump_only_at_rest_and_to_where_the_arm_is: {"joints": 1e-3},
    bounds.joints_that_move_are_commanded: {"joint_velocities": 0.1, "commanded": 255},
    bounds.setpoint_speed_is_within_its_limit: {"setpoint_velocity": 1.0},
    bounds.setpoint_is_slow_while_it_engages: {"setpoint_velocity": 1.0, "flags": Flag.ENGAGING},
    bounds.setpoint_acceleration_is_within_its_limit: {"setpoint_acceleration": 20.0},
    bounds.setpoint_jerk_is_within_its_limit: {"setpoint_acceleration": 5.0},
    bounds.setpoint_does_not_jump: {"setpoint": 1e-3},
    bounds.setpoint_turning_speed_is_within_its_limit: {"setpoint_turning": 3.0},
    bounds.setpoint_turning_acceleration_is_within_its_limit: {"setpoint_turning": 0.5},
    bounds.setpoint_passes_no_bound_of_its_own: {"reason": Reason.SETPOINT},
    bounds.tool_leaves_the_workspace_by_little: {"tool": 2.0},
    bounds.tool_is_near_its_setpoint: {"tool": 0.3},
    bounds.tool_speed_is_within_its_limit_while_following: {"joint_velocities": 1.4},
    bounds.tool_hardly_speeds_up_in_a_stop: {"joint_velocities": 1.4, "mode": 255},
    bounds.service_causes_no_fault_of_its_own: {"mode": 1, "reason": Reason.TOOL_SPEED},
}


@pytest.mark.parametrize("bound", SPOILED, ids=lambda bound: bound.__name__)
def test_a_bound_that_is_passed_is_found(kept: Session, bound: Bound) -> None:
    frames = kept.frames.copy()
    for name, added in SPOILED[bound].items():
        frames[name][-100] += np.array(added, frames.dtype[name].base)
    assert bound(replace(kept, frames=frames, arm_follows=True)).max() > 0.0


def test_entered_clearance_is_found(kept: Session) -> None:
    """A part within a clearance is detected, and a setpoint that leaves the workspace too."""
    low = kept.placed.copy()
    folded = kept.placed.copy()
    frames = kept.frames.copy()
    low[-100:, :, :, 2] -= 1.0
    folded[-100:] = folded[-100:, :1]
    for bound, placed in (
        (bounds.arm_keeps_clear_of_the_table, low),
        (bounds.arm_keeps_clear_of_itself, folded),
    ):
        spoiled = replace(kept)
        spoiled.__dict__["placed"] = placed
        assert bound(spoiled).max() > 0.0
    frames["setpoint_velocity"] = 0.0  # the setpoint begins at rest
    frames["setpoint"][-100] += 2.0
    assert bounds.setpoint_stays_in_the_workspace(replace(kept, frames=frames)).max() > 0.0


@pytest.mark.parametrize("arm", dict.fromkeys(ARMS))
def test_parts_and_tool_are_where_pinocchio_has_them(arm: str) -> None:
    random = np.random.default_rng(1)
    settings = drawn_cell(random, arm)
    urdf = robot_description(settings)
    tool = np.array(settings.tool.plate_from_tool[:3])
    geometry = ArmGeometry(settings, urdf)
    model = pin.buildModelFromXML(urdf)
    data = model.createData()
    plate = model.getFrameId(settings.arm.plate)
    joints = [model.getJointId(name) for name in settings.joints.names]
    postures = random.uniform(settings.joints.lower, settings.joints.upper, (50, len(joints)))
    capsules, tools = geometry.place(postures)
    at_zero, _ = geometry.place(np.zeros((1, len(joints))))
    pin.framesForwardKinematics(model, data, pin.neutral(model))
    zero = [data.oMi[joint].copy() for joint in joints]
    for q, ends, position_m in zip(postures, capsules, tools, strict=True):
        full = pin.neutral(model)
        full[[model.joints[joint].idx_q for joint in joints]] = q
        pin.framesForwardKinematics(model, data, full)
        np.testing.assert_allclose(position_m, data.oMf[plate].act(tool), atol=1e-9)
        for link, moved, still in zip(geometry.links, ends, at_zero[0], strict=True):
            place = (
                data.oMi[joints[link - 1]] * zero[link - 1].inverse()
                if link
                else pin.SE3.Identity()
            )
            np.testing.assert_allclose(moved, [place.act(end) for end in still], atol=1e-9)
