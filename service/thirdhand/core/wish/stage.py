"""Stage 2 where a policy leads: the target is what it wishes, alone or together with a skill."""

from __future__ import annotations

import numpy as np

from thirdhand.contract.messages import BASE, PoseStamped, PoseWithCovarianceStamped
from thirdhand.contract.records import FARTHEST_WISH_S, Cause
from thirdhand.core.codes import (
    BY_SKILL,
    BY_WISHES,
    WISH_JUMPED,
    WISH_LEADS,
    WISH_OUTSIDE,
    WISH_SILENT,
    WISH_UNKNOWN,
)
from thirdhand.core.frame import Record, Vector, as_array, parameters
from thirdhand.core.geometry import turn_between
from thirdhand.core.intake.stage import base_from
from thirdhand.core.skill import MAX_SKILL_DISTANCE_M
from thirdhand.core.skill.model import KNOWN_SIGNS, Target, Wanted
from thirdhand.core.skill.pose import NO_GRIPPER, Turn
from thirdhand.core.skill.skill import Skill, is_inside
from thirdhand.core.skill.stage import SkillStage
from thirdhand.core.tuning import TUNING, Tuning
from thirdhand.core.wish import tuning as fixed
from thirdhand.core.wish.step import lead, newest_due, take
from thirdhand.settings.config import Settings

WHOLE_REACH = np.array([[-MAX_SKILL_DISTANCE_M] * 3, [MAX_SKILL_DISTANCE_M] * 3])
WHOLE_REACH.setflags(write=False)
NO_COVARIANCE = np.zeros((6, 6))
IDENTITY = np.array([0.0, 0.0, 0.0, 1.0])


class WishStage(SkillStage):
    """Wishes as poses with stamps, each due at its stamp; `wishes` is their record in the state.

    With `[skill] blend`, the skill in force and the wishes lead together, each by its certainty.
    Otherwise the skill in force predicts nothing.
    """

    def __init__(
        self, settings: Settings, skill: Skill, wishes: Record, *, tuning: Tuning = TUNING
    ) -> None:
        super().__init__(settings, skill, tuning=tuning)
        self._wishes = as_array(wishes)
        self._blends = settings.skill.blend
        period_s = settings.period_s
        self.wish_rules = parameters(
            period_s=period_s,
            farthest_m=MAX_SKILL_DISTANCE_M,
            norm_tolerance=fixed.WISH_NORM_TOLERANCE,
            nearest_ticks=fixed.NEAREST_S / period_s,
            steady_ticks=tuning.wish.steady_s / period_s,
            leap_m=fixed.LEAP_M,
            leap_mps=fixed.LEAP_MPS,
            leap_ticks=fixed.LEAP_HOLD_S / period_s,
            largest_variance=fixed.LARGEST_VARIANCE,
            fade_rate_per_s=tuning.wish.fade_rate_per_s,
            fade_mps=settings.tool.max_speed,
            rad_as_m=fixed.RAD_AS_M,
            goes_on_s=fixed.GOES_ON_S,
            farthest_s=FARTHEST_WISH_S,
            latest_s=fixed.LATEST_S,
            unknown_std_m=fixed.UNKNOWN_STD[0],
            unknown_std_rad=fixed.UNKNOWN_STD[1],
        )
        self._silent_ticks = settings.skill.silent_ms / 1e3 / period_s
        self._mappings = _mappings(settings)

    def _take(self, skill: Skill) -> None:
        super()._take(skill)
        self.workspace = WHOLE_REACH  # wishes are limited by the arm's reach only

    def take(
        self, tick: int, time_ns: int, wish: PoseStamped | PoseWithCovarianceStamped
    ) -> Cause | None:
        """Take a wish that arrives at a tick of time `time_ns`. A stamp of 0 stands for that time.
        Returns the cause for which it is rejected, or None.
        """
        if (mapping := self._mappings.get(wish.frame_id)) is None:
            return Cause.WRONG_FRAME
        covariance = NO_COVARIANCE
        if isinstance(wish, PoseWithCovarianceStamped):
            covariance = np.array(wish.covariance).reshape(6, 6)
        cause = take(
            self._wishes,
            self.wish_rules,
            tick,
            (wish.stamp_ns - time_ns) / 1e9 if wish.stamp_ns else 0.0,
            wish.position,
            wish.orientation,
            mapping,
            covariance,
        )
        return None if cause < 0 else Cause(cause)

    def request(self, state: Record, frame: Record, conditions: int) -> tuple[Wanted | None, int]:
        """Target of this tick, None if nothing leads, and flags of `codes.Condition`."""
        wanted = None
        flags = 0
        if self._blends:
            wanted, flags = super().request(state, frame, conditions)
        due = newest_due(self._wishes[0])
        if due < 0 or state["tick"] - due > self._silent_ticks:
            if wanted is not None:
                return self._led(state, frame, wanted, BY_SKILL), flags
            if self._blends:
                return None, flags
            return None, WISH_UNKNOWN if due < 0 else WISH_SILENT

        sources = BY_WISHES if wanted is None else BY_WISHES | BY_SKILL
        wanted = self._led(state, frame, wanted, sources)
        begin, end = self._wishes[0]["wish_leap"].tolist()
        leapt = begin <= state["tick"] < end
        inside = is_inside(wanted.target.position, WHOLE_REACH, self.rules[0]["reach"])
        return wanted, WISH_LEADS | WISH_JUMPED * bool(leapt) | WISH_OUTSIDE * (not inside)

    def _led(self, state: Record, frame: Record, by_skill: Wanted | None, sources: int) -> Wanted:
        """The target of what leads, which is written to the frame."""
        lead(self._wishes, self.wish_rules, as_array(frame), int(state["tick"]), sources)
        if by_skill is None:
            frame["closure"] = NO_GRIPPER
            frame["segment"] = -1  # not known
            if not self._blends:
                self._calibrate(state, frame)
        target = Target(
            frame["target"].copy(),
            frame["target_velocity"].copy(),
            frame["target_acceleration"].copy(),
            clamped=False,
        )
        return Wanted(
            target,
            frame["orientation"].copy(),
            frame["turning"].copy(),
            0.0 if by_skill is None else by_skill.gate_m,
            is_ambiguous=False,
            needs_unseen_hand=False,
        )

    def _calibrate(self, state: Record, frame: Record) -> None:
        """Replace the covariance by the calibrated one, and judge whether the policy is unsure."""
        motion = [
            frame[name].copy() for name in ("target", "target_velocity", "target_acceleration")
        ]
        turn = [frame[name].copy() for name in ("orientation", "turning", "orientation_covariance")]
        known = (*motion, frame["covariance"].copy(), 0.0, 0.0, KNOWN_SIGNS)
        self._conclude(as_array(state), as_array(frame), known, Turn(*turn), NO_GRIPPER, 0.0, 0.0)


def wish_frames(settings: Settings) -> tuple[str, ...]:
    """Names of the frames that a wish may have; the empty name stands for `base`."""
    return tuple(
        frame
        for frame in settings.tracker_frames
        if frame in ("", BASE) or settings.hands_in(frame).axes == "right-handed"
    )


def _mappings(settings: Settings) -> dict[str, Vector]:
    """The mapping (4, 4) of poses in each frame that a wish may have to frame base, see `take`."""
    mappings = {BASE: np.eye(4)}
    mappings[BASE][3] = 0.0
    for frame in wish_frames(settings):
        if frame not in mappings and frame:
            of_frame = settings.hands_in(frame)
            mapping = np.zeros((4, 4))
            mapping[:3] = base_from(of_frame)
            turn_between(IDENTITY, np.array(of_frame.base_from_tracker[3:]), mapping[3, :3])
            mappings[frame] = mapping
    return {"": mappings[BASE], **mappings}
