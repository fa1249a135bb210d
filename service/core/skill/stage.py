"""The core's stage of the skill: predict the tool at each sample of a hand."""

from __future__ import annotations

import numpy as np

from service.core.frame import Record, as_array, parameters
from service.core.numerics import UNPRIMED_DECIDED
from service.core.skill import ORDER
from service.core.skill.memory import remember, turn_lag_s
from service.core.skill.model import Target, Wanted
from service.core.skill.pose import NO_GRIPPER
from service.core.skill.skill import NEVER, Skill, clamp, reach_of
from service.core.skill.step import IS_AMBIGUOUS, IS_OUTSIDE, conclude, tell_stage
from service.core.skill.task_clock import move
from service.core.skill.tuning import MEMORY_LAG_S, MEMORY_LONGEST_STEP_S, UNSURE_M
from service.core.skill.unseen import off_m
from service.settings.config import Settings


class SkillStage:
    """Skill in force; its prediction at the newest sample of a hand is kept in the state."""

    def __init__(self, settings: Settings, skill: Skill) -> None:
        self._reach, self._period_s, self._lead_s = settings.reach, settings.period_s, settings.skill.lead_s
        self._take(skill)

    def _take(self, skill: Skill) -> None:
        """Put a skill into force, with the time constant of the hands' memory that it needs."""
        self.skill = skill
        delay_s = max(skill.model.delay_s - self._lead_s, 0.0)
        self._lag_s = MEMORY_LAG_S if skill.model.remembers else delay_s / ORDER
        self._turn_lag_s = turn_lag_s(delay_s if skill.model.turned else 0.0)
        self._clock, side = skill.model.clock_rows, skill.conductor
        self._sides = np.array([0, 1] if side is None else [side, side])
        regions = skill.regions
        self._doubts = regions.alarm > 0.0 and bool(skill.model.names)
        self._rules = parameters(
            period_s=self._period_s,
            workspace=skill.workspace,
            reach=reach_of(self._reach),
            scale=regions.scale,
            std_s=regions.std_s,
            ratios=regions.ratios,
            alarm=regions.alarm,
        )

    def adopt(self, state: Record, skill: Skill) -> None:
        """Replace the skill. The belief is kept if the new skill has the same via-points, the
        memory of the hands if it has the same filters, and the clock if it has the same clock.
        """
        if skill.model.names != self.skill.model.names:
            state["stage_belief"] = state["unprimed_belief"] = 0.0
        before, turn_before_s = self.skill.model, self._turn_lag_s
        if skill.model.clock != before.clock:
            state["task_clock"] = 0.0
        self._take(skill)
        is_same = skill.model.remembers == before.remembers and skill.model.delay_s == before.delay_s
        if not is_same or self._turn_lag_s != turn_before_s:
            state["memory_ticks"] = -1
        state["skill"] = np.frombuffer(skill.digest, np.uint8)
        state["covariance"], state["orientation_covariance"], state["closure"] = 0.0, 0.0, NO_GRIPPER
        state["trail_tick"], state["sure_tick"] = NEVER, state["tick"]

    def step(self, state: Record, frame: Record, unseen: int | None = None) -> Wanted:
        """Request of the skill for the hands in the state, which must be known; `unseen` is the
        side of a hand that is not seen now. Covariances and closure are computed at new samples
        only.
        """
        self._count(state)
        remember(as_array(state), self._period_s, self._lag_s, self._turn_lag_s)
        hands, known, tick = state["hands"], state["covariance"], int(state["tick"])
        is_new, before = tick in state["hand_ticks"].tolist() or known[0, 0] == 0.0, None
        if not is_new:
            before = known, state["orientation_covariance"], float(state["closure"]), float(state["known_gate_m"])
        found = self.skill.predict(
            hands[:, 0],
            hands[:, 1],
            hands[:, 2],
            state["hand_stillness"],
            before=before,
            past=state["memory"],
            turns=state["turns"],
            belief=state["stage_belief"],
            period_s=self._period_s,
            lead_s=self._lead_s,
            clock=state["task_clock"],
        )
        if is_new:
            state["covariance"], state["orientation_covariance"] = found.covariance, found.turn.covariance
            state["closure"], state["known_gate_m"] = found.closure, found.gate_m
        frame["orientation"], frame["turning"], frame["orientation_covariance"] = found.turn
        off = 0.0 if unseen is None else off_m(self.skill, state, unseen, self._period_s)
        doubt = self._doubt_of_start(state) if self._doubts else 0.0
        outcome = conclude(as_array(state), as_array(frame), self._rules, found[:6], found.closure, off, doubt)
        target = Target(*found[:3], clamped=False)
        if outcome & IS_OUTSIDE:
            target = clamp(*found[:3], box=self.skill.workspace, reach=self._reach)
            frame["target"], frame["target_velocity"], frame["target_acceleration"] = target[:3]
        is_ambiguous = bool(outcome & IS_AMBIGUOUS)
        return Wanted(target, found.turn.orientation, found.turn.velocity, found.gate_m, is_ambiguous, off > UNSURE_M)

    def _count(self, state: Record) -> None:
        """Advance the clock of the task to this tick, if the skill has one. While a hand is not
        seen, it waits.
        """
        if self._clock is None:
            return
        before = int(state["memory_ticks"].max())
        passed_s = self._period_s if before < 0 else (int(state["tick"]) - before) * self._period_s
        move(as_array(state), self._sides, min(passed_s, MEMORY_LONGEST_STEP_S), self._clock)

    def _doubt_of_start(self, state: Record) -> float:
        """Probability that the task did not begin at its first stage."""
        unprimed = state["unprimed_belief"]
        if unprimed[0] == UNPRIMED_DECIDED:
            return 0.0
        return self.skill.elsewhere(
            state["hands"], state["hand_stillness"], self._period_s, state["stage_belief"], unprimed
        )

    def set_stage(self, state: Record, name: str) -> None:
        """Set the belief to the stage that begins at the via-point of this name (at the last
        via-point, the stage that ends there). Unknown names are ignored.
        """
        if name in (names := self.skill.model.names):
            state["stage_belief"], state["unprimed_belief"] = 0.0, UNPRIMED_DECIDED
            state["stage_belief"][min(names.index(name), len(names) - 2)] = 1.0

    def nothing(self, state: Record, frame: Record) -> None:
        """Write into the frame that nothing is predicted: the target is the setpoint."""
        state["unsure"], state["sure_tick"] = 0, state["tick"]
        frame["target"], frame["orientation"] = state["setpoint"][0], state["orientation"]
        frame["closure"] = state["closure"]
        tell_stage(as_array(state), as_array(frame))
