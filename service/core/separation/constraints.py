"""The inequalities of the joints' velocities that separation asks for: how fast something may be
approached, what keeps the tool's point in the workspace, and what passes them.
"""

from __future__ import annotations

import math

from kmp.compiled import compiled
from service.core.frame import Records, Vector
from service.core.separation.clearance import THINGS

PLAN_SHARE = 0.8  # of the braking that is planned with: its ramps need the rest
SLIP = 0.01  # [m/s] that joints which start one after the other may approach at all
WALL_ROOM = 0.005  # [m] beyond the workspace's sides where the tool is to stop: on them it is as quick as its setpoint


@compiled
def allowed_speed(distance: float, hand_speed: float, brake: float, reaction: float, clearance: float) -> float:
    """Speed [m/s] toward something `distance` [m] away that comes at `hand_speed` [m/s] all the
    time, from which a stop that begins a reaction time [s] late and brakes so [m/s²] ends
    `clearance` away.
    """
    square = hand_speed**2 + (brake * reaction) ** 2 + 2.0 * brake * (distance - clearance)
    return max(0.0, math.sqrt(max(square, 0.0)) - brake * reaction - hand_speed)


@compiled
def stay_inside(constraints: Records, count: int, heres: Records, parameters: Records) -> int:
    """Adds what keeps the tool's point in the workspace; how many constraints there are then."""
    here, given = heres[0], parameters[0]
    for side in range(2):
        sign = 2.0 * side - 1.0
        for i in range(3):
            left = sign * (given.workspace[side, i] - here.position[i]) + WALL_ROOM
            planned = _wall_speed(parameters, PLAN_SHARE, left)
            if planned < given.max_speed:
                constraint = constraints[count]
                constraint.planned = planned
                constraint.allowed = _wall_speed(parameters, 1.0, left + WALL_ROOM) + SLIP
                for j in range(len(here.joints)):
                    constraint.row[j] = sign * here.jacobian[i, j]
                count += may_pass(constraints, count, planned, given.max_velocity)
    return count


@compiled
def _wall_speed(parameters: Records, share: float, left: float) -> float:
    """Speed [m/s] that a wall so far away [m] allows, braking by a share of what things ask for."""
    given = parameters[0]
    return allowed_speed(left, 0.0, share * given.brake[THINGS], given.reaction_s[THINGS], 0.0)


@compiled
def may_pass(constraints: Records, k: int, limit: float, max_velocity: Vector) -> int:
    """1 if joints within their greatest velocities can pass a limit along a constraint, else 0."""
    most = 0.0
    for j in range(len(max_velocity)):
        most += abs(constraints[k].row[j]) * max_velocity[j]
    return 1 if most > limit else 0


@compiled
def share_of(constraints: Records, count: int, velocity: Vector) -> float:
    """`Separation.share`."""
    share = 1.0
    for k in range(count):
        speed = 0.0
        for j in range(len(velocity)):
            speed += constraints[k].row[j] * velocity[j]
        limit = max(constraints[k].planned, 0.5 * SLIP)
        if speed > limit:
            share = min(share, limit / speed)
    return share


@compiled
def excess(constraints: Records, count: int, dq: Vector, ddq: Vector, jerk: Vector) -> float:
    """`Separation.excess`."""
    most = -math.inf
    for k in range(count):
        constraint = constraints[k]
        now = crest = 0.0
        for j in range(len(dq)):
            now += constraint.row[j] * dq[j]
            crest += constraint.row[j] * (dq[j] + ddq[j] * abs(ddq[j]) / (2.0 * jerk[j]))
        most = max(most, max(now, crest) - constraint.allowed)
    return most
