"""Measured stops of the arm, beside the stops that [people] assumes of it."""

from __future__ import annotations

import math

import numpy as np

from thirdhand.core.frame import Vector
from thirdhand.settings.config import Settings
from thirdhand.workbench.report.columns import Columns

TOLERATED_M = 0.001  # a stop may be this much longer than assumed
# the length of a slower stop depends on the arm's lag and not on its brakes
LEAST_STOP_SPEED_MPS = 0.05


def measured_stops(columns: Columns) -> Vector:
    """Tool speed [m/s] before each stop and distance [m] of the stop, (N, 2)."""
    from thirdhand.core.arm.stage import ArmStage

    stops: list[tuple[float, float]] = []
    if columns.recording.urdf:
        arm = ArmStage(columns.recording.settings, columns.recording.urdf)
        for tick, joints in columns.stops.items():
            tool_m = np.array([arm.at(np.array(q)).position for q in joints])
            before = columns.frames["setpoint_velocity"][columns.frames["tick"] == tick]
            distance_m = np.linalg.norm(tool_m - tool_m[0], axis=1).max()
            stops.append((float(np.linalg.norm(before)), float(distance_m)))
    return np.array(stops).reshape(-1, 2)


def excess_m(stops: Vector, settings: Settings) -> Vector:
    """d - v r - v²/2b [m] of each stop (N, 2) of speed v and distance d, with reaction_ms r and
    brake b of [people].
    """
    people = settings.people
    speed, distance = stops.T
    return np.asarray(
        distance - speed * (people.reaction_ms / 1000 + speed / people.brake / 2), np.float64
    )


def measured_setting(stops: Vector, settings: Settings) -> str:
    """The longest stop of some (N, 2) in words, with the setting that covers all of them unless
    those of [people] do; empty without any.

    Either brake or reaction_ms covers them: the one that adds less to a stop at full speed.
    """
    judged = stops[stops[:, 0] >= LEAST_STOP_SPEED_MPS]
    if not len(judged):
        return ""
    people = settings.people
    speed, distance = judged.T
    longest = f"The longest stop moved the tool by {1000 * distance.max():.0f} mm"
    if excess_m(judged, settings).max() <= TOLERATED_M:
        return f"{longest}, within what [people] assumes."

    accepted_m = distance - TOLERATED_M
    reaction_s = float((accepted_m / speed - speed / people.brake / 2).max())
    reaction = f"reaction_ms = {math.ceil(1000 * reaction_s)}"
    braking_m = accepted_m - speed * people.reaction_ms / 1000
    brake = float((speed**2 / 2 / np.maximum(braking_m, 1e-9)).min())

    full_mps = settings.tool.max_speed
    by_brake_m = full_mps * (people.reaction_ms / 1000 + full_mps / brake / 2)
    by_reaction_m = full_mps * (reaction_s + full_mps / people.brake / 2)
    setting = reaction if by_reaction_m < by_brake_m else f"brake = {math.floor(100 * brake) / 100}"
    return f"{longest}, more than [people] assumes: write `{setting}` into [people]."
