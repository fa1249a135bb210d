"""Core of the service: from the events of each tick to a frame, and from a frame to the messages
that are published.

The core is deterministic: it has no clock, no input or output, and all that it remembers is one
flat state and the skill in force. Messages are encoded once; they are recorded as published.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Iterable
from typing import TypeAlias

import numpy as np

from thirdhand.contract import cdr
from thirdhand.contract.channels import CHANNELS, STREAMS
from thirdhand.contract.messages import BASE, GRIPPER, PoseStamped, PoseWithCovarianceStamped
from thirdhand.contract.records import GONE_S, Flag, Reason
from thirdhand.core.arm.stage import ArmStage
from thirdhand.core.codes import (
    ARM_INSIDE,
    BROKEN,
    FOLLOW,
    HANDS_KNOWN,
    ONE_HAND,
    READY,
    STARTS_MEASURED,
)
from thirdhand.core.decision.stage import Decision
from thirdhand.core.frame import (
    RECORDS,
    STAGES,
    WISH_STATE,
    Event,
    Frame,
    Lap,
    Outputs,
    Record,
    Tick,
    as_array,
    blank,
    copied,
    dtype_of,
    frame_layout,
    part_of,
    state_layout,
)
from thirdhand.core.intake.stage import Intake
from thirdhand.core.kinematics import Kinematics
from thirdhand.core.limiter.stage import LimiterStage
from thirdhand.core.separation.stage import Separation
from thirdhand.core.setpoint.stage import SetpointStage
from thirdhand.core.skill.model import Wanted
from thirdhand.core.skill.pose import CLOSED, NO_GRIPPER, UNKNOWN
from thirdhand.core.skill.skill import NEVER, Skill
from thirdhand.core.skill.stage import SkillStage
from thirdhand.core.tuning import TUNING, Tuning
from thirdhand.core.wish.stage import WishStage
from thirdhand.settings.config import Settings

# Plain integers, because combining the members of an enumeration takes a microsecond.
CLAMPED = int(Flag.TARGET_CLAMPED)
LIMITED = int(Flag.SPEED_LIMITED)
NEAR_LIMIT = int(Flag.NEAR_JOINT_LIMIT)
SEPARATED = int(Flag.SEPARATION)
STUCK = int(Flag.STUCK)
UNSURE = int(Flag.UNSURE)
ENGAGING = int(Flag.ENGAGING)
SAMPLES = {channel.key for channel in CHANNELS if channel.direction == "in" and channel.event}
SAMPLES.remove("tool/wish")  # which the skill's stage takes

Tap: TypeAlias = Callable[[Tick, Frame], None]


def no_lap(stage: str) -> None:
    """Ignore the end of a stage; the daemon passes a function that measures durations instead."""


def start_state(settings: Settings, skill: Skill, tuning: Tuning = TUNING) -> Record:
    """State before the first tick."""
    joints = len(settings.joints.names)
    has_wishes = settings.skill.has_wishes
    state = blank(state_layout(joints, has_wishes=has_wishes))
    if has_wishes:
        state["wish_tick"] = -1
        state["wish_told_tick"] = state["wish_leap"] = NEVER
    Intake(settings, tuning=tuning).begin(state)
    state["reason"] = Reason.ARM_NOT_READY
    state["joints"][0] = settings.arm.posture
    state["orientation"] = skill.orientation
    state["closure"] = NO_GRIPPER
    state["gripper_wish"] = NO_GRIPPER
    state["skill"] = np.frombuffer(skill.digest, np.uint8)
    state["trail_tick"] = NEVER
    return state


class Controller:
    """Sequence of seven stages: intake, skill, decision, separation, setpoint, arm, limiter.

    `Controller(settings, skill, state)` continues bit for bit from the `state` of another
    controller. `urdf` is the text of the arm's description. Tests and experiments vary the tuned
    numbers by `tuning`.
    """

    def __init__(
        self,
        settings: Settings,
        skill: Skill,
        state: Record | None = None,
        *,
        urdf: str,
        tuning: Tuning = TUNING,
    ) -> None:
        self._whole = copied(start_state(settings, skill, tuning) if state is None else state)
        self._bytes = as_array(self._whole).view(np.uint8)
        joints = len(settings.joints.names)
        layout = state_layout(joints)
        # its compiled functions are those of all cells, so the stages share one layout
        self._state = part_of(self._whole, layout, 0)
        # the same memory as an array: a number is read from it in a third of the time
        self._memory = as_array(self._state)
        self._layout = frame_layout(joints)
        self.intake = Intake(settings, tuning=tuning)
        self._skill = SkillStage(settings, skill, tuning=tuning)
        self._wishes: WishStage | None = None
        if settings.skill.has_wishes:
            wishes = part_of(self._whole, dtype_of(WISH_STATE, joints), layout.itemsize)
            self._skill = self._wishes = WishStage(settings, skill, wishes, tuning=tuning)
        self.decision = Decision(settings, tuning=tuning)
        self._separation = Separation(settings, urdf, tuning=tuning)
        self._separation.set_contacts(skill.via_points)
        self._arm = ArmStage(settings, urdf, tuning=tuning)
        self._setpoint = SetpointStage(settings, self._arm, tuning=tuning)
        self._limiter = LimiterStage(settings, self._arm, tuning=tuning)
        # capsules exceed the meshes in them by about this: an arm that is less deep in a thing, by
        # its capsules, may be clear of it
        self._capsule_excess_m = tuning.separation.planned_margin_m
        self._gone_ticks = math.ceil(GONE_S / settings.period_s)
        stages = (
            self.intake,
            self._skill,
            self.decision,
            self._separation,
            self._setpoint,
            self._arm,
            self._limiter,
        )
        self.constants = dict(zip(STAGES, map(_digest, stages), strict=True))
        """Digests of the constants that each stage derived from settings, skill and description."""
        # kinematics at the state's joints; None: not yet computed
        self._here: Kinematics | None = None

    @property
    def state(self) -> Record:
        """Copy of all that the next frame depends on, except settings and skill."""
        return copied(self._whole)

    @property
    def skill(self) -> Skill:
        """Skill in force."""
        return self._skill.skill

    @property
    def max_part_speed(self) -> float:
        """Upper bound [m/s] of the speed of every part of the arm."""
        return self._separation.max_speed

    def copy_from(self, other: Controller) -> None:
        """Take over state, skill and reports of another controller with the same settings."""
        if self.skill is not other.skill:
            self._adopt(other.skill)
        self._bytes[:] = other._bytes
        self._here = other._here
        self.decision.measured = other.decision.measured
        self.intake.refused = other.intake.refused.copy()
        self.intake.rejected[:] = other.intake.rejected

    def step(self, tick: Tick, lap: Lap = no_lap) -> Frame:
        """Frame of one tick, whose index must be higher than that of the tick before.

        Over omitted indices, the hands' motion is extrapolated; the arm moves by one period only.
        """
        state = self._state
        frame = RECORDS(1, self._layout, bytearray(self._layout.itemsize))[0]
        conditions = self._take_in(tick, frame)
        lap("intake")

        conditions |= self._alone(frame)
        request, flags = self._skill.request(state, frame, conditions)
        conditions |= flags
        lap("skill")

        kinematics = self._decide(
            frame, conditions, math.nan if request is None else request.gate_m
        )
        lap("decision")

        self._separation.step(state, frame, kinematics.record)
        lap("separation")

        if request is None:
            self._hold(frame, lap)
            self._skill.nothing(state, frame)
        elif self._memory["mode"][0] != FOLLOW:
            self._hold(frame, lap)
        else:
            self._follow(frame, request, kinematics, lap)

        # An array of bytes is read-only.
        unchanging: Frame = np.frombuffer(as_array(frame).tobytes(), self._layout)[0]
        return unchanging

    def _take_in(self, tick: Tick, frame: Frame) -> int:
        """Apply the events of a tick and advance the intake. Returns its flags `codes.Condition`.
        Raises ValueError if the tick's index does not grow.
        """
        state = self._state
        before = int(self._memory["tick"][0])
        if tick.index <= before:
            raise ValueError(f"tick {tick.index} after tick {before}: indices must grow")
        samples: list[Event] = []
        for event in tick.inbox:
            if event.kind in SAMPLES:
                samples.append(event)
            else:
                self._apply(tick, event)
        return self.intake.step(state, frame, tick.index - before, samples)

    def _apply(self, tick: Tick, event: Event) -> None:
        """Apply an event that is no sample of a hand or the arm."""
        state = self._state
        match event.kind:
            case "tool/wish":
                if self._wishes is None:
                    return  # of a program that is not asked
                cause = self._wishes.take(tick.index, tick.time_ns, event.value)
                if cause is not None:
                    self.intake.reject(state, "wish", cause, event.value, newest_ns=tick.time_ns)
            case "skill":
                self._adopt(event.value)
            case "segment":
                self._skill.set_segment(state, cdr.decode_string(event.payload))
            case "begin":
                self._skill.begin(state)
            case _:
                self.decision.take(state, event)

    def _alone(self, frame: Frame) -> int:
        """Flags ONE_HAND and HANDS_KNOWN if one hand leads the skill and the other one has never
        been seen, or has disappeared.

        A hand that was seen lately may be near, so the arm holds. The arm keeps away from where the
        other hand was last seen.
        """
        side = self.skill.conductor
        if side is None:
            return 0
        ages = frame["hand_ages"]
        if ages[side] < 0 or 0 <= ages[1 - side] < self._gone_ticks:
            return 0
        return ONE_HAND | (HANDS_KNOWN if ages[side] < frame["stale_ticks"][side] else 0)

    def _adopt(self, skill: Skill) -> None:
        """Replace the skill in force."""
        self._skill.adopt(self._state, skill)
        self._separation.set_contacts(skill.via_points)

    def _decide(self, frame: Frame, conditions: int, gate_m: float) -> Kinematics:
        """Determine the mode, and start an arm that has become ready. Returns its kinematics."""
        state = self._state
        kinematics = self._at()
        threshold = self.skill.threshold
        # Separation keeps a ready arm out of things, so only another one may be inside of one.
        if self._memory["arm_ready"][0] != READY:
            joints = state["joints"][0] if state["arm_ready"] else state["measured"]
            conditions |= ARM_INSIDE * (
                self._separation.intrusion(joints)[0] > self._capsule_excess_m
            )
        starts = self.decision.step(
            state, frame, kinematics.record, conditions, gate_m=gate_m, threshold=threshold
        )
        if starts == STARTS_MEASURED:
            self._limiter.begin(state, state["measured"])
            self._here = None
        if starts:
            kinematics = self._at()
            self._setpoint.begin(state, frame, kinematics)
        return kinematics

    def _follow(self, frame: Frame, wanted: Wanted, kinematics: Kinematics, lap: Lap) -> None:
        """Advance setpoint and joints by one period. A setpoint outside its bounds, or a tool that
        cannot be slowed down enough, is a fault.
        """
        state = self._state
        separation = self._separation
        limitation = self._setpoint.step(
            state, frame, wanted, kinematics, self._skill.workspace, separation.setpoint_share
        )
        if limitation == BROKEN:
            self.decision.fail(state, frame, Reason.SETPOINT)
        lap("setpoint")
        solution = self._arm.follow(state, kinematics, separation)
        lap("arm")
        moved = self._limiter.step(
            state, frame, solution.velocity, solution.acceleration, separation
        )
        self._here = moved.here

        if moved.excess_speed:
            self.decision.fail(state, frame, Reason.TOOL_SPEED, speed=moved.excess_speed)
            frame["commanded"] = moved.moving
        memory = self._memory
        flags = (
            STUCK * (memory["stuck"][0] > 0)
            | CLAMPED * wanted.target.clamped
            | NEAR_LIMIT * solution.near_limit
        )
        flags |= UNSURE * (memory["unsure"][0] > 0) | LIMITED * (
            limitation > 0 or solution.speed_limited or moved.limited
        )
        flags |= ENGAGING * (memory["engaging"][0] > 0)
        frame["flags"] = flags | SEPARATED * (solution.separated or moved.separated)
        lap("limiter")

    def _hold(self, frame: Frame, lap: Lap) -> None:
        """Brake the joints; or move them back into their limits, out of a thing that they are
        inside of, or along a way out. The setpoint is reset to the tool.
        """
        state = self._state
        separation = self._separation
        kinematics = self._at()
        velocity = self.decision.own_motion(state, kinematics.tasks)
        if velocity is None:
            moved = self._limiter.stop(state, frame, separation)
        else:
            velocity = velocity * separation.share(velocity)
            if state["leaves"]:
                velocity = velocity + self._arm.follow(state, kinematics, separation).velocity
            moved = self._limiter.step(state, frame, velocity, np.zeros(len(velocity)), separation)
        self._here = moved.here
        lap("limiter")
        self._setpoint.begin(state, frame, moved.here, engages=not self.decision.is_brief(state))
        lap("setpoint")

    def _at(self) -> Kinematics:
        """Kinematics of the arm at the state's joints, computed once for each posture."""
        if self._here is None:
            self._here = self._arm.at(self._state["joints"][0])
        return self._here


def _digest(stage: object) -> str:
    """A digest of the parameter records of a stage, and of its parts in the same package."""
    sums = hashlib.blake2b(digest_size=8)
    package = type(stage).__module__.rpartition(".")[0]
    for _, value in sorted(vars(stage).items()):
        if isinstance(value, np.ndarray) and value.dtype.names:
            sums.update(value.tobytes())
        elif (
            type(value).__module__.startswith(package)
            and hasattr(value, "__dict__")
            and not isinstance(value, Skill)
        ):
            sums.update(_digest(value).encode())
    return sums.hexdigest()


def run(controller: Controller, ticks: Iterable[Tick], taps: Iterable[Tap]) -> None:
    """Step a controller through all ticks and pass each frame to the taps, as replay and tests do.
    Live operation rehearses ticks too, see `daemon.daemon`.
    """
    taps = tuple(taps)
    for tick in ticks:
        frame = controller.step(tick)
        for tap in taps:
            tap(tick, frame)


def outgoing(frame: Frame, stamp_ns: int, joints: tuple[str, ...]) -> Outputs:
    """Messages to publish for a frame; `joints` are the names of the commanded joints.

    Before the arm is ready there is no command, and without known hands no target.
    """
    tick = int(frame["tick"])
    messages = (
        (stream.key, _OUTPUTS[stream.key](frame, stamp_ns, joints))
        for stream in STREAMS
        if tick % stream.every == 0
    )
    return [(key, payload) for key, payload in messages if payload is not None]


def _command(frame: Frame, stamp_ns: int, joints: tuple[str, ...]) -> bytes | None:
    """Joint command as CDR bytes; None while nothing is commanded."""
    if not frame["commanded"]:
        return None
    return cdr.encode_command(
        stamp_ns, joints, frame["joints"].tolist(), frame["joint_velocities"].tolist()
    )


def _target(frame: Frame, stamp_ns: int, joints: tuple[str, ...]) -> bytes | None:
    """Target pose and covariance (6, 6), position [m²] then orientation [rad²], as CDR bytes; None
    while nothing is predicted.
    """
    if not frame["covariance"].any():
        return None
    covariance = [0.0] * 36
    for i, row in enumerate(frame["covariance"].tolist()):
        covariance[6 * i : 6 * i + 3] = row
    for i, row in enumerate(frame["orientation_covariance"].tolist()):
        covariance[6 * i + 21 : 6 * i + 24] = row
    position = tuple(frame["target"].tolist())
    orientation = tuple(frame["orientation"].tolist())
    message = PoseWithCovarianceStamped(stamp_ns, BASE, position, orientation, tuple(covariance))
    return cdr.encode_pose_with_covariance(message)


def _setpoint(frame: Frame, stamp_ns: int, joints: tuple[str, ...]) -> bytes | None:
    """Setpoint pose as CDR bytes."""
    message = PoseStamped(
        stamp_ns,
        BASE,
        tuple(frame["setpoint"].tolist()),
        tuple(frame["setpoint_orientation"].tolist()),
    )
    return cdr.encode_pose(message)


def _gripper(frame: Frame, stamp_ns: int, joints: tuple[str, ...]) -> bytes | None:
    """Command 0 (open) or 1 (closed) as CDR bytes; None while the gripper's state is unknown."""
    if frame["gripper"] == UNKNOWN:
        return None
    return cdr.encode_command(stamp_ns, (GRIPPER,), [float(frame["gripper"] == CLOSED)], [0.0])


_OUTPUTS: dict[str, Callable[[Frame, int, tuple[str, ...]], bytes | None]] = {
    "joints/command": _command,
    "tool/target": _target,
    "tool/setpoint": _setpoint,
    "gripper/command": _gripper,
}
