"""A demonstration: how the tool went with the two hands, checked, and the tool's lag taken out."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from service.contract.messages import BASE
from service.contract.requests import Hands, ViaPoint
from service.core.frame import Vector
from service.learning.skill_file import SkillError

FARTHEST_M, LEAST_M = 5.0, 0.01  # what demonstrations may hold
ALIKE = 0.25  # least correlation of speeds that tells of a lag: steady ones, of noise alone, reach 0.2
LONGEST_LAG_S = 1.0  # of a tool behind the hands
CLOSURE_MARGIN = 0.05  # by which a gripper may be told to be more than open or closed


class Demonstration(NamedTuple):
    """Stamps (T,) [ns], and poses (T, 7) of left hand, right hand and tool, each x y z [m] and
    quaternion x y z w, in one frame; where the named places of its task were, in the order in which
    the tool comes to them; and how far the gripper is closed (T,), 0 to 1, where that is told.

    Where one hand `conducts`, the poses of the other are that one's again. `person` is who
    demonstrated; empty: nobody says so. `begins` are the indices of the first samples behind
    stretches that were left out.
    """

    stamps_ns: NDArray[np.int64]
    left: Vector
    right: Vector
    tool: Vector
    frame: str = BASE
    places: tuple[ViaPoint, ...] = ()
    gripper: Vector | None = None
    conducts: Hands = "both"
    person: str = ""
    begins: tuple[int, ...] = ()

    @property
    def hands(self) -> Vector:
        """Both hands' positions (T, 6) [m]: what a skill predicts from."""
        return np.hstack([self.left[:, :3], self.right[:, :3]])

    @property
    def turns(self) -> Vector:
        """How both hands are turned (T, 18): the rows of their rotation matrices."""
        both = (Rotation.from_quat(part[:, 3:]).as_matrix() for part in (self.left, self.right))
        return np.hstack([matrices.reshape(-1, 9) for matrices in both])

    @property
    def seconds(self) -> Vector:
        """Times since the beginning (T,) [s]."""
        return np.asarray((self.stamps_ns - self.stamps_ns[0]) * 1e-9)

    @property
    def period_s(self) -> float:
        """Mean time from one sample to the next, without the stretches that were left out [s]."""
        lasts_ns = sum(part[-1] - part[0] for part in self.pieces(self.stamps_ns))
        return float(lasts_ns) / 1e9 / max(1, len(self.stamps_ns) - 1 - len(self.begins))

    def pieces(self, values: NDArray[Any]) -> list[NDArray[Any]]:
        """Values (T, ...) of its samples, divided where stretches were left out."""
        return np.split(values, self.begins)

    def by_pieces(self, function: Callable[[Vector], Vector], values: Vector) -> Vector:
        """A function of values (T, ...) of its samples, applied to each piece alone."""
        return np.concatenate([function(part) for part in self.pieces(values)])

    def every(self, step: int) -> Demonstration:
        """The demonstration with one sample of so many."""
        one = Demonstration._make(part[::step] if isinstance(part, np.ndarray) else part for part in self)
        return one._replace(begins=tuple(sorted({-(-begin // step) for begin in self.begins})))


def fingerprint(demonstrations: Iterable[Demonstration]) -> str:
    """The hash by which a skill knows what it was learned from."""
    parts = (
        part.tobytes() for one in demonstrations for part in (one.hands, one.tool, one.gripper) if part is not None
    )
    return hashlib.blake2b(b"".join(parts), digest_size=16).hexdigest()


def groups(demonstrations: Sequence[Demonstration]) -> NDArray[np.intp]:
    """Which demonstrations are left out together (H,), by numbers from 0: those of a person, where
    at least two are named; else each alone.
    """
    people = [one.person or str(i) for i, one in enumerate(demonstrations)]
    if len({one.person for one in demonstrations if one.person}) < 2:
        return np.arange(len(people), dtype=np.intp)
    order = {person: number for number, person in enumerate(dict.fromkeys(people))}
    return np.array([order[person] for person in people], np.intp)


def as_shown(demonstration: Demonstration) -> tuple[Vector, Vector]:
    """Hands (T, 6) and tool (T, 7), which are as many as are learned from.

    Raises SkillError for a demonstration that nothing can be learned from.
    """
    if len({len(part) for part in demonstration[:4]}) > 1:
        counts = ", ".join(f"{len(getattr(demonstration, name))} {name}" for name in Demonstration._fields[:4])
        raise SkillError(f"a demonstration of {counts}: as many of each needed")
    hands, tool, period_s = demonstration.hands, demonstration.tool, demonstration.period_s
    if not (np.isfinite(hands).all() and np.isfinite(tool).all()):
        raise SkillError("a demonstration holds numbers that are not finite")
    if len(hands) < 4 or period_s <= 0 or period_s > LONGEST_LAG_S:
        raise SkillError(f"a demonstration of {len(hands)} samples is too short to learn from")
    if (farthest := max(np.abs(hands).max(), np.abs(tool[:, :3]).max())) > FARTHEST_M:
        raise SkillError(f"a demonstration goes {farthest:.0f} m away: is it in metres?")
    if (np.abs(np.linalg.norm(tool[:, 3:], axis=1) - 1) > 0.01).any():
        raise SkillError("a demonstration's tool orientations are not quaternions of norm 1")
    closure = demonstration.gripper
    if closure is not None and (closure.shape != demonstration.stamps_ns.shape or not np.isfinite(closure).all()):
        raise SkillError(f"a demonstration's gripper has shape {closure.shape}: one finite number a sample needed")
    if closure is not None and (closure.min() < -CLOSURE_MARGIN or closure.max() > 1.0 + CLOSURE_MARGIN):
        raise SkillError(
            f"a demonstration's gripper goes from {closure.min():g} to {closure.max():g}: 0 (open) to 1 (closed) needed"
        )
    return hands, tool


def moved_m(demonstration: Demonstration) -> float:
    """How far hands or tool move along an axis, whichever moves less [m]."""
    return float(min(np.ptp(demonstration.hands, axis=0).max(), np.ptp(demonstration.tool[:, :3], axis=0).max()))


def in_phase(demonstration: Demonstration) -> tuple[Vector, Vector]:
    """Hands (T, 6) and tool (T, 7), shifted against each other where that makes their speeds agree
    better.

    With a tool that lags, one position of the hands would go with two of the tool.
    """
    late = lag(demonstration)
    return demonstration.by_pieces(lambda x: _shifted(x, -late), demonstration.hands), demonstration.by_pieces(
        lambda x: _shifted(x, late), demonstration.tool
    )


def at_the_moment(demonstration: Demonstration, samples: int) -> Vector:
    """The tool (T, 3) [m], its lag left in, when the hands were where they are in so many samples:
    all, or those `in_phase`.
    """
    tool = demonstration.tool[:, :3]
    if samples == len(tool):
        return tool
    late = lag(demonstration)
    return demonstration.by_pieces(lambda x: _shifted(x, -late), tool)


def closure_in_phase(demonstration: Demonstration) -> Vector | None:
    """How far the gripper is closed (T,), shifted as the tool is."""
    closure = demonstration.gripper
    if closure is None:
        return None
    late = lag(demonstration)
    return demonstration.by_pieces(lambda x: _shifted(x, late), closure)


def _shifted(values: Vector, late: int) -> Vector:
    return values[max(0, late) : max(0, len(values) + min(0, late))]


def lag(demonstration: Demonstration) -> int:
    """By how many samples the tool lags behind the hands; less than 0: the hands behind it. 0 where
    they do not move.

    Raises SkillError for a demonstration that nothing can be learned from.
    """
    hands, tool = as_shown(demonstration)
    if moved_m(demonstration) < LEAST_M:
        return 0
    reach = min(int(LONGEST_LAG_S / demonstration.period_s), len(hands) // 4)
    steps = [demonstration.by_pieces(lambda x: np.gradient(x, axis=0), x) for x in (hands, tool[:, :3])]
    speeds = [np.linalg.norm(x, axis=1) for x in steps]
    a, b = (s - s.mean() for s in speeds)
    inner = a[reach : len(a) - reach]
    shifted = [b[reach + shift : len(b) - reach + shift] for shift in range(-reach, reach + 1)]
    score = [float(inner @ speeds) for speeds in shifted]
    best = int(np.argmax(score))
    least = ALIKE * float(np.linalg.norm(inner) * np.linalg.norm(shifted[best]))
    return 0 if score[best] < max(1.02 * score[reach], least) else best - reach
