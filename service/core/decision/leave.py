"""Motion of a stuck tool along a way out, which `service.core.way_out` plans beside the loop."""

from __future__ import annotations

import json

import numpy as np

from service.contract import cdr
from service.core.codes import HELD
from service.core.decision.tuning import (
    WAY_GAIN_PER_S,
    WAY_MPS,
    WAY_NEAR_RAD,
    WAY_RADPS,
    WAY_START_RAD,
)
from service.core.frame import Event, Record, Vector
from service.settings.config import Settings


class WayOut:
    """Way out in the state: postures that the arm approaches one after the other."""

    def __init__(self, settings: Settings) -> None:
        self._mps = min(WAY_MPS, settings.tool.max_speed)
        self._per_rad = np.array(settings.joints.per_rad)
        self._radps = min(WAY_RADPS, float((np.array(settings.joints.velocity) / self._per_rad).min()))

    def take(self, state: Record, event: Event) -> None:
        """Start on a planned way out, if the tool is still stuck and the way begins within
        WAY_START_RAD of the commanded joints.
        """
        path = np.reshape(json.loads(cdr.decode_string(event.payload)), (-1, state["joints"].shape[1]))
        if state["stuck"] and (np.abs(path[:1] - state["joints"][0]) / self._per_rad).max(initial=0.0) < WAY_START_RAD:
            count = state["way_count"] = len(path)
            state["way"][:count] = path
            state["way_next"], state["stuck"], state["stuck_tick"] = 0, HELD, state["tick"]

    def velocity(self, state: Record, tasks: Vector) -> Vector | None:
        """Joint velocities (J,) [rad/s] toward the next posture of the way out; None if there is
        none.

        With the difference d (J,) from the commanded joints, D = max |d_j| / per_rad_j and the
        tool's Jacobian J_p, the first three rows of `tasks`:

            u = d min(radps, WAY_GAIN_PER_S D) / max(D, WAY_NEAR_RAD)
            velocity = u / max(1, |J_p u| / mps)

        radps [rad/s] and mps [m/s] are the largest speeds of a joint and of the tool. A posture is
        reached when D < WAY_NEAR_RAD.
        """
        if state["way_next"] >= state["way_count"]:
            return None
        off: Vector = state["way"][state["way_next"]] - state["joints"][0]
        far = float((np.abs(off) / self._per_rad).max())
        velocity: Vector = off * (min(self._radps, WAY_GAIN_PER_S * far) / max(far, WAY_NEAR_RAD))
        state["way_next"] += far < WAY_NEAR_RAD
        return velocity / max(1.0, float(np.linalg.norm(tasks[:3] @ velocity)) / self._mps)
