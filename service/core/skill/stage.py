"""The skill in force, asked at each tick; its prediction brought to where a target may be."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from service.config import Settings
from service.core.record import Record, Vector
from service.core.skill.pose import NO_GRIPPER
from service.core.skill.skill import Prediction, Skill
from service.core.skill.workspace import Target, clamp


class Wanted(NamedTuple):
    """What the skill asks for: the target in the workspace, and how the tool is to turn there."""

    target: Target
    orientation: Vector  # (4,) quaternion x y z w
    turning: Vector  # (3,) [rad/s]
    gate_m: float  # what is compared with the skill's threshold


class SkillStage:
    """The skill in force; what it predicted at the newest sample of a hand is kept in the state."""

    def __init__(self, settings: Settings, skill: Skill) -> None:
        self.skill, self._reach = skill, settings.reach

    def adopt(self, state: Record, skill: Skill) -> None:
        """Another skill from now on."""
        self.skill = skill
        state["skill"] = np.frombuffer(skill.digest, np.uint8)
        state["covariance"], state["orientation_covariance"], state["closure"] = 0.0, 0.0, NO_GRIPPER

    def step(self, state: Record, frame: Record) -> Wanted:
        """What the skill asks for with the hands as they are, which must be known.

        Covariances and the gripper are predicted anew only when a sample of a hand has come.
        """
        hands, known, tick = state["hands"], state["covariance"], int(state["tick"])
        is_new = tick in state["hand_ticks"].tolist() or known[0, 0] == 0.0
        before = None if is_new else (known, state["orientation_covariance"], float(state["closure"]))
        found = self.skill.predict(hands[:, 0], hands[:, 1], hands[:, 2], state["hand_stillness"], before=before)
        if is_new:
            state["covariance"], state["orientation_covariance"] = found.covariance, found.turn.covariance
            state["closure"] = found.closure
        target = clamp(*found[:3], box=self.skill.workspace, reach=self._reach)
        _write(frame, found, target)
        frame["closure"] = state["closure"]
        return Wanted(target, found.turn.orientation, found.turn.velocity, found.deviation)

    def nothing(self, state: Record, frame: Record) -> None:
        """Into the frame that nothing is predicted: the target is the setpoint."""
        frame["target"], frame["orientation"], frame["closure"] = (
            state["setpoint"][0],
            state["orientation"],
            state["closure"],
        )


def _write(frame: Record, found: Prediction, target: Target) -> None:
    frame["target"], frame["target_velocity"], frame["target_acceleration"] = target[:3]
    frame["covariance"], frame["gate_m"] = found.covariance, found.deviation
    frame["orientation"], frame["turning"], frame["orientation_covariance"] = found.turn
