"""Corrections of an operator: their hands, segment and led tool, taken from the loop's state."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from thirdhand.contract.requests import Correct, Orientation, RequestError, ViaPoint
from thirdhand.core.arm.stage import ArmStage
from thirdhand.core.codes import FAULT, HELD_SEEN, HOLD
from thirdhand.core.frame import Frame, Record, Vector
from thirdhand.core.geometry import quaternion_of
from thirdhand.daemon.cell_state import CellState
from thirdhand.daemon.status import MAX_MEASURED_AGE_S
from thirdhand.settings.config import robot_description

MAX_LED_RADPS = 0.05  # an arm that moves faster than this is still being led
NOT_HELD = "the arm does not hold for an operator; `thirdhand hold` first, or guide it by hand"
HOLD_ENDED = "the hold ended while this was computed; nothing was changed. Hold again"


def held_since(state: Record) -> int:
    """The tick at which the operator's hold began. Raises RequestError if there is none."""
    mode = int(state["mode"])
    if mode == FAULT:
        raise RequestError("the arm is in a fault; `thirdhand reset` and `thirdhand hold` first")
    if mode != HOLD or not state["operator_hold"]:
        raise RequestError(NOT_HELD)
    return int(state["held_tick"])


def check_same_hold(held_tick: int | None, state: Record) -> None:
    """Raise RequestError unless the operator's hold that began at this tick lasts; None: never.
    After a hold, the tool approaches a corrected target at the engaging speed.
    """
    is_held = state["mode"] == HOLD and state["operator_hold"] and state["held_tick"] == held_tick
    if held_tick is not None and not is_held:
        raise RequestError(HOLD_ENDED)


class LedTool(NamedTuple):
    """The hands (6,) [m] and the segment (-1: none) that a correction belongs to, the tool (3,) [m]
    with its orientation, and the arm's joints (J,) [rad] now, in the hold since `held_tick`.
    """

    held_tick: int
    hands: Vector
    segment: int
    tool: Vector
    orientation: Orientation | None
    joints: Vector


class Corrections:
    """The corrections of one cell since its daemon began. `replaced` are the via-points that each
    correction replaced.
    """

    def __init__(self, cell: CellState) -> None:
        self._cell = cell
        self._arm: ArmStage | None = None
        self.replaced: dict[ViaPoint, tuple[ViaPoint, ...]] = {}

    def led(self, request: Correct) -> LedTool:
        """The hands and the tool of a correction that is requested now. Raises RequestError."""
        frame, state = self._cell.moment()
        held_tick = held_since(state)
        hands, segment = self._hands(request, frame, state)
        joints = np.array(state["joints"][0])
        if request.tool is not None:
            return LedTool(held_tick, hands, segment, np.array(request.tool), None, joints)
        settings = self._cell.settings
        if settings.arm.source == "assumed":
            raise RequestError(
                "$.tool: none given; needed, as this daemon does not measure where the arm is"
            )
        if state["guided_tick"] < max(state["held_tick"], 1):
            raise RequestError(
                "the arm was not led in this hold: its driver reported no guiding on "
                "`joints/guided`. Switch on hand guiding and lead the tool, or give its position "
                "as $.tool"
            )
        if (state["tick"] - state["arm_tick"]) * settings.period_s >= MAX_MEASURED_AGE_S:
            raise RequestError("the arm's joints are not measured now: is its driver running?")
        speed = float(
            (np.abs(state["measured_velocities"]) / np.array(settings.joints.per_rad)).max()
        )
        if speed > MAX_LED_RADPS:
            raise RequestError(
                f"the arm moves at {speed:.2f} rad/s; {MAX_LED_RADPS} rad/s accepted: hold it still"
            )
        self._arm = self._arm or ArmStage(settings, robot_description(settings))
        kinematics = self._arm.at(np.array(state["measured"]))
        quaternion = np.empty(4)
        quaternion_of(kinematics.rotation, quaternion)
        x, y, z, w = (round(value, 6) for value in quaternion.tolist())
        orientation = (x, y, z, w) if request.turned else None
        return LedTool(
            held_tick,
            hands,
            segment,
            np.array(kinematics.position),
            orientation,
            np.array(state["measured"]),
        )

    def _hands(self, request: Correct, frame: Frame, state: Record) -> tuple[Vector, int]:
        """The hands (6,) [m] and the segment of a correction. Raises RequestError."""
        skill = self._cell.skill
        sides = (0, 1) if skill.conductor is None else (skill.conductor,)
        if request.hands == "held":
            if state["held"] != HELD_SEEN:
                raise RequestError(
                    "the hands were not seen when the hold began; resume, hold again while both "
                    "are seen, or correct "
                    'for the hands of this moment ($.hands: "now")'
                )
            hands = np.array(state["held_hands"])
            segment = int(state["held_segment"])
        else:
            ages, stale = (frame[name][list(sides)] for name in ("hand_ages", "stale_ticks"))
            if (ages < 0).any() or (ages >= stale).any():
                raise RequestError("$.hands: 'now' given, but the hands are not seen now")
            hands = np.array(frame["hands"])
            belief = np.array(state["segment_belief"])
            segment = int(belief.argmax()) if belief.max() > 0.5 else -1
        if skill.model.names and not 0 <= segment < len(skill.model.names) - 1:
            raise RequestError(
                "the segment of the task was not known; name it by `thirdhand segment NAME`, then "
                "hold again"
            )
        return hands.reshape(6), segment if skill.model.names else -1
