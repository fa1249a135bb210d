"""Skill stage: predict the tool at each sample of a hand."""

from __future__ import annotations

from typing import Any

import numpy as np

from thirdhand.core.codes import (
    EITHER_UNSEEN,
    HANDS_KNOWN,
    SEGMENT_AMBIGUOUS,
    UNSEEN,
    UNSEEN_HAND_NEEDED,
)
from thirdhand.core.frame import Record, Records, as_array, parameters
from thirdhand.core.numerics import UNPRIMED_DECIDED
from thirdhand.core.skill import ORDER, TURNS
from thirdhand.core.skill.memory import recall, turn_lag_s
from thirdhand.core.skill.model import Seen, Target, Wanted
from thirdhand.core.skill.pose import NO_GRIPPER, Turn
from thirdhand.core.skill.skill import NEVER, Skill, clamp, reach_of
from thirdhand.core.skill.step import IS_AMBIGUOUS, IS_OUTSIDE, conclude, tell_segment
from thirdhand.core.skill.task_clock import BEGUN_TICK, GONE, PROGRESS, forget, is_requested, move
from thirdhand.core.skill.tuning import MEMORY_LAG_S, UNSURE_M
from thirdhand.core.skill.unseen import deviation_m, off_m
from thirdhand.core.tuning import TUNING, Tuning
from thirdhand.settings.config import Settings


class SkillStage:
    """Skill in force; its prediction at the newest sample of a hand is kept in the state."""

    def __init__(self, settings: Settings, skill: Skill, *, tuning: Tuning = TUNING) -> None:
        self._hands = tuning.intake
        self._reach = settings.reach
        self._period_s = settings.period_s
        self._lead_s = settings.skill.lead_s
        self._take(skill)

    def _take(self, skill: Skill) -> None:
        """Put a skill into force, with the time constant of the hands' memory that it needs."""
        self.skill = skill
        self.workspace = skill.workspace
        late_s = skill.model.delay_s - self._lead_s
        delay_s = max(late_s, 0.0)
        memory = np.empty((ORDER, 6))
        turns = np.empty((TURNS, 18))
        still = np.empty(2)
        # `recall` writes to this; belief and clock are those of the state
        self._seen = Seen(
            np.empty((3, 6)),
            still,
            memory,
            turns,
            turn_lag_s(late_s),
            np.empty((3, 6)),
            np.empty(0),
            self._period_s,
        )
        self._lag_s = MEMORY_LAG_S if skill.model.remembers else delay_s / ORDER
        self._turn_lag_s = turn_lag_s(delay_s if skill.model.turned else 0.0)
        self._clock = skill.model.clock_rows
        self._is_requested = is_requested(skill.model.clock)
        side = skill.conductor
        self._sides = np.array([0, 1] if side is None else [side, side])
        regions = skill.regions
        self._doubts = regions.alarm > 0.0 and bool(skill.model.names)
        self.rules = parameters(
            period_s=self._period_s,
            end_share=self._hands.end_share,
            mode_prior=self._hands.mode_prior,
            mode_switch_rate=max(self._hands.mode_switch_rates_per_s),
            lag_s=self._lag_s,
            turn_lag_s=self._turn_lag_s,
            late_s=late_s,
            sides=self._sides,
            workspace=skill.workspace,
            reach=reach_of(self._reach),
            scale=regions.scale,
            std_s=regions.std_s,
            weights=regions.weights,
            alarm=regions.alarm,
        )

    def adopt(self, state: Record, skill: Skill) -> None:
        """Replace the skill. The belief is kept if the new skill has the same via-points, the
        memory of the hands if it has the same filters, and the clock if it has the same clock.
        """
        if skill.model.names != self.skill.model.names:
            state["segment_belief"] = state["unprimed_belief"] = 0.0
        before = self.skill.model
        turn_before_s = self._turn_lag_s
        if skill.model.clock != before.clock:
            state["task_clock"] = 0.0
        self._take(skill)
        is_same = (
            skill.model.remembers == before.remembers and skill.model.delay_s == before.delay_s
        )
        if not is_same or self._turn_lag_s != turn_before_s:
            state["memory_ticks"] = -1
        state["skill"] = np.frombuffer(skill.digest, np.uint8)
        state["covariance"] = 0.0
        state["orientation_covariance"] = 0.0
        state["closure"] = NO_GRIPPER
        state["sure_tick"] = state["tick"]
        state["trail_tick"] = NEVER

    def request(self, state: Record, frame: Record, conditions: int) -> tuple[Wanted | None, int]:
        """Request of the skill for the hands, None if they are not known, and flags of
        `codes.Condition`. `conditions` are those that the intake determines.
        """
        if not conditions & HANDS_KNOWN:
            return None, 0
        flag = conditions & EITHER_UNSEEN
        wanted = self.step(state, frame, UNSEEN.index(flag) if flag else None)
        return wanted, (
            SEGMENT_AMBIGUOUS * wanted.is_ambiguous | UNSEEN_HAND_NEEDED * wanted.needs_unseen_hand
        )

    def step(self, state: Record, frame: Record, unseen: int | None = None) -> Wanted:
        """Request of the skill for the hands in the state, which must be known; `unseen` is the
        side of a hand that is not seen now. Covariances and closure are computed at new samples
        only. The doubt is the probability that the task did not begin at its first segment.
        """
        states = as_array(state)
        frames = as_array(frame)
        rules = self.rules
        if self._clock is not None:
            move(states, self._sides, self._period_s, self._clock)
        motion = Seen(*self._seen[:6], state["segment_belief"], self._period_s, state["task_clock"])
        is_new = recall(states, rules, motion)

        before = None
        covariance = state["covariance"]
        if not is_new:
            before = (
                covariance,
                state["orientation_covariance"],
                float(states["closure"][0]),
                float(states["known_gate_m"][0]),
            )
        prediction = self.skill.predicted(motion, before)
        if is_new:
            state["known_gate_m"] = prediction.gate_m

        error_m = 0.0
        if unseen is not None:
            columns = [3 * n for n, side in enumerate(self._sides) if side == unseen]
            # only positions are compared: the rest is passed, so that it is not computed again
            earlier = (
                prediction.covariance,
                prediction.turn.covariance,
                prediction.closure,
                prediction.gate_m,
            )
            deviation = deviation_m(states, rules, unseen)
            error_m = off_m(
                lambda hands: self.skill.predicted(hands, earlier).position,
                motion,
                columns,
                deviation,
            )

        doubt = 0.0
        unprimed = state["unprimed_belief"]
        if self._doubts and unprimed[0] != UNPRIMED_DECIDED:
            doubt = self.skill.model.elsewhere(
                motion.now, motion.stillness, self._period_s, motion.belief, unprimed
            )

        outcome = self._conclude(
            states, frames, prediction[:7], prediction.turn, prediction.closure, error_m, doubt
        )
        target = Target(*prediction[:3], clamped=False)
        if outcome & IS_OUTSIDE:
            target = clamp(*prediction[:3], box=self.skill.workspace, reach=self._reach)
            frame["target"], frame["target_velocity"], frame["target_acceleration"] = target[:3]
        is_ambiguous = bool(outcome & IS_AMBIGUOUS)
        return Wanted(
            target,
            prediction.turn.orientation,
            prediction.turn.velocity,
            prediction.gate_m,
            is_ambiguous,
            error_m > UNSURE_M,
        )

    def _conclude(
        self,
        states: Records,
        frames: Records,
        motion: tuple[Any, ...],
        turn: Turn,
        closure: float,
        error_m: float,
        doubt: float,
    ) -> int:
        """`step.conclude` by this skill's rules."""
        return int(conclude(states, frames, self.rules, motion, turn, closure, error_m, doubt))

    def begin(self, state: Record) -> None:
        """Begin the task anew. A clock that is REQUESTED starts; another one starts as the hands
        move.
        """
        forget(as_array(state))
        state["task_clock"] = 0.0
        if self._is_requested:
            state["task_clock"][BEGUN_TICK] = state["tick"]
            state["task_clock"][PROGRESS] = GONE

    def set_segment(self, state: Record, name: str) -> None:
        """Set the belief to the segment that begins at the via-point of this name (at the last
        via-point, the segment that ends there). Unknown names are ignored.
        """
        if name in (names := self.skill.model.names):
            state["segment_belief"] = 0.0
            state["unprimed_belief"] = UNPRIMED_DECIDED
            state["segment_belief"][min(names.index(name), len(names) - 2)] = 1.0

    def nothing(self, state: Record, frame: Record) -> None:
        """Write into the frame that nothing is predicted: the target is the setpoint."""
        state["sure_tick"] = state["tick"]
        state["unsure"] = 0
        frame["target"] = state["setpoint"][0]
        frame["orientation"] = state["orientation"]
        frame["closure"] = state["closure"]
        tell_segment(as_array(state), as_array(frame))
