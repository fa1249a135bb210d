"""The mode of a tick and the reason for it: whether the arm is ready and does what it is told,
whether hands are known and where the skill is sure.
"""

from __future__ import annotations

import math

import numpy as np

from kmp.compiled import compiled
from service.config import Settings
from service.contract.records import Mode, Reason
from service.core.decision.leave import HELD, NOTICED, WayOut
from service.core.frame import Event, Record, Records, Vector, as_array, parameters
from service.core.intake.intake import ARM_HEARD, ARM_STILL, CONTESTED, UNSEEN

READY = 1  # an arm within its limits, and in nothing
RETURNING = 2  # an arm on its way to that
RETURN_RADPS = 0.1  # [rad/s] at which a joint outside its limits moves back
TOO_FAST_S = 0.03  # too fast for so long is a fault: an arm that catches up after a late command is none
STUCK_M = 0.02  # [m] a tool nearer to its target is there
STUCK_S = 0.8  # a tool that comes nearer by less than the next within so long is stuck
PROGRESS = 0.08  # share of its distance ...
FREED = 0.25  # ... or this, once it was
PROGRESS_SPEED = 0.3  # or share of the tool's greatest speed, where that is less
MOVED_M = 0.02  # [m] by which a target may move in that time
ANOTHER_M = 0.04  # [m] a target so far from the one that it was stuck for may be reached
WAY_S = 20.0  # that a way may take
FREED_S = 1.0  # an arm that cannot get out of a thing stays as it is after so long
GATE_EASE = 0.9  # of the threshold: what has been found far must come clearly nearer again

# Plain numbers, as compiled functions and their callers need them.
HOLD, FOLLOW, FAULT = int(Mode.HOLD), int(Mode.FOLLOW), int(Mode.FAULT)
NONE, NO_HANDS, STALE_HAND = int(Reason.NONE), int(Reason.NO_HANDS), int(Reason.STALE_HAND)
FAR, TWO_SOURCES = int(Reason.FAR_FROM_DEMONSTRATIONS), int(Reason.TWO_SOURCES)
OPERATOR, NOT_READY, BLOCKED = int(Reason.OPERATOR), int(Reason.ARM_NOT_READY), int(Reason.BLOCKED)
AMBIGUOUS = int(Reason.AMBIGUOUS)
ARM_ERROR, ARM_SILENT, TOOL_SPEED = int(Reason.ARM_ERROR), int(Reason.ARM_SILENT), int(Reason.TOOL_SPEED)
STARTS_ASSUMED = 1  # what a step says: the arm is taken to be at the configured posture
STARTS_MEASURED = 2  # the arm appeared, where it is measured
INSIDE = 64  # beside what the intake says: a part of the arm is inside of a thing ...
TORN = 256  # it is not known which stage of the task it is
ALONE = 128  # and that the hand that conducts the skill alone was seen, and the other never
NEEDED = 512  # a hand that is not seen makes much of a difference
INSIDE_M = 0.01  # [m] ... by more than capsules are larger than links


class Decision:
    """Mode and reason, in the state. `measured`: how far the arm is off its command [rad], and the
    tool's speed [m/s], measured; at a fault what it was found by.
    """

    def __init__(self, settings: Settings) -> None:
        limits = settings.joints
        self._lower, self._upper = np.array(limits.lower, np.float64), np.array(limits.upper, np.float64)
        self._parameters = parameters(
            lower=self._lower,
            upper=self._upper,
            period_s=settings.period_s,
            is_assumed=int(settings.arm.source == "assumed"),
            max_error_rad=float(settings.arm.fault_error_rad),
            fault_speed=float(settings.tool.fault_speed),
            max_speed=float(settings.tool.max_speed),
            per_rad=np.array(limits.per_rad),
        )
        self._return_speed = RETURN_RADPS * np.array(limits.per_rad)
        self._way_out = WayOut(settings)
        self.measured = (0.0, 0.0)

    def step(self, state: Record, frame: Record, here: Records, known: int, *, gate_m: float, threshold: float) -> int:
        """Mode and reason of this tick, with the arm's kinematics `here` (1,); 0, STARTS_ASSUMED or
        STARTS_MEASURED.

        known: the flags that `Intake.step` gave, INSIDE, TORN and ALONE. gate_m: what the skill
        compares with its threshold, NaN where it predicts nothing.
        """
        gates = gate_m, threshold
        starts, error, speed = _step(as_array(state), as_array(frame), here, self._parameters, known, *gates)
        frame["mode"], frame["reason"] = state["mode"], state["reason"]
        if error >= 0.0:
            self.measured = error, speed
        return int(starts)

    def own_motion(self, state: Record, tasks: Vector) -> Vector | None:
        """Velocities (J,) [rad/s] of an arm in a hold on its way into its limits, or on a way out
        of where it is stuck; None of any other. The arm's tasks are as in `Kinematics`.
        """
        if state["arm_ready"] == RETURNING and state["reason"] == NOT_READY and not state["operator_hold"]:
            q = state["joints"][0]
            inward: Vector = (q < self._lower).astype(np.float64) - (q > self._upper)
            return self._return_speed * inward
        return self._way_out.velocity(state, tasks) if state["reason"] == BLOCKED else None

    def take(self, state: Record, event: Event) -> None:
        """A hold, resume, reset or fault that somebody asks for, or a way out that was found.
        Raises ValueError for others.
        """
        match event.kind:
            case "hold" | "resume":
                state["operator_hold"] = event.kind == "hold"
                if event.kind == "resume":
                    state["stuck"] = state["way_count"] = 0
            case "reset":
                state["leaves"] = not state["arm_ready"]
                if state["mode"] == FAULT:
                    state["mode"], state["arm_ready"] = HOLD, 0
            case "way":
                if state["mode"] != FAULT:
                    self._way_out.take(state, event)
            case "fault":
                if state["mode"] != FAULT:
                    state["mode"], state["reason"] = FAULT, Reason.SERVICE
            case _:
                raise ValueError(f"tick {state['tick']}: nothing is done with an event of kind {event.kind!r}")

    def fail(self, state: Record, frame: Record, reason: Reason, *, speed: float | None = None) -> None:
        """At fault from this tick on, for a `speed` [m/s] of the tool where that is why."""
        state["mode"], state["reason"] = frame["mode"], frame["reason"] = FAULT, reason
        if speed is not None:
            self.measured = self.measured[0], speed


@compiled
def _step(
    states: Records,
    frames: Records,
    heres: Records,
    parameters: Records,
    known: int,
    gate_m: float,
    threshold: float,
) -> tuple[int, float, float]:
    """`Decision.step`, and what was measured; -1: nothing."""
    state = states[0]
    if state.mode == FAULT:
        return 0, -1.0, -1.0
    starts, fault, error, speed = _arm(states, heres, parameters, known)
    if fault != NONE:
        state.mode, state.reason = FAULT, fault
        return starts, error, speed
    if known & CONTESTED:
        reason = TWO_SOURCES
    elif state.arm_ready != READY:
        reason = NOT_READY
    elif state.operator_hold:
        reason = OPERATOR
    elif math.isnan(gate_m):
        unseen = min(state.hand_ticks[0], state.hand_ticks[1]) < 0 and not known & ALONE
        reason = NO_HANDS if unseen else STALE_HAND
    elif known & sum(UNSEEN) and (known & NEEDED or state.mode != FOLLOW):
        reason = STALE_HAND
    else:
        ease = GATE_EASE if state.reason == FAR else 1.0
        reason = FAR if gate_m > ease * threshold else AMBIGUOUS if known & TORN else NONE
    if reason == NONE:
        state.stuck = _stuck(states, frames, heres, parameters)
        reason = BLOCKED if state.stuck == HELD else NONE
    state.mode, state.reason = FOLLOW if reason == NONE else HOLD, reason
    return starts, error, speed


@compiled
def _arm(states: Records, heres: Records, parameters: Records, known: int) -> tuple[int, int, float, float]:
    """Whether the arm starts, what is wrong with it, its error and speed as measured."""
    state, given, heard, inside = states[0], parameters[0], known & ARM_HEARD, known & INSIDE
    if given.is_assumed:
        starts = 0 if state.arm_ready else STARTS_ASSUMED
        state.arm_ready = READY
        return starts, NONE, -1.0, -1.0
    moving = False
    for joint in range(state.joints.shape[1]):
        moving = moving or state.joints[1, joint] != 0.0 or state.joints[2, joint] != 0.0
    if not state.arm_ready:
        state.stuck = state.way_count = 0
        if not known & ARM_STILL:
            state.leaves = 0
        # what still moves comes to rest first; what was reported must have been one posture
        if not known & ARM_STILL or moving or (inside and not state.leaves):
            return 0, NONE, -1.0, -1.0
        state.arm_ready = RETURNING if inside or _is_outside(state.measured, parameters) else READY
        state.slow_tick = state.stuck_tick = state.tick
        return STARTS_MEASURED, NONE, -1.0, -1.0
    if not heard:
        if state.mode == FOLLOW or moving:
            return 0, ARM_SILENT, -1.0, -1.0
        state.arm_ready = 0
        return 0, NONE, -1.0, -1.0
    if state.arm_ready == RETURNING and not _is_outside(state.joints[0], parameters):
        if moving:
            state.stuck_tick = state.tick
        if not inside or (state.tick - state.stuck_tick) * given.period_s > FREED_S:
            state.arm_ready, state.leaves = READY, 0
    error, speed = measured_error(states, heres, parameters)
    if error > given.max_error_rad:
        return 0, ARM_ERROR, error, speed
    if speed <= given.fault_speed:
        state.slow_tick = state.tick
    fault = TOOL_SPEED if (state.tick - state.slow_tick) * given.period_s > TOO_FAST_S else NONE
    return 0, fault, error, speed


@compiled
def _stuck(states: Records, frames: Records, heres: Records, parameters: Records) -> int:
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


@compiled
def _is_outside(joints: Vector, parameters: Records) -> bool:
    """Whether a joint (J,) [rad] is outside its limits."""
    outside = False
    for j in range(len(joints)):
        outside = outside or joints[j] < parameters[0].lower[j] or joints[j] > parameters[0].upper[j]
    return outside


@compiled
def measured_error(states: Records, heres: Records, parameters: Records) -> tuple[float, float]:
    """Largest difference between measured and commanded joints, by `per_rad` [rad]; and the
    measured speed of the tool [m/s], from the Jacobian at the commanded joints.
    """
    state, here = states[0], heres[0]
    error = speed = 0.0
    for joint in range(len(here.joints)):
        error = max(error, abs(here.joints[joint] - state.measured[joint]) / parameters[0].per_rad[joint])
    for axis in range(3):
        along = 0.0
        for joint in range(len(here.joints)):
            along += here.tasks[axis, joint] * state.measured_velocities[joint]
        speed += along * along
    return error, math.sqrt(speed)
