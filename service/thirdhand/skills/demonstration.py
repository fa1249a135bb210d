"""Demonstrations of a task: both hands and the tool over time, and their checks."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterable, Sequence
from itertools import pairwise
from typing import Any, NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from thirdhand.contract.messages import BASE
from thirdhand.contract.requests import Hands, ViaPoint
from thirdhand.core.frame import Vector
from thirdhand.skills.skill_file import SkillError

FARTHEST_M = 5.0  # positions farther from the origin are refused: their unit is hardly the metre
LEAST_M = 0.01  # if hands or tool move by less along every axis, nothing can be learned
LONGEST_PERIOD_S = 1.0  # samples farther apart on average show no motion
CLOSURE_MARGIN = 0.05  # closures from -0.05 to 1.05 are accepted
NORM_TOLERANCE = 0.01  # accepted deviation of a quaternion's norm from 1
LEAST_SAMPLES = 4  # samples of a demonstration
SITTING_S = 600.0  # after a longer pause, another person may demonstrate
LEAST_SITTINGS = 3  # with fewer, too few demonstrations remain if one sitting is held out


class Demonstration(NamedTuple):
    """Stamps (T,) [ns], poses (T, 7) of left hand, right hand and tool, each x y z [m] and
    quaternion x y z w, in one frame; the via-points of the task in the order of the tool's visits;
    and the gripper's closure (T,) from 0 to 1, if it is known.

    If one hand `conducts` alone, its poses also stand for the other hand. `person` is empty if it
    is unknown. `begins` are the indices of the first samples after stretches that were left out.
    `begun_s` [s] is the time from the request that began the task to the first sample; None without
    a request.
    """

    stamps_ns: NDArray[np.int64]
    left: Vector
    right: Vector
    tool: Vector
    frame: str = BASE
    via_points: tuple[ViaPoint, ...] = ()
    gripper: Vector | None = None
    conducts: Hands = "both"
    person: str = ""
    begins: tuple[int, ...] = ()
    begun_s: float | None = None

    @property
    def hands(self) -> Vector:
        """The positions (T, 6) [m] of left and right hand."""
        return np.hstack([self.left[:, :3], self.right[:, :3]])

    @property
    def turns(self) -> Vector:
        """The entries (T, 18) of both hands' rotation matrices, row by row."""
        rotations = (
            Rotation.from_quat(part[:, 3:]).as_matrix() for part in (self.left, self.right)
        )
        return np.hstack([matrices.reshape(-1, 9) for matrices in rotations])

    @property
    def seconds(self) -> Vector:
        """The times (T,) [s] since the first sample."""
        return np.asarray((self.stamps_ns - self.stamps_ns[0]) * 1e-9)

    @property
    def period_s(self) -> float:
        """The mean time [s] between samples, without the stretches that were left out."""
        lasts_ns = sum(part[-1] - part[0] for part in self.pieces(self.stamps_ns))
        return float(lasts_ns) / 1e9 / max(1, len(self.stamps_ns) - 1 - len(self.begins))

    def pieces(self, values: NDArray[Any]) -> list[NDArray[Any]]:
        """The values (T, ...) of all samples, split where stretches were left out."""
        return np.split(values, self.begins)

    def by_pieces(self, function: Callable[[Vector], Vector], values: Vector) -> Vector:
        """The values of a function that is applied to each piece of the values (T, ...)."""
        return np.concatenate([function(part) for part in self.pieces(values)])

    def every(self, step: int) -> Demonstration:
        """The demonstration with one of every `step` samples."""
        demonstration = Demonstration._make(
            part[::step] if isinstance(part, np.ndarray) else part for part in self
        )
        return demonstration._replace(
            begins=tuple(sorted({-(-begin // step) for begin in self.begins}))
        )


class NamedDemonstration(NamedTuple):
    """A demonstration with its name in the figures."""

    name: str
    demonstration: Demonstration


def fingerprint(demonstrations: Iterable[Demonstration]) -> str:
    """The hash with which a skill names the demonstrations that it was learned from."""
    sums = hashlib.blake2b(digest_size=16)
    for demonstration in demonstrations:
        for part in (demonstration.hands, demonstration.tool, demonstration.gripper):
            if part is not None:
                sums.update(part.tobytes())
    return sums.hexdigest()


def exchanged(demonstration: Demonstration) -> list[Demonstration]:
    """The demonstration with its hands exchanged, and also with those of its via-points, if any."""
    mirrored = demonstration._replace(left=demonstration.right, right=demonstration.left)
    via_points = tuple(
        msgspec.structs.replace(point, left=point.right, right=point.left)
        for point in mirrored.via_points
    )
    return [mirrored, mirrored._replace(via_points=via_points)] if via_points else [mirrored]


def persons(demonstrations: Sequence[Demonstration]) -> list[int]:
    """The number of each demonstration's person, from 0. If fewer than two persons are named, each
    sitting counts as one: demonstrations without a pause of SITTING_S between them; with fewer than
    LEAST_SITTINGS of these, each demonstration has its own number.
    """
    people = [demonstration.person or str(i) for i, demonstration in enumerate(demonstrations)]
    if len({demonstration.person for demonstration in demonstrations if demonstration.person}) < 2:
        people = _sittings(demonstrations)
    order = {person: number for number, person in enumerate(dict.fromkeys(people))}
    return [order[person] for person in people]


def _sittings(demonstrations: Sequence[Demonstration]) -> list[str]:
    """The sitting of each demonstration; its own number if there are too few sittings."""
    in_time = sorted(range(len(demonstrations)), key=lambda i: int(demonstrations[i].stamps_ns[0]))
    out = [""] * len(demonstrations)
    sitting = 0
    for before, after in pairwise([*in_time[:1], *in_time]):
        pause_ns = int(demonstrations[after].stamps_ns[0]) - int(
            demonstrations[before].stamps_ns[-1]
        )
        sitting += pause_ns > 1e9 * SITTING_S
        out[after] = str(sitting)
    return out if sitting + 1 >= LEAST_SITTINGS else [str(i) for i in range(len(demonstrations))]


def check(demonstration: Demonstration) -> None:
    """Raise SkillError if nothing can be learned from a demonstration."""
    if len({len(part) for part in demonstration[:4]}) > 1:
        counts = ", ".join(
            f"{len(getattr(demonstration, name))} {name}" for name in Demonstration._fields[:4]
        )
        raise SkillError(f"a demonstration of {counts}: as many of each needed")
    hands = demonstration.hands
    tool = demonstration.tool
    if not (np.isfinite(hands).all() and np.isfinite(tool).all()):
        raise SkillError("a demonstration holds numbers that are not finite")
    is_timed = 0 < demonstration.period_s <= LONGEST_PERIOD_S
    if len(hands) < LEAST_SAMPLES or not is_timed:
        raise SkillError(f"a demonstration of {len(hands)} samples is too short to learn from")
    if (farthest := max(np.abs(hands).max(), np.abs(tool[:, :3]).max())) > FARTHEST_M:
        raise SkillError(f"a demonstration goes {farthest:.0f} m away: is it in metres?")
    if (np.abs(np.linalg.norm(tool[:, 3:], axis=1) - 1) > NORM_TOLERANCE).any():
        raise SkillError("a demonstration's tool orientations are not quaternions of norm 1")
    if demonstration.gripper is not None:
        _check_gripper(demonstration.gripper, len(hands))


def _check_gripper(closure: NDArray[np.float64], count: int) -> None:
    """Raise SkillError unless the closure has `count` numbers from 0 to 1."""
    if closure.shape != (count,) or not np.isfinite(closure).all():
        raise SkillError(
            f"a demonstration's gripper has shape {closure.shape}: one finite number a sample "
            "needed"
        )
    if closure.min() < -CLOSURE_MARGIN or closure.max() > 1.0 + CLOSURE_MARGIN:
        raise SkillError(
            f"a demonstration's gripper goes from {closure.min():g} to {closure.max():g}: 0 (open) "
            "to 1 (closed) needed"
        )


def moved_m(demonstration: Demonstration) -> float:
    """The range of motion [m] along an axis, of the hands or the tool, whichever is smaller."""
    return float(
        min(
            np.ptp(demonstration.hands, axis=0).max(),
            np.ptp(demonstration.tool[:, :3], axis=0).max(),
        )
    )
