"""Rehearsal of the loop, which compiles or loads all its functions before there are deadlines."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import msgspec
import numpy as np

from kmp import KMP, GaussianKernel, Gaussians
from thirdhand.contract.messages import JointState, PoseStamped
from thirdhand.contract.records import SIDES
from thirdhand.core.arm.stage import ArmStage
from thirdhand.core.controller import Controller
from thirdhand.core.frame import (
    Event,
    Tick,
    Vector,
    as_array,
    blank,
    frame_layout,
    order,
    state_layout,
)
from thirdhand.core.intake.hand_estimator import STILL
from thirdhand.core.intake.stage import Intake
from thirdhand.core.limiter.stage import Limiter, LimiterStage
from thirdhand.core.separation.stage import Separation
from thirdhand.core.setpoint.stage import SetpointStage
from thirdhand.core.setpoint.tracker import waiting
from thirdhand.core.skill import ORDER, TURNS
from thirdhand.core.skill.hands_kmp import HandsKMP
from thirdhand.core.skill.memory import delayed, moving_features, turning
from thirdhand.core.skill.model import Target, Wanted
from thirdhand.core.skill.pose import LearnedGripper, LearnedOrientation
from thirdhand.core.skill.segments import MOST_SEGMENTS
from thirdhand.core.skill.skill import UNTOLD, Skill
from thirdhand.core.skill.stage import SkillStage
from thirdhand.core.skill.support import LocalErrors
from thirdhand.core.skill.unseen import deviation_m
from thirdhand.core.vectors import norm, times
from thirdhand.settings.config import Settings

FLAT: dict[str, Any] = {"kernel": GaussianKernel(1.0), "lambda_mean": 1.0}
FOLLOWED_TICKS = 20  # ticks of the rehearsal with each skill, once the arm's posture is trusted
SAMPLE_EVERY = 5  # ticks between two samples of the hands


def warm_up(settings: Settings, skill: Skill, *, urdf: str) -> None:
    """Run a temporary controller that follows two hands for a moment, then stops.

    Without this, the first hand that a loop receives would delay it by a fifth of a second, or by
    many seconds on a new machine, where the functions are not compiled yet. A skill that is loaded
    later may contain an orientation and a gripper, and may be of another kind. The rehearsal
    therefore runs with and without them, and predicts with a skill without via-points too.
    """
    plain = replace(skill, threshold=math.inf)
    turn = skill.turn or LearnedOrientation(_flat(skill, 3), skill.orientation)
    gripper = skill.gripper or LearnedGripper(_flat(skill, 1))
    extended = replace(plain, turn=turn, gripper=gripper)
    for variant in (plain, extended):
        variant.predict(*np.zeros((3, 2, 3)))
    plain.model.elsewhere(np.zeros((3, 6)), STILL, settings.period_s, *np.zeros((2, MOST_SEGMENTS)))
    primitive = KMP.fit(*_point(np.zeros((1, 6)), 3), **FLAT)
    errors = LocalErrors.of(primitive, np.zeros((1, 6)), np.zeros((1, 3)), 1.0)
    other = replace(plain, model=HandsKMP(primitive, errors=errors, neighbours=0.5))
    other.predict(*np.zeros((3, 2, 3)))
    other.model.mean(np.zeros((1, 6)))
    rehearse_motion(settings, urdf)
    _follow(settings, extended, plain, urdf)


def rehearse_intake(settings: Settings) -> None:
    """Take in one sample of each hand."""
    intake = Intake(settings)
    joints = len(settings.joints.names)
    state = blank(state_layout(joints))
    intake.begin(state)
    sample = PoseStamped(1, "", (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))
    hands = [Event(f"hands/{side}", b"", sample) for side in SIDES]
    intake.step(state, blank(frame_layout(joints)), 1, hands)


def rehearse_motion(settings: Settings, urdf: str) -> None:
    """Move the arm from its posture by the stages after the decision, without a skill; then call
    the functions that the loop needs rarely.

    They run only near the tool's largest speed, on a way out, and with a skill that depends on the
    past or whose teacher was late.
    """
    arm = ArmStage(settings, urdf)
    separation = Separation(settings, urdf)
    setpoint = SetpointStage(settings, arm)
    limiter = LimiterStage(settings, arm)
    posture = np.array(settings.arm.posture)
    still = np.zeros(len(posture))
    state = blank(state_layout(len(posture)))
    frame = blank(frame_layout(len(posture)))
    limiter.begin(state, posture)
    kinematics = arm.at(posture)
    solution = arm.follow(state, kinematics, separation)
    position, velocity, acceleration = np.zeros((3, 3))
    target = Target(position, velocity, acceleration, clamped=False)
    request = Wanted(
        target, np.zeros(4), np.zeros(3), 0.0, is_ambiguous=False, needs_unseen_hand=False
    )
    setpoint.begin(state, frame, kinematics)
    workspace = np.zeros((2, 3))
    workspace.setflags(write=False)
    setpoint.step(state, frame, request, kinematics, workspace, 1.0)
    waiting(target, state["setpoint"], kinematics.position, (0.1, 0.2))
    limiter.step(state, frame, solution.velocity, solution.acceleration, separation)
    separation.step(state, frame, kinematics.record)
    separation.share(still)
    separation.less(still, still)
    norm(times(kinematics.tasks[:3], still))

    joints_limiter = Limiter(settings.joints, settings.period_s)
    joints_limiter.together(posture, still, still, still)
    joints_limiter.speed_in_stop(joints_limiter.stop(posture, still, still), kinematics)
    delayed(np.zeros((3, 6)), np.zeros((ORDER, 6)), 0.1, np.empty((3, 6)))
    turning(np.zeros((TURNS, 18)), 0.1, np.empty((3, 18)))
    moving_features(np.zeros((3, 6)), np.zeros((ORDER, 6)), UNTOLD, np.empty((3, 6 * (1 + ORDER))))


def _follow(settings: Settings, skill: Skill, other: Skill, urdf: str) -> None:
    """Wait for hands, follow two resting ones for FOLLOWED_TICKS with each of two skills, lose
    sight of one, and hold.
    """
    arm = msgspec.structs.replace(settings.arm, source="state")
    settings = msgspec.structs.replace(settings, arm=arm)
    controller = Controller(settings, skill, urdf=urdf)
    names = settings.joints.names
    trusted = int(controller.intake.parameters["still_ticks"][0])
    change = trusted + FOLLOWED_TICKS
    count = trusted + 2 * FOLLOWED_TICKS
    controller.step(Tick(0))
    for index in (*range(1, trusted, SAMPLE_EVERY), *range(trusted, count)):
        stamp_ns = round(1e9 * (1 + index * settings.period_s))
        sample = PoseStamped(stamp_ns, "", (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))
        hands = (
            [Event(f"hands/{side}", b"", sample) for side in SIDES]
            if index % SAMPLE_EVERY == 1
            else []
        )
        measured = Event("joints/state", b"", JointState(stamp_ns, names, settings.arm.posture, ()))
        adopted = [Event("skill", b"", other)] if index == change else []
        wishes = [Event("tool/wish", b"", sample)] if settings.skill.has_wishes else []
        controller.step(Tick(index, (*adopted, *wishes, *hands, measured), stamp_ns))
    # runs only for a hand out of sight
    deviation_m(as_array(controller.state), SkillStage(settings, skill).rules, 0)
    controller.step(Tick(count, (order("begin"), order("hold"))))


def _flat(skill: Skill, outputs: int) -> KMP:
    """Primitive with the skill's input whose outputs are 0 everywhere."""
    return KMP.fit(*_point(skill.model.primitive.inputs[:1], outputs), **FLAT)


def _point(inputs: Vector, outputs: int) -> tuple[Vector, Gaussians]:
    """A reference of one point whose outputs are 0."""
    return inputs, Gaussians(np.zeros((1, outputs)), np.eye(outputs)[None])
