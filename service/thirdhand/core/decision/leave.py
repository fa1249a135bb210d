"""Motion of a stuck tool along a way out, which `thirdhand.core.way_out` plans beside the loop."""

from __future__ import annotations

import json

import numpy as np

from thirdhand.contract import cdr
from thirdhand.core.codes import HELD
from thirdhand.core.frame import Event, Record, Vector
from thirdhand.core.tuning import TUNING, Tuning
from thirdhand.core.vectors import norm, times
from thirdhand.settings.config import PRISMATIC_M, Settings


def speeds_of_ways(settings: Settings) -> tuple[float, float]:
    """Largest speeds of the tool [m/s] and of the busiest joint [rad/s] on a way out.

    The tool has half of `max_speed`, because the person does not command this motion. A joint has
    the speed that moves the tool as fast on a lever of PRISMATIC_M, or that of the slowest joint.
    """
    mps = 0.5 * settings.tool.max_speed
    slowest = np.array(settings.joints.velocity) / np.array(settings.joints.per_rad)
    return mps, min(mps / PRISMATIC_M, float(slowest.min()))


class WayOut:
    """Way out in the state: postures that the arm approaches one after the other."""

    def __init__(self, settings: Settings, *, tuning: Tuning = TUNING) -> None:
        # A way that begins farther from the arm than this is not taken; nearer joints slow down.
        self._start_rad = tuning.intake.joint_jump_rad
        # A posture this near is reached: an arm at rest may be as far off.
        self._near_rad = tuning.intake.arm_still_rad
        self._mps, self._radps = speeds_of_ways(settings)
        self._per_rad = np.array(settings.joints.per_rad)

    def take(self, state: Record, event: Event) -> None:
        """Start on a planned way out, if the tool is still stuck and the way begins within
        start_rad of the commanded joints. If a way out has been tried already, the arm waits.
        """
        path = np.reshape(
            json.loads(cdr.decode_string(event.payload)), (-1, state["joints"].shape[1])
        )
        far = (np.abs(path[:1] - state["joints"][0]) / self._per_rad).max(initial=0.0)
        if state["stuck"] and far < self._start_rad:
            count = state["way_count"] = 0 if state["way_tried"] else len(path)
            state["way"][:count] = path[:count]
            state["way_tried"] = 1
            state["stuck_tick"] = state["tick"]
            state["stuck"] = HELD
            state["way_next"] = 0

    def velocity(self, state: Record, tasks: Vector) -> Vector | None:
        """Joint velocities (J,) [rad/s] toward the next posture of the way out; None if there is
        none.

        With the difference d (J,) from the commanded joints, D = max |d_j| / per_rad_j and the
        tool's Jacobian J_p, the first three rows of `tasks`:

            u = d radps min(1, D / start_rad) / max(D, near_rad)
            velocity = u / max(1, |J_p u| / mps)

        radps [rad/s] and mps [m/s] are the largest speeds of a joint and of the tool. A posture is
        reached when D < near_rad.
        """
        if state["way_next"] >= state["way_count"]:
            return None
        difference: Vector = state["way"][state["way_next"]] - state["joints"][0]
        far = float((np.abs(difference) / self._per_rad).max())
        velocity: Vector = difference * (
            self._radps * min(1.0, far / self._start_rad) / max(far, self._near_rad)
        )
        state["way_next"] += far < self._near_rad
        return velocity / max(1.0, norm(times(tasks[:3], velocity)) / self._mps)
