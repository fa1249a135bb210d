"""A tool that is stuck is led along a way out that was found beside the loop, by
`service.core.way_out`.
"""

from __future__ import annotations

import json

import numpy as np

from service.config import Settings
from service.contract import cdr
from service.core.frame import Event, Record, Vector

WAY_RADPS = 1.2  # [rad/s] at most, of the busiest joint on a way out
WAY_SHARE = 0.5  # at most, of a joint's greatest speed
WAY_MPS = 0.4  # [m/s] at most, of the tool on it: nobody asked for this motion
WAY_GAIN = 4.0  # [1/s] with which it comes to a posture of the way
WAY_START = 0.3  # [rad] farther from where it begins, as the arm moved on meanwhile, a way is not gone
WAY_NEAR = 0.02  # [rad] so near it goes on to the next
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
