"""The skill as the loop uses it: from the motion of two hands to where the tool should be, how that
moves, and how sure it is.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple, TypeAlias

import numpy as np

from kmp.compiled import compiled
from service.config import Reach, Settings
from service.contract.requests import TOLERANCE_M, ViaPoint
from service.core.frame import Record, Vector, as_array
from service.core.intake.hand_estimator import STILL
from service.core.skill import ORDER
from service.core.skill.hands_kmp import HandsKMP
from service.core.skill.memory import remember
from service.core.skill.model import Model
from service.core.skill.pose import CLOSED, NO_GRIPPER, OPEN, UNKNOWN, LearnedGripper, LearnedOrientation, Turn
from service.core.skill.task_parameterized import TaskParameterized

LARGEST_M = 1e3  # beyond it a target is as good as there
OPEN_BELOW, CLOSE_ABOVE = 0.1, 0.9  # of the closure; between them it stays as it is
MOVES_S = 0.5  # for so long it is let be once it was told to move
THERE_M = 0.01  # a tool that is no farther off is where it is to be


class Target(NamedTuple):
    """Where the tool is to go [m, m/s, m/s²], and whether that is not quite what was asked for."""

    position: Vector
    velocity: Vector
    acceleration: Vector
    clamped: bool


def clamp(position: Vector, velocity: Vector, acceleration: Vector, *, box: Vector, reach: Reach) -> Target:
    """The target (3,) [m], [m/s], [m/s²] brought into the box (2, 3) [m] and the reach.

    Where it was outside, the parts of velocity and acceleration that lead out are removed.
    """
    if _is_inside(position, box, _numbers(reach)):
        return Target(position, velocity, acceleration, clamped=False)
    boxed = np.minimum(np.maximum(position, box[0]), box[1])
    inside = boxed == position
    velocity, acceleration = velocity * inside, acceleration * inside
    reached, outward = _nearest(np.minimum(np.maximum(boxed, -LARGEST_M), LARGEST_M), reach)
    if not outward:
        return Target(boxed, velocity, acceleration, not inside.all())
    return Target(reached, _without(velocity, outward), _without(acceleration, outward), clamped=True)


@functools.cache
def _numbers(reach: Reach) -> Vector:
    """A reach (7,) for `_is_inside`: centre, inner and outer radius, least x and z [m]."""
    return np.array([*reach.centre, reach.inner, reach.outer, reach.min_x, reach.min_z])


@compiled
def _is_inside(position: Vector, box: Vector, reach: Vector) -> bool:
    """Whether a position (3,) [m] lies inside the box (2, 3) and the reach, whose `numbers` are
    given.
    """
    square = 0.0
    for i in range(3):
        if not box[0, i] <= position[i] <= box[1, i]:
            return False
        square += (position[i] - reach[i]) ** 2
    near, far = reach[3] * reach[3], reach[4] * reach[4]
    return bool(near <= square <= far and position[0] >= reach[5] and position[2] >= reach[6])


def is_reachable(position: Vector, reach: Reach) -> bool:
    """Whether a position (3,) [m] lies inside the reach."""
    return not _nearest(position, reach)[1]


def _nearest(point: Vector, reach: Reach) -> tuple[Vector, list[Vector]]:
    """A reachable point near a point, (3,) [m], and the outward normals (3,) of the boundaries that
    it was moved to.
    """
    x, y, z = (point - reach.centre).tolist()
    inner, outer, min_x, floor = reach.inner, reach.outer, reach.min_x - reach.centre[0], reach.min_z - reach.centre[2]
    moved_x, moved_z = x < min_x, z < floor
    x, z = max(x, min_x), max(z, floor)
    distance = math.hypot(x, y, z)
    moved_out = distance > outer
    if moved_out:
        x, y, z = x * outer / distance, y * outer / distance, z * outer / distance
        if x < min_x:
            moved_x = True
            x = min_x
            shrink = math.sqrt(max(outer**2 - x**2, 0.0)) / max(math.hypot(y, z), 1e-12)
            y, z = y * min(shrink, 1.0), z * min(shrink, 1.0)
    distance = math.hypot(x, y, z)
    moved_in = distance < inner
    if moved_in:
        grow = inner / max(distance, 1e-12)
        x, y, z = x * grow, y * grow, z * grow
        if z < floor:
            moved_z = True
            z = floor
            grow = math.sqrt(max(inner**2 - z**2, 0.0)) / max(math.hypot(x, y), 1e-12)
            x, y = x * max(grow, 1.0), y * max(grow, 1.0)
    if not (moved_x or moved_z or moved_out or moved_in):
        return point, []
    radial = np.array([x, y, z]) / max(math.hypot(x, y, z), 1e-12)
    boundaries = (
        (moved_x, np.array([-1.0, 0.0, 0.0])),
        (moved_z, np.array([0.0, 0.0, -1.0])),
        (moved_out, radial),
        (moved_in, -radial),
    )
    return np.array([x, y, z]) + reach.centre, [normal for moved, normal in boundaries if moved]


def _without(vector: Vector, normals: list[Vector]) -> Vector:
    """A vector (3,) without its parts along the outward normals; where two meet, alternating until
    none is left.
    """
    for _ in range(20 if len(normals) > 1 else 1):
        for normal in normals:
            vector = vector - max(float(vector @ normal), 0.0) * normal
    return vector


MODELS: tuple[type[Model], ...] = (HandsKMP, TaskParameterized)
"""All that a skill may predict with."""

Known: TypeAlias = tuple[Vector, Vector, float]
"""What was predicted at the newest sample of a hand: covariances of position (3, 3) [m²] and
orientation (3, 3) [rad²], and the closure of the gripper."""


class Prediction(NamedTuple):
    """Where the tool should be, how that moves, and how sure it is."""

    position: Vector  # (3,) [m]
    velocity: Vector  # (3,) [m/s]
    acceleration: Vector  # (3,) [m/s²]
    covariance: Vector  # (3, 3) [m²]
    gate_m: float  # [m] what is compared with the skill's threshold, see `Model.measure`
    turn: Turn
    closure: float  # of the gripper, 0 (open) to 1 (closed); NO_GRIPPER where the skill has none


@dataclass(frozen=True, eq=False)
class Skill:
    """Immutable: a model of how the tool goes with both hands, and what belongs to it.

    Made by `service.learning`, which learns, adapts and stores it.
    """

    name: str
    model: Model
    orientation: Vector  # (4,) of the tool where none was learned, quaternion x y z w
    workspace: Vector  # (2, 3) lower and upper corner for targets [m]
    threshold: float  # [m] hands whose `gate_m` is above it are far from the demonstrations
    learned_from: str  # hash of the demonstrations
    components: int = 0  # of the mixture that it was learned with, 0 for none
    via_points: tuple[ViaPoint, ...] = ()
    turn: LearnedOrientation | None = None
    gripper: LearnedGripper | None = None
    tolerance: float = TOLERANCE_M  # [m] a reference point nearer to a via-point gives way
    digest: bytes = bytes(16)  # 16 bytes of its file that tell it from any other
    conductor: int | None = None  # side of the hand that conducts alone: the other makes no difference

    def predict(
        self,
        hands: Vector,
        velocities: Vector,
        accelerations: Vector,
        stillness: Vector = STILL,
        *,
        before: Known | None = None,
        past: Vector | None = None,
    ) -> Prediction:
        """The prediction for hands (2, 3) [m] that move so, and are so still (2,).

        Covariances take as long as all else; what was predicted just `before` may be given.
        `past` (ORDER, 2, 3) [m] is the memory of the hands; they have been there all along where it
        is not given.

        Rounded (1 µm, 1 µm/s, 1 µm/s²), so that machines that differ in the last bits agree on all
        that follows.
        """
        stacked = np.empty((3 + ORDER, 2, 3))
        stacked[0], stacked[1], stacked[2] = hands, velocities, accelerations
        stacked[3:] = hands if past is None else past
        if self.conductor is not None:
            stacked[:, 1 - self.conductor] = stacked[:, self.conductor]
            stillness = stillness[[self.conductor] * 2]
        moving, behind = stacked[:3].reshape(3, 6), stacked[3:].reshape(ORDER, 6)
        motion = self.model.predict(moving, stillness, None if before is None else before[0], behind)
        if self.turn is None and self.gripper is None:
            return Prediction(*motion, self.constant_turn, NO_GRIPPER)
        return Prediction(*motion, *self._beside(moving, stillness, behind, before))

    def _beside(self, moving: Vector, stillness: Vector, past: Vector, before: Known | None) -> tuple[Turn, float]:
        """The orientation, learned or constant, and the closure of the gripper."""
        at, velocity = self.model.moving_inputs(moving, stillness, past)
        turn = self.constant_turn
        if self.turn is not None:
            turn = self.turn.predict(at, velocity, covariance=None if before is None else before[1])
        if self.gripper is None or before is not None:
            return turn, NO_GRIPPER if before is None else before[2]
        return turn, self.gripper.predict(at)

    def mean(self, hands: Vector, stillness: Vector | None = None) -> Vector:
        """The tool (T, 3) [m] for hands (T, 6) [m] that are so still (T, 2), or wholly."""
        return self.model.mean(self.conducting(hands), stillness)

    def conducting(self, hands: Vector) -> Vector:
        """Hands (T, 6) [m] of which one that makes no difference is where the other is."""
        if self.conductor is None:
            return hands
        return np.tile(hands[:, 3 * self.conductor : 3 * self.conductor + 3], 2)

    @property
    def hands(self) -> Vector:
        """Hands (M, 6) [m] that it knows."""
        return self.model.hands

    @cached_property
    def constant_turn(self) -> Turn:
        """What is predicted where no orientation was learned."""
        return Turn(np.array(self.orientation, np.float64), np.zeros(3), np.zeros((3, 3)))

    @cached_property
    def demonstrated(self) -> Vector:
        """Least and greatest corner (2, 2, 3) of where it knows the left and the right hand [m]."""
        hands = self.hands.reshape(-1, 2, 3)
        return np.stack([hands.min(axis=0), hands.max(axis=0)])


class Wanted(NamedTuple):
    """What the skill asks for: the target in the workspace, and how the tool is to turn there."""

    target: Target
    orientation: Vector  # (4,) quaternion x y z w
    turning: Vector  # (3,) [rad/s]
    gate_m: float  # what is compared with the skill's threshold


class SkillStage:
    """The skill in force; what it predicted at the newest sample of a hand is kept in the state."""

    def __init__(self, settings: Settings, skill: Skill) -> None:
        self.skill, self._reach, self._period_s = skill, settings.reach, settings.period_s

    def adopt(self, state: Record, skill: Skill) -> None:
        """Another skill from now on."""
        self.skill = skill
        state["skill"] = np.frombuffer(skill.digest, np.uint8)
        state["covariance"], state["orientation_covariance"], state["closure"] = 0.0, 0.0, NO_GRIPPER

    def step(self, state: Record, frame: Record) -> Wanted:
        """What the skill asks for with the hands as they are, which must be known.

        Covariances and the gripper are predicted anew only when a sample of a hand has come.
        """
        remember(as_array(state), self._period_s)
        hands, known, tick = state["hands"], state["covariance"], int(state["tick"])
        is_new = tick in state["hand_ticks"].tolist() or known[0, 0] == 0.0
        before = None if is_new else (known, state["orientation_covariance"], float(state["closure"]))
        found = self.skill.predict(
            hands[:, 0], hands[:, 1], hands[:, 2], state["hand_stillness"], before=before, past=state["memory"]
        )
        if is_new:
            state["covariance"], state["orientation_covariance"] = found.covariance, found.turn.covariance
            state["closure"] = found.closure
        target = clamp(*found[:3], box=self.skill.workspace, reach=self._reach)
        _write(frame, found, target)
        frame["closure"] = state["closure"]
        return Wanted(target, found.turn.orientation, found.turn.velocity, found.gate_m)

    def nothing(self, state: Record, frame: Record) -> None:
        """Into the frame that nothing is predicted: the target is the setpoint."""
        frame["target"], frame["orientation"], frame["closure"] = (
            state["setpoint"][0],
            state["orientation"],
            state["closure"],
        )


def _write(frame: Record, found: Prediction, target: Target) -> None:
    frame["target"], frame["target_velocity"], frame["target_acceleration"] = target[:3]
    frame["covariance"], frame["gate_m"] = found.covariance, found.gate_m
    frame["orientation"], frame["turning"], frame["orientation_covariance"] = found.turn


def decided(gripper: int, closure: float, *, since_s: float = math.inf, off: float = 0.0) -> int:
    """UNKNOWN, OPEN or CLOSED: what becomes of a gripper, which changed so long ago, where such a
    closure is predicted and the tool is so far off [m].

    With hysteresis, and not before it can have moved: what trembles about the middle changes
    nothing. Not on the way: a tool that is late would open or close elsewhere.
    """
    if closure == NO_GRIPPER:
        return gripper
    if gripper == UNKNOWN:
        return CLOSED if closure > 0.5 else OPEN
    if since_s < MOVES_S or off > THERE_M or OPEN_BELOW <= closure <= CLOSE_ABOVE:
        return gripper
    return CLOSED if closure > CLOSE_ABOVE else OPEN
