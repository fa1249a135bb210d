"""A demonstration: how the tool went with the two hands, checked, and the tool's lag taken out."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from service.contract.messages import BASE
from service.contract.requests import Hands, ViaPoint
from service.core.frame import Vector
from service.learning.skill_file import SkillError

FARTHEST_M, LEAST_M = 5.0, 0.01  # what demonstrations may hold
ALIKE = 0.25  # least correlation of speeds that tells of a lag: steady ones, of noise alone, reach 0.2
CLOSURE_MARGIN = 0.05  # by which a gripper may be told to be more than open or closed


class Demonstration(NamedTuple):
    """Stamps (T,) [ns], and poses (T, 7) of left hand, right hand and tool, each x y z [m] and
    quaternion x y z w, in one frame; where the named places of its task were, in the order in which
    the tool comes to them; and how far the gripper is closed (T,), 0 to 1, where that is told.

    Where one hand `conducts`, the poses of the other are that one's again.
    """

    stamps_ns: NDArray[np.int64]
    left: Vector
    right: Vector
    tool: Vector
    frame: str = BASE
    places: tuple[ViaPoint, ...] = ()
    gripper: Vector | None = None
    conducts: Hands = "both"

    @property
    def hands(self) -> Vector:
        """Both hands' positions (T, 6) [m]: what a skill predicts from."""
        return np.hstack([self.left[:, :3], self.right[:, :3]])

    @property
    def period_s(self) -> float:
        """Mean time from one sample to the next [s]."""
        return float(self.stamps_ns[-1] - self.stamps_ns[0]) / 1e9 / max(1, len(self.stamps_ns) - 1)

    def every(self, step: int) -> Demonstration:
        """The demonstration with one sample of so many."""
        return Demonstration._make(part[::step] if isinstance(part, np.ndarray) else part for part in self)


def fingerprint(demonstrations: Iterable[Demonstration]) -> str:
    """The hash by which a skill knows what it was learned from."""
    parts = (
        part.tobytes() for one in demonstrations for part in (one.hands, one.tool, one.gripper) if part is not None
    )
    return hashlib.blake2b(b"".join(parts), digest_size=16).hexdigest()


def in_phase(demonstration: Demonstration) -> tuple[Vector, Vector]:
    """Hands (T, 6) and tool (T, 7), shifted against each other where that makes their speeds agree
    better.

    With a tool that lags, one position of the hands would go with two of the tool.
    """
    late, hands = lag(demonstration), demonstration.hands
    return hands[max(0, -late) : len(hands) - max(0, late)], _shifted(demonstration.tool, late)


def closure_in_phase(demonstration: Demonstration) -> Vector | None:
    """How far the gripper is closed (T,), shifted as the tool is."""
    closure = demonstration.gripper
    if closure is None:
        return None
    if closure.shape != demonstration.stamps_ns.shape or not np.isfinite(closure).all():
        raise SkillError(f"a demonstration's gripper has shape {closure.shape}: one finite number a sample needed")
    if closure.min() < -CLOSURE_MARGIN or closure.max() > 1.0 + CLOSURE_MARGIN:
        raise SkillError(
            f"a demonstration's gripper goes from {closure.min():g} to {closure.max():g}: 0 (open) to 1 (closed) needed"
        )
    return _shifted(closure, lag(demonstration))


def _shifted(tool: Vector, late: int) -> Vector:
    return tool[max(0, late) : len(tool) + min(0, late)]


def lag(demonstration: Demonstration, longest_s: float = 1.0) -> int:
    """By how many samples the tool lags behind the hands; less than 0: the hands behind it.

    Raises SkillError for a demonstration that nothing can be learned from.
    """
    if len({len(part) for part in demonstration[:4]}) > 1:
        counts = ", ".join(f"{len(getattr(demonstration, name))} {name}" for name in Demonstration._fields[:4])
        raise SkillError(f"a demonstration of {counts}: as many of each needed")
    hands, tool, period_s = demonstration.hands, demonstration.tool, demonstration.period_s
    if not (np.isfinite(hands).all() and np.isfinite(tool).all()):
        raise SkillError("a demonstration holds numbers that are not finite")
    if len(hands) < 4 or period_s <= 0 or int(longest_s / period_s) < 1:
        raise SkillError(f"a demonstration of {len(hands)} samples is too short to learn from")
    reach = min(int(longest_s / period_s), len(hands) // 4)
    if (farthest := max(np.abs(hands).max(), np.abs(tool[:, :3]).max())) > FARTHEST_M:
        raise SkillError(f"a demonstration goes {farthest:.0f} m away: is it in metres?")
    if min(np.ptp(hands, axis=0).max(), np.ptp(tool[:, :3], axis=0).max()) < LEAST_M:
        raise SkillError(
            f"a demonstration in which hands or tool move by less than {1000 * LEAST_M:.0f} mm teaches nothing"
        )
    if (np.abs(np.linalg.norm(tool[:, 3:], axis=1) - 1) > 0.01).any():
        raise SkillError("a demonstration's tool orientations are not quaternions of norm 1")
    speeds = [np.linalg.norm(np.gradient(x, axis=0), axis=1) for x in (hands, tool[:, :3])]
    a, b = (s - s.mean() for s in speeds)
    inner = a[reach : len(a) - reach]
    shifted = [b[reach + shift : len(b) - reach + shift] for shift in range(-reach, reach + 1)]
    score = [float(inner @ speeds) for speeds in shifted]
    best = int(np.argmax(score))
    least = ALIKE * float(np.linalg.norm(inner) * np.linalg.norm(shifted[best]))
    return 0 if score[best] < max(1.02 * score[reach], least) else best - reach
