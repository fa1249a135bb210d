"""The core: each tick's inbox in, a frame out.

Deterministic: no clock, no input or output, and all it remembers is one flat state and
the skill in force.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from typing import TypeAlias

import numpy as np

from service.config import Settings
from service.contract.records import SIDES, Flag, Mode, Reason
from service.core.arm.arm import Arm, Kinematics
from service.core.arm.inverse_kinematics import measured_error, slow_down
from service.core.frame import (
    Frame,
    Lap,
    Record,
    Tick,
    Vector,
    as_array,
    blank,
    copied,
    fill,
    frame_layout,
    frozen,
    no_lap,
    state_layout,
)
from service.core.intake.intake import Intake
from service.core.limiter.limiter import Limited, Limiter
from service.core.separation.separation import Separation
from service.core.setpoint.orientation import OrientationSetpoint
from service.core.setpoint.setpoint import WRONG, SetpointGenerator
from service.core.setpoint.workspace import Target, clamp
from service.core.skill.pose import NO_GRIPPER, decided
from service.core.skill.skill import Prediction, Skill

READY, RETURNING = 1, 2  # of an arm: within its limits, on its way into them
RETURN_RADPS = 0.1  # [rad/s] at which a joint outside its limits moves back
NEAR_SPEED = 0.95  # of the tool's greatest; what the joints turn in a tick changes it by less than the rest
TOO_FAST_S = 0.03  # too fast for so long is a fault: an arm that catches up after a late command is none

# Plain numbers, as an enumeration's members cost a microsecond where they are combined.
HOLD, FOLLOW, FAULT = int(Mode.HOLD), int(Mode.FOLLOW), int(Mode.FAULT)
FAR, CONTESTED = int(Reason.FAR_FROM_DEMONSTRATIONS), int(Reason.TWO_SOURCES)
NOT_READY = int(Reason.ARM_NOT_READY)
CLAMPED, LIMITED, NEAR_LIMIT = int(Flag.TARGET_CLAMPED), int(Flag.SPEED_LIMITED), int(Flag.NEAR_JOINT_LIMIT)
APART = int(Flag.SEPARATION)

Tap: TypeAlias = Callable[[Tick, Frame], None]


def start_state(settings: Settings, skill: Skill) -> Record:
    """The state before the first tick."""
    state = blank(state_layout(len(settings.joints.names)))
    Intake(settings).begin(state)
    state["reason"] = Reason.ARM_NOT_READY
    state["joints"][0] = settings.arm.posture
    state["orientation"], state["closure"] = skill.orientation, NO_GRIPPER
    state["skill"] = np.frombuffer(skill.digest, np.uint8)
    return state


class Controller:
    """Five stages in a row: intake, skill, setpoint, arm, limiter.

    `Controller(settings, skill, state)` goes on bit for bit from where another controller's `state`
    was taken. `urdf` is the text of the arm's description.
    """

    def __init__(self, settings: Settings, skill: Skill, state: Record | None = None, *, urdf: str) -> None:
        self._settings = settings
        self._skill = skill
        self._state = copied(start_state(settings, skill) if state is None else state)
        self._memory = as_array(self._state)
        self._layout = frame_layout(len(settings.joints.names))
        self.intake = self._intake = Intake(settings)
        self._setpoint = SetpointGenerator(settings)
        self._turn = OrientationSetpoint(settings)
        self._arm = Arm(settings, urdf)
        self._limiter = Limiter(settings.joints, settings.period_s)
        self._jerk = np.array(settings.joints.jerk)
        self._still = np.zeros(len(self._jerk))
        self._apart = Separation(settings, urdf)
        self._apart.expect(skill.via_points)
        self._nothing = np.zeros((3, 3))
        self._here: Kinematics | None = None  # of the joints asked about last
        self.measured = (0.0, 0.0)  # how far the arm is off [rad], the tool's speed [m/s]; at the fault, in one

    @property
    def state(self) -> Record:
        """A copy of all that the next frame depends on, but for settings and skill."""
        return copied(self._state)

    def copy_from(self, other: Controller) -> None:
        """Takes over what another controller with the same settings remembers, and its skill."""
        if self._skill is not other._skill:
            self._adopt(other._skill)
        self._memory[:] = other._memory

    @property
    def skill(self) -> Skill:
        """The skill in force."""
        return self._skill

    def step(self, tick: Tick, lap: Lap = no_lap) -> Frame:
        """The frame of one tick.

        Ticks have growing indices. Over indices that are left out hands are taken to have moved on;
        the arm moves by one period only.
        """
        state = self._state
        self._take_in(tick)
        lap("intake")
        prediction = self._predict()
        target = None if prediction is None else self._clamp(prediction)
        lap("skill")
        self._decide(prediction)
        flags = 0
        joints, moving = state["joints"], self._is_moving()
        here = self._arm_at(joints[0])
        self._apart.look(state, here.joints, here.position, here.jacobian)
        if state["mode"] == FOLLOW and prediction is not None and target is not None:
            met = self._lead(target, here)
            self._turn.step(state, *prediction.turn[:2])
            self._grip(target, here)
            lap("setpoint")
            position, velocity = state["setpoint"][:2]
            orientation, turning = state["orientation"], state["turning"]
            wanted = self._arm.step(
                joints[0], position, velocity, orientation, turning, moving=joints[1], here=here, apart=self._apart
            )
            lap("arm")
            limited, stopped = self._move(wanted.velocity)
            flags |= CLAMPED * target.clamped
            flags |= LIMITED * (met or wanted.speed_limited or limited)
            flags |= NEAR_LIMIT * wanted.near_limit
            flags |= APART * (wanted.apart or stopped)
        else:
            inwards = self._inwards()
            if inwards is None:
                state["joints"] = self._brake()[:3]
            else:
                self._move(inwards)
            self._begin_setpoints()
        lap("limiter")
        return self._frame(prediction, target, flags, moving=moving)

    def _take_in(self, tick: Tick) -> None:
        state = self._state
        if tick.index <= state["tick"]:
            raise ValueError(f"tick {tick.index} after tick {state['tick']}: indices must grow")
        self._intake.advance(state, tick.index - int(state["tick"]))
        for event in tick.inbox:
            match event.kind:
                case "hands/left" | "hands/right":
                    self._intake.take_hand(state, SIDES.index(event.kind[6:]), event.value)
                case "joints/state":
                    self._intake.take_arm(state, event.value)
                case "skill":
                    self._adopt(event.value)
                case "hold" | "resume":
                    state["operator_hold"] = event.kind == "hold"
                case "reset":
                    if state["mode"] == FAULT:
                        state["mode"], state["arm_ready"] = HOLD, 0
                case "fault":
                    if state["mode"] != FAULT:
                        state["mode"], state["reason"] = FAULT, Reason.SERVICE
                case _:
                    raise ValueError(f"tick {tick.index}: nothing is done with an event of kind {event.kind!r}")

    def _adopt(self, skill: Skill) -> None:
        self._skill = skill
        self._state["skill"] = np.frombuffer(skill.digest, np.uint8)
        self._state["covariance"], self._state["orientation_covariance"], self._state["closure"] = 0.0, 0.0, NO_GRIPPER
        self._apart.expect(skill.via_points)

    def _predict(self) -> Prediction | None:
        """The prediction, if both hands are known.

        Its covariances and the gripper are predicted anew only when a sample of a hand has come.
        """
        state = self._state
        if not self._intake.are_fresh(state):
            return None
        hands, known = state["hands"], state["covariance"]
        is_new = int(state["tick"]) in state["hand_ticks"].tolist() or known[0, 0] == 0.0
        before = None if is_new else (known, state["orientation_covariance"], float(state["closure"]))
        prediction = self._skill.predict(hands[:, 0], hands[:, 1], hands[:, 2], state["repose"], before=before)
        if is_new:
            state["covariance"], state["orientation_covariance"] = prediction.covariance, prediction.turn.covariance
            state["closure"] = prediction.closure
        return prediction

    def _decide(self, prediction: Prediction | None) -> None:
        """Mode and reason of this tick."""
        state = self._state
        if state["mode"] == FAULT:
            return
        fault = self._watch_arm()
        if fault is not None:
            state["mode"], state["reason"] = FAULT, fault.value
            return
        reason = self._why_hold(prediction)
        state["mode"] = FOLLOW if reason is Reason.NONE else HOLD
        state["reason"] = reason.value

    def _watch_arm(self) -> Reason | None:
        """What is wrong with the arm, if anything; where it appears anew, joints start from it."""
        state, arm = self._state, self._settings.arm
        if arm.source == "assumed":
            if not state["arm_ready"]:
                state["arm_ready"] = READY
                self._begin_setpoints()
            return None
        heard = self._intake.is_arm_heard(state)
        if not state["arm_ready"]:
            # what still moves comes to rest first; what was told must have been one posture
            if self._intake.is_arm_at_rest(state) and not self._is_moving():
                state["arm_ready"] = RETURNING if self._outside(state["measured"]).any() else READY
                state["slow_tick"] = state["tick"]
                state["joints"] = 0.0
                state["joints"][0] = state["measured"]
                self._begin_setpoints()
            return None
        if not heard:
            if state["mode"] == FOLLOW or self._is_moving():
                return Reason.ARM_SILENT
            state["arm_ready"] = 0
            return None
        if state["arm_ready"] == RETURNING and not self._outside(state["joints"][0]).any():
            state["arm_ready"] = READY
        here = self._arm_at(state["joints"][0])  # no farther than that error from where it is measured
        error, speed = measured_error(here.joints, here.tasks, state["measured"], state["measured_velocities"])
        self.measured = error, speed
        if error > arm.fault_error_rad:
            return Reason.ARM_ERROR
        if speed <= self._settings.tool.fault_speed:
            state["slow_tick"] = state["tick"]
        fast_for = int(state["tick"]) - int(state["slow_tick"])
        return Reason.TOOL_SPEED if fast_for * self._settings.period_s > TOO_FAST_S else None

    def _outside(self, joints: Vector) -> Vector:
        """(J,) 1 for each of the joints [rad] below its limits, -1 above them, 0 within."""
        limits = self._settings.joints
        low, high = joints < np.array(limits.lower), joints > np.array(limits.upper)
        way: Vector = low.astype(np.float64) - high
        return way

    def _inwards(self) -> Vector | None:
        """Velocities (J,) [rad/s] of an arm on its way into its limits, None of any other."""
        state = self._state
        if state["arm_ready"] != RETURNING or state["reason"] != NOT_READY or state["operator_hold"]:
            return None
        return RETURN_RADPS * self._outside(state["joints"][0])

    def _why_hold(self, prediction: Prediction | None) -> Reason:
        state = self._state
        if self._intake.is_contested(state, already=int(state["reason"]) == CONTESTED):
            return Reason.TWO_SOURCES
        if state["arm_ready"] != READY:
            return Reason.ARM_NOT_READY
        if state["operator_hold"]:
            return Reason.OPERATOR
        if prediction is None:
            return Reason.NO_HANDS if min(state["hand_ticks"].tolist()) < 0 else Reason.STALE_HAND
        # what has been found far must come clearly nearer again
        ease = 0.9 if int(state["reason"]) == FAR else 1.0
        return Reason.FAR_FROM_DEMONSTRATIONS if prediction.gate_m > ease * self._skill.threshold else Reason.NONE

    def _clamp(self, prediction: Prediction) -> Target:
        """The target where it may be, with the motion that stays there."""
        return clamp(*prediction[:3], box=self._skill.workspace, reach=self._settings.reach)

    def _lead(self, target: Target, here: Kinematics) -> bool:
        """Moves the setpoint on; whether a limit was met. One that passes a bound is a fault."""
        state, box = self._state, self._skill.workspace
        slow = slow_down(state["setpoint"], here.position, self._apart.told[2], self._settings.tool.max_speed)
        met = self._setpoint.step(state, target, box, self._arm.costs(here), slow)
        if met == WRONG:
            state["mode"], state["reason"] = FAULT, Reason.SETPOINT
        return bool(met)

    def _grip(self, target: Target, here: Kinematics) -> None:
        """Opens or closes the gripper where the skill says so, once the tool is where it is to
        be.
        """
        state, before = self._state, int(self._state["gripper"])
        since_s = self._settings.period_s * int(state["tick"] - state["gripper_tick"])
        off = math.dist(target.position.tolist(), here.position.tolist())
        state["gripper"] = decided(before, float(state["closure"]), since_s=since_s, off=off)
        if state["gripper"] != before:
            state["gripper_tick"] = state["tick"]

    def _move(self, wanted: Vector) -> tuple[bool, bool]:
        """Moves the joints on toward wanted velocities (J,) [rad/s]; whether a limit kept them from
        those, and whether it was that of separation.

        They brake where the tool would pass its greatest speed, and one that does all the same is a
        fault; and where they would approach something too fast, unless that brakes less.
        """
        state, max_speed = self._state, self._settings.tool.max_speed
        q, dq, ddq = state["joints"]
        moved = self._limiter.step(q, dq, ddq, wanted)
        limited, excess = moved.limited, self._apart.excess(*moved[1:3], self._jerk)
        stopped = excess > 0.0
        if stopped:
            stop = self._limiter.stop(q, dq, ddq)
            stopped = self._apart.excess(*stop[1:3], self._jerk) < excess
            moved, limited = (stop, True) if stopped else (moved, limited)
        if self._comes_to(moved) > max_speed:
            moved, limited = self._limiter.stop(q, dq, ddq), True
            speed = self._arm.speeds(self._arm_at(moved.position), *moved[1:3])[0]
            if speed > max_speed:
                self.measured = self.measured[0], speed
                state["mode"], state["reason"] = FAULT, Reason.TOOL_SPEED
        state["joints"] = moved[:3]
        return limited, stopped

    def _comes_to(self, moved: Limited) -> float:
        """The greatest speed [m/s] that the tool comes to if the joints stop after a step; near the
        limit also as the arm will stand then, for what joints do to the tool changes on the way.
        """
        max_speed = self._settings.tool.max_speed
        speed = self._arm.speeds(self._arm_at(moved.position), *moved[1:3])[1]
        if not NEAR_SPEED * max_speed < speed <= max_speed:
            return speed
        stop = self._limiter.stop(*moved[:3])
        return max(speed, self._arm.speeds(self._arm.at(stop.position), *stop[1:3])[1])

    def _brake(self) -> Limited:
        """The joints one period on their way to rest, together; or each as it can, where that
        approaches things less.
        """
        q, dq, ddq = self._state["joints"]
        stop = self._limiter.stop(q, dq, ddq)
        excess = self._apart.excess(*stop[1:3], self._jerk)
        if excess <= 0.0:
            return stop
        other = self._limiter.step(q, dq, ddq, self._still)
        return other if self._apart.excess(*other[1:3], self._jerk) < excess else stop

    def _arm_at(self, joints: Vector) -> Kinematics:
        """The arm at joints (J,) [rad]; asked again for the same ones, it is not computed again."""
        if self._here is None or self._here.joints.tobytes() != joints.tobytes():
            self._here = self._arm.at(joints)
        return self._here

    def _is_moving(self) -> bool:
        """Whether the commanded joints have not come to rest."""
        return bool(self._state["joints"][1:].any())

    def _begin_setpoints(self) -> None:
        """Puts the setpoints where the commanded joints have the tool."""
        joints, velocities = self._state["joints"][:2]
        here = self._arm_at(joints)
        self._setpoint.begin(self._state, np.stack([here.position, here.tasks[:3] @ velocities, np.zeros(3)]))
        self._turn.begin(self._state, here.rotation, here.jacobian[3:] @ velocities)

    def _frame(self, prediction: Prediction | None, target: Target | None, flags: int, *, moving: bool) -> Frame:
        state, frame = self._state, blank(self._layout)
        here, turn = self._arm_at(state["joints"][0]), prediction.turn if prediction else None
        fill(
            as_array(frame),
            self._memory,
            here.position,
            here.rotation,
            target.position if target else state["setpoint"][0],
            target.velocity if target else self._nothing[0],
            target.acceleration if target else self._nothing[0],
            prediction.covariance if prediction else self._nothing,
            prediction.gate_m if prediction else 0.0,
            turn.orientation if turn else state["orientation"],
            turn.velocity if turn else self._nothing[0],
            turn.covariance if turn else self._nothing,
            self._apart.told,
        )
        frame["flags"] = flags
        frame["commanded"] = moving or (state["arm_ready"] and state["mode"] != FAULT)
        return frozen(frame)


def run(controller: Controller, ticks: Iterable[Tick], taps: Iterable[Tap], lap: Lap = no_lap) -> None:
    """Steps through all ticks and shows each frame to the taps: the only loop, live, in replay and
    in tests.
    """
    taps = tuple(taps)
    for tick in ticks:
        frame = controller.step(tick, lap)
        for tap in taps:
            tap(tick, frame)
