"""Intake of hand and arm samples: check them, map them to frame `base`, and filter them to a state
at the tick. The clutch, the wish for the gripper and reports of hand guiding are taken in here too.

`step` states all rules by which samples are accepted; `late_samples` filters late ones.
"""

from __future__ import annotations

import math
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from thirdhand.contract.channels import BY_KEY
from thirdhand.contract.joint_states import measured
from thirdhand.contract.messages import (
    BASE,
    JointState,
    PoseStamped,
    PoseWithCovarianceStamped,
    WireError,
)
from thirdhand.contract.records import SIDES, SOURCES, Cause
from thirdhand.core.frame import Event, Record, as_array, parameters
from thirdhand.core.geometry import rotation
from thirdhand.core.intake.hand_estimator import HandEstimator
from thirdhand.core.intake.motion_model import models
from thirdhand.core.intake.step import report, take_arm, take_hand
from thirdhand.core.tuning import TUNING, Tuning
from thirdhand.settings.config import HandSettings, Settings

UNIT_M = {"m": 1.0, "cm": 0.01, "mm": 0.001}  # length [m] of each `hands.unit`


def z_reversed(sample: PoseStamped) -> PoseStamped:
    """A pose in left-handed axes, as it is in right-handed ones whose z points the other way."""
    x, y, z = sample.position
    i, j, k, w = sample.orientation
    return sample._replace(position=(x, y, -z), orientation=(-i, -j, k, w))


def base_from(hands: HandSettings) -> NDArray[np.float64]:
    """The mapping (3, 4) of positions in a tracker's frame and unit to frame `base` [m]."""
    origin = np.array(hands.base_from_tracker[:3])
    axes = rotation(hands.base_from_tracker[3:])
    return np.column_stack((UNIT_M[hands.unit] * axes, origin))


def _stale_ticks(key: str, settings: Settings) -> int:
    """Number of ticks, at least one, after which a channel's source is silent."""
    section, name = BY_KEY[key].stale_after or ("", "")
    duration_ms: float = getattr(getattr(settings, section), name)
    return max(1, settings.ticks_in(duration_ms / 1000))


Sample: TypeAlias = PoseStamped | PoseWithCovarianceStamped | JointState


class Refused(NamedTuple):
    """A rejected sample, with the stamp [ns] of the newest accepted sample, or for a wish the time
    of its arrival; for the arm, also with the joint positions of that one.
    """

    cause: Cause
    sample: Sample
    newest_ns: int
    joints: tuple[float, ...] = ()


class Intake:
    """Intake of hand and arm samples into the state: the estimate of each hand, the newest sample
    of the arm.

    Two attributes are for reports only and are no part of the state: `rejected` (sources, causes)
    counts the rejected samples, and `refused` has the newest rejected sample of each source and
    cause.
    """

    def __init__(self, settings: Settings, *, tuning: Tuning = TUNING) -> None:
        hands = settings.hands
        numbers = tuning.intake
        self._names = settings.joints.names
        # by kind of event: the tick until which it holds, and for how many ticks
        self._holding = {
            "clutch": ("clutch_until_tick", _stale_ticks("clutch", settings)),
            "joints/guided": ("guided_until_tick", _stale_ticks("joints/guided", settings)),
        }

        # The longest interval: between samples of a hand that reappears, and a late sample's age.
        longest_s = hands.longest_stale_ms / 1000
        stale_ticks = _stale_ticks("hands/left", settings)
        stale_max_ticks = max(stale_ticks, settings.ticks_in(longest_s))
        unseen_ticks = max(stale_max_ticks, math.ceil(hands.unseen_ms / 1000 / settings.period_s))
        longest_late_s = max(numbers.max_late_s, longest_s)
        late_ticks = math.ceil(longest_late_s / settings.period_s)
        self._models = models(settings.period_s, unseen_ticks + late_ticks + 1, numbers)

        joints = settings.joints
        limits = np.array([joints.lower, joints.upper])
        per_rad = np.array(joints.per_rad)
        self.parameters = parameters(
            period_s=settings.period_s,
            stale_ticks=stale_ticks,
            stale_max_ticks=stale_max_ticks,
            longest_late_s=longest_late_s,
            unseen_ticks=unseen_ticks,
            silent_ticks=_stale_ticks("joints/state", settings),
            # an arm is at rest once it has reported one posture for this time
            still_ticks=settings.ticks_in(numbers.max_late_s),
            joint_jump_speed=float((np.array(joints.velocity) / per_rad).max()),
            plausible_joints=limits + numbers.max_outside_rad * per_rad * np.array([[-1.0], [1.0]]),
            per_rad=per_rad,
            has_clutch=int(hands.clutch == "key"),
            **numbers._asdict(),
            start_speed_std_mps=numbers.start_speed_std_mps,
            # A hand that is faster than any resting one may still move steadily.
            calm_speed_stds_mps=numbers.rest_speed_std_mps * np.array([1.0, numbers.outlier_stds]),
            # Squared deviation / variance of an outlier; what differs by less continues its filter.
            outlier_variances=numbers.outlier_stds**2,
            # No mode becomes less probable than an outlier on two axes, so that each can return.
            least_mode_probability=round(math.exp(-(numbers.outlier_stds**2)), 9),
            tremor_rates_per_s=numbers.tremor_rates_per_s,
            jump_noise_stds=2.0 * numbers.outlier_stds,  # twice, as the prediction is uncertain too
            arm_still_rad=numbers.arm_still_rad,
            confirmed_s=numbers.confirmed_s,
            # clocks drift apart by at most 1 %
            delay_tolerance_s=0.01 * numbers.tracker_memory_s,
            contested_off_share=numbers.contested_off_share,
            max_joint_radps=numbers.max_joint_radps,
            is_continuous=np.array([int(kind == "continuous") for kind in joints.every_kind]),
        )

        # by the frame that samples name: the mapping to base, and whether the axes are left-handed
        self._mappings = {
            frame: (base_from(of_frame := settings.hands_in(frame)), of_frame.axes == "left-handed")
            for frame in settings.tracker_frames
        }
        if hands.frame not in ("", BASE):
            # If the tracker has a frame of its own, samples in frame base have been mapped already.
            self._mappings[BASE] = np.eye(3, 4), False

        self.rejected = np.zeros((len(SOURCES), len(Cause)), np.int64)
        self.refused: dict[tuple[str, Cause], Refused] = {}
        self._estimator = HandEstimator(self.parameters, self._models, numbers)

    def begin(self, state: Record) -> None:
        """Set the values that hold before the first sample, in a state of zeros."""
        for field in ("tick", "hand_ticks", "clock_tick", "memory_ticks"):
            state[field] = -1
        for field in ("arm_tick", "arm_still_tick", "arm_sample_ticks"):
            state[field] = -1
        state["stale_ticks"] = self.parameters["stale_ticks"][0]
        self._estimator.begin(state)

    def step(self, state: Record, frame: Record, ticks: int, samples: list[Event]) -> int:
        """Advance the state by some ticks and take the samples in. Returns the flags of
        `codes.Condition` that `step.report` lists.
        """
        self.advance(state, ticks)
        for event in samples:
            match event.kind:
                case "joints/state":
                    self.take_arm(state, event.value)
                case "clutch" | "joints/guided":
                    field, lasting_ticks = self._holding[event.kind]
                    state[field] = state["tick"] + lasting_ticks if event.value else 0
                case "gripper/wish":
                    state["gripper_wish"] = event.value
                case _:
                    self.take_hand(state, SIDES.index(event.kind[6:]), event.value)
        return int(report(as_array(state), as_array(frame), self.parameters))

    def advance(self, state: Record, ticks: int) -> None:
        """Advance the state by some ticks: hands seen lately move on, others stand still."""
        self._estimator.advance(state, ticks)

    def take_hand(self, state: Record, side: int, sample: PoseStamped) -> None:
        """Filter a sample of one hand, or count it as rejected."""
        cause = int(Cause.WRONG_FRAME)
        if tracker := self._mappings.get(sample.frame_id):
            mapping, is_left_handed = tracker
            if is_left_handed:
                sample = z_reversed(sample)
            cause = take_hand(
                as_array(state),
                self.parameters,
                self._models,
                side,
                sample.stamp_ns,
                sample.position,
                sample.orientation,
                mapping,
            )
        if cause >= 0:
            newest_ns = int(state["hand_stamps_ns"][side])
            self.reject(state, SIDES[side], Cause(cause), sample, newest_ns=newest_ns)

    def take_arm(self, state: Record, sample: JointState) -> None:
        """Store a sample of the arm in the state, or count it as rejected."""
        try:
            position, velocity = measured(sample, self._names)
        except WireError:
            cause = int(Cause.INCOMPLETE)
        else:
            motion = np.array(position), np.array(velocity)
            cause = take_arm(as_array(state), self.parameters, sample.stamp_ns, *motion)
        if cause >= 0:
            newest_ns = int(state["arm_stamp_ns"])
            joints = tuple(state["measured"].tolist())
            self.reject(state, "arm", Cause(cause), sample, newest_ns=newest_ns, joints=joints)

    def reject(
        self,
        state: Record,
        source: str,
        cause: Cause,
        sample: Sample,
        *,
        newest_ns: int,
        joints: tuple[float, ...] = (),
    ) -> None:
        """Count a rejected sample, and retain it for reports."""
        state["rejected"][cause] += 1
        self.refused[source, cause] = Refused(cause, sample, newest_ns, joints)
        # last, so that another thread that sees the count finds `refused`
        self.rejected[SOURCES.index(source), cause] += 1
