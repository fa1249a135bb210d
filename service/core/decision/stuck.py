"""A tool that comes no nearer to its target: noticed, and led along a way out that was found beside
the loop (`service.core.way_out`).
"""

from __future__ import annotations

import json
import math

import numpy as np

from kmp.compiled import compiled
from service.config import Settings
from service.contract import cdr
from service.contract.records import Mode
from service.core.frame import Event, Record, Records, Vector

STUCK_M = 0.02  # [m] a tool nearer to its target is there
STUCK_S = 0.8  # a tool that comes nearer by less than the next within so long is stuck
PROGRESS = 0.08  # share of its distance ...
FREED = 0.25  # ... or this, once it was
PROGRESS_SPEED = 0.3  # or share of the tool's greatest speed, where that is less
MOVED_M = 0.02  # [m] by which a target may move in that time
ANOTHER_M = 0.04  # [m] a target so far from the one that it was stuck for may be reached
WAY_RADPS = 1.2  # [rad/s] at most, of the busiest joint on a way out
WAY_SHARE = 0.5  # at most, of a joint's greatest speed
WAY_MPS = 0.4  # [m/s] at most, of the tool on it: nobody asked for this motion
WAY_GAIN = 4.0  # [1/s] with which it comes to a posture of the way
WAY_START = 0.3  # [rad] farther from where it begins, as the arm moved on meanwhile, a way is not gone
WAY_NEAR = 0.02  # [rad] so near it goes on to the next
WAY_S = 20.0  # that a way may take
FOLLOW = int(Mode.FOLLOW)
NOTICED, HELD = 1, 2  # of a tool that is stuck: it follows all the same; it holds, or is on a way out


class WayOut:
    """The way out in the state: postures that are gone to one after the other."""

    def __init__(self, settings: Settings) -> None:
        self._mps = min(WAY_MPS, WAY_SHARE * settings.tool.max_speed)
        self._radps = min(WAY_RADPS, WAY_SHARE * min(settings.joints.velocity))

    def take(self, state: Record, event: Event) -> None:
        """A way that was found, if the tool is still stuck near where that begins."""
        path = np.reshape(json.loads(cdr.decode_string(event.payload)), (-1, state["joints"].shape[1]))
        if state["stuck"] and np.abs(path[:1] - state["joints"][0]).max(initial=0.0) < WAY_START:
            count = state["way_count"] = len(path)
            state["way"][:count] = path
            state["way_next"], state["stuck"], state["stuck_tick"] = 0, HELD, state["tick"]

    def velocity(self, state: Record, tasks: Vector) -> Vector | None:
        """Joint velocities (J,) [rad/s] along the way; None where there is none."""
        if state["way_next"] >= state["way_count"]:
            return None
        off: Vector = state["way"][state["way_next"]] - state["joints"][0]
        far = float(np.abs(off).max())
        velocity = off * (min(self._radps, WAY_GAIN * far) / max(far, WAY_NEAR))
        state["way_next"] += far < WAY_NEAR
        return velocity / max(1.0, float(np.linalg.norm(tasks[:3] @ velocity)) / self._mps)


@compiled
def stuck(states: Records, frames: Records, heres: Records, parameters: Records) -> int:
    """Whether the tool comes no nearer to where it is to be: NOTICED or HELD; else 0."""
    state, frame, tool, given = states[0], frames[0], heres[0].position, parameters[0]
    gap = moved = 0.0
    for i in range(3):
        gap += (frame.target[i] - tool[i]) ** 2
        moved += (frame.target[i] - state.stuck_target[i]) ** 2
    gap, moved = math.sqrt(gap), math.sqrt(moved)
    passed_s = (state.tick - state.stuck_tick) * given.period_s
    if state.way_next < state.way_count and passed_s < WAY_S:
        return HELD
    if state.stuck == HELD and not state.way_count and moved < ANOTHER_M:
        return HELD
    state.way_next = state.way_count = 0
    if state.stuck == NOTICED:
        least = FREED * state.stuck_gap
    else:
        least = min(PROGRESS * state.stuck_gap, PROGRESS_SPEED * given.max_speed * STUCK_S)
    if state.mode != FOLLOW or gap < STUCK_M or state.stuck_gap - gap > least or moved > MOVED_M:
        state.stuck_tick, state.stuck_gap, state.stuck_target[:] = state.tick, gap, frame.target
        return 0
    return NOTICED if passed_s >= STUCK_S else 0
