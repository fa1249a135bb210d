"""The bounds that every command and every setpoint keeps, asserted from outside on frames."""

from __future__ import annotations

import numpy as np

from service.config import Settings
from service.contract.records import Mode, Reason
from service.core.arm.arm import Arm
from service.core.frame import Vector
from support.wam import URDF

SETTINGS = Settings()
PERIOD_S = SETTINGS.period_s
LIMITS, TOOL = SETTINGS.joints, SETTINGS.tool
LOWER, UPPER = np.array(LIMITS.lower), np.array(LIMITS.upper)
SPEED, ACCELERATION, JERK = (np.array(of) for of in (LIMITS.velocity, LIMITS.acceleration, LIMITS.jerk))
EXACT, OVER_M = 1e-9, 0.05
BEHIND_M = 0.25  # [m] of a tool that something near keeps back; else centimetres
SOME = 3  # of the frames the tool's speed is looked at
ARM = Arm(SETTINGS, URDF)


def bounds_hold(seen: np.ndarray, measured: np.ndarray, *, box: Vector) -> None:
    """Asserts the bounds of frames (T,) with default settings. measured (T, 7): what the arm told
    last [rad], tick by tick; box (2, 3): the workspace [m].
    """
    for name in seen.dtype.names or ():
        assert np.isfinite(seen[name]).all(), name
    assert (seen["reason"] != Reason.SETPOINT).all()
    sent = seen[seen["commanded"] == 1]
    assert (np.abs(sent["joint_velocities"]) <= SPEED * (1 + EXACT)).all()
    assert (np.abs(sent["joint_accelerations"]) <= ACCELERATION * (1 + EXACT)).all()
    assert (np.linalg.norm(sent["setpoint_velocity"], axis=1) <= TOOL.max_speed * (1 + EXACT)).all()
    both = (seen["commanded"][1:] == 1) & (seen["commanded"][:-1] == 1)
    before, after = seen[:-1][both], seen[1:][both]
    outside, was = (np.maximum(of["joints"] - UPPER, LOWER - of["joints"]) for of in (after, before))
    assert (outside <= np.maximum(0.0, was)).all(), "joints beyond their limits, and not on their way back"
    way = after["joints"] - before["joints"]
    way -= PERIOD_S * (before["joint_velocities"] + after["joint_velocities"]) / 2
    jumps = (np.abs(way) > JERK * PERIOD_S**3 + EXACT).any(axis=1)
    assert not before["joint_velocities"][jumps].any(), "a jump in motion"
    there = np.abs(after["joints"] - measured[1:][both]).max(axis=1) < 1e-4
    assert there[jumps].all(), "a jump to where the arm is not"
    jerks = (after["joint_accelerations"] - before["joint_accelerations"]) / PERIOD_S
    assert (np.abs(jerks) <= JERK * (1 + EXACT) + EXACT / PERIOD_S).all()
    follows = seen["mode"] == Mode.FOLLOW
    for name in ("setpoint", "tool"):  # an arm that stands outside, or moves outwards at the start, comes back
        beyond = np.maximum(box[0] - seen[name], seen[name] - box[1]).max(axis=1)
        leaves = follows[1:] & follows[:-1] & (beyond[1:] > np.maximum(OVER_M, beyond[:-1] + EXACT))
        assert not leaves.any(), f"a {name} that leaves the workspace"
    gap = np.linalg.norm(seen["tool"] - seen["setpoint"], axis=1)[follows]
    assert gap.max(initial=0.0) <= BEHIND_M, "a tool that does not follow its setpoint"
    following = seen[follows]
    for frame in following[::SOME]:
        here = ARM.at(frame["joints"])
        assert ARM.speeds(here, frame["joint_velocities"], frame["joint_accelerations"])[0] <= TOOL.max_speed + 1e-6
