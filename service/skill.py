"""A skill: how the tool goes with the user's two hands, learned from demonstrations and adapted to taught places."""

from __future__ import annotations

import hashlib
import io
import math
import pickle
import warnings
import zipfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, NamedTuple

import msgspec
import numpy as np
from numpy.typing import ArrayLike

from kmp import KMP, GaussianKernel, GaussianMixture, Gaussians, ViaPointMissed
from service.config import ExplainedError
from service.frame import Vector
from service.wire import TaughtPoint, ViaPoint

FORMAT = 1
MARGIN_M = 0.25  # by which targets may leave the demonstrated box
FARTHEST_M, LEAST_M = 5.0, 0.01  # what demonstrations may hold
GATE = 2.0  # times the largest deviation along a demonstration that was held out is off the data


class SkillError(ExplainedError, ValueError):
    """A skill that cannot be read, learned or adapted."""


class Prediction(NamedTuple):
    """Where the tool should be, how that moves, and how sure it is."""

    position: Vector  # (3,) [m]
    velocity: Vector  # (3,) [m/s]
    acceleration: Vector  # (3,) [m/s²]
    covariance: Vector  # (3, 3) [m²]
    deviation: float  # root mean square over the axes [m]


@dataclass(frozen=True, eq=False)
class Skill:
    """Immutable: a KMP from both hands' positions (6 inputs [m]) to the tool's (3 outputs [m]), and what belongs to it."""

    name: str
    primitive: KMP
    orientation: Vector  # (4,) of the tool, quaternion x y z w
    box: Vector  # (2, 3) lower and upper corner for targets [m]
    threshold: float  # [m] a deviation above it is far from the demonstrations
    learned_from: str  # hash of the demonstrations
    components: int = 0
    places: tuple[ViaPoint, ...] = ()
    tolerance: float = 0.05  # [m] a reference point nearer to a place gives way
    known: bytes = field(default=b"", repr=False)

    def predict(self, hands: Vector, velocities: Vector, accelerations: Vector, *, covariance: Vector | None = None) -> Prediction:
        """The prediction for hands (2, 3) [m] that move so. Equation (8) of Huang et al. 2019, its derivatives along the motion, its covariance.

        The covariance takes as long as all else; one that was predicted just before may be given (3, 3) [m²].

        Rounded (1 µm, 1 µm/s, 1 µm/s²), so that machines that differ in the last bits agree on all that follows.
        """
        v, a = velocities.reshape(6), accelerations.reshape(6)
        found = self.primitive.predict_motion(hands.reshape(6), v, a, covariance=covariance is None)
        if found.covariance is not None:
            covariance = np.round(found.covariance, 10)
        assert covariance is not None
        jacobian = np.round(found.jacobian, 6)
        return Prediction(
            np.round(found.mean, 6),
            np.round(jacobian @ v, 6),
            np.round(jacobian @ a + found.curvature, 6),
            covariance,
            math.sqrt(float(np.trace(covariance)) / 3),
        )

    def clamp(self, position: Vector) -> Vector:
        """The nearest position (3,) inside the box [m]."""
        return np.asarray(np.minimum(np.maximum(position, self.box[0]), self.box[1]))

    def adapted(self, places: Sequence[ViaPoint], *, tolerance: float) -> Skill:
        """A new skill that goes through these places and no others (Algorithm 1 of the paper, from the base). Raises SkillError."""
        try:
            inputs, outputs, deviations = _points(places)
            desired = Gaussians(outputs, deviations[:, None, None] ** 2 * np.eye(3))
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", ViaPointMissed)  # `taught` tells by how much
                primitive = self.primitive.base.adapt(inputs, desired, tolerance=tolerance)
        except ValueError as error:
            raise SkillError(f"cannot adapt to {[p.name for p in places]}: {error}") from None
        return replace(self, primitive=primitive, places=tuple(places), tolerance=tolerance, known=b"")

    def taught(self) -> tuple[TaughtPoint, ...]:
        """The places in force, each with the distance by which the skill misses it [m]."""
        return tuple(
            TaughtPoint(**msgspec.structs.asdict(place), missed_by_m=math.dist(place.tool, self.primitive.mean([[*place.left, *place.right]])[0]))
            for place in self.places
        )

    @cached_property
    def digest(self) -> bytes:
        """16 bytes that tell this skill from any other."""
        return hashlib.blake2b(self.to_bytes(), digest_size=16).digest()

    def to_bytes(self) -> bytes:
        """The skill as an .npz file without pickle: weights, base and via-points apart, and their units."""
        if self.known:
            return self.known
        out = io.BytesIO()
        arrays: dict[str, Any] = dict(
            format=np.array(FORMAT),
            units=np.array("inputs: left x y z, right x y z [m]; outputs: tool x y z [m]; frame base"),
            name=np.array(self.name),
            orientation=self.orientation,
            box=self.box,
            threshold=np.array(self.threshold),
            learned_from=np.array(self.learned_from),
            components=np.array(self.components),
            places=np.array(msgspec.json.encode(self.places).decode()),
            tolerance=np.array(self.tolerance),
            **self.primitive.to_arrays(),
        )
        np.savez(out, allow_pickle=False, **arrays)
        self.__dict__["known"] = out.getvalue()
        return self.known

    @classmethod
    def from_bytes(cls, data: bytes, *, origin: str) -> Skill:
        """The skill in the bytes of an .npz file; `origin` names it in errors. Raises SkillError."""
        try:
            with np.load(io.BytesIO(data), allow_pickle=False) as archive:
                if not isinstance(archive, np.lib.npyio.NpzFile):
                    raise SkillError(f"{origin}: not a skill (no .npz archive)")
                arrays = dict(archive)
            if (kind := arrays["format"].item()) != FORMAT:
                raise SkillError(f"{origin}: skill of format {kind}, {FORMAT} needed")
            if not all(np.isfinite(arrays[name]).all() for name in ("weights", "base_weights")):
                raise SkillError(f"{origin}: weights that are not all finite")
            primitive = KMP.from_arrays(arrays)
            skill = cls(
                name=str(arrays["name"]),
                primitive=primitive,
                orientation=arrays["orientation"],
                box=arrays["box"],
                threshold=float(arrays["threshold"]),
                learned_from=str(arrays["learned_from"]),
                components=int(arrays["components"]),
                places=msgspec.json.decode(str(arrays["places"]), type=tuple[ViaPoint, ...]),
                tolerance=float(arrays["tolerance"]),
                known=bytes(data),
            )
        except SkillError:
            raise
        except KeyError as error:
            raise SkillError(f"{origin}: not a skill (the array {error} is missing)") from None
        except (pickle.UnpicklingError, zipfile.BadZipFile):
            raise SkillError(f"{origin}: not a skill (no .npz archive)") from None
        except Exception as error:  # what a damaged archive may raise is not documented by anyone
            raise SkillError(f"{origin}: not a skill ({error})") from None
        for wrong in skill._faults():
            raise SkillError(f"{origin}: {wrong}")
        return skill

    def _faults(self) -> Iterator[str]:
        """What in the file would harm the motion."""
        if (self.primitive.inputs.shape[1], self.primitive.outputs) != (6, 3):
            yield f"{self.primitive.inputs.shape[1]} inputs and {self.primitive.outputs} outputs, 6 and 3 needed"
        if not (math.isfinite(self.threshold) and self.threshold > 0):
            yield f"threshold is {self.threshold}, a number above 0 needed"
        if self.box.shape != (2, 3) or not (self.box[0] < self.box[1]).all() or not np.isfinite(self.box).all():
            yield f"box is {self.box.tolist()}, lower and upper corner needed"
        if self.orientation.shape != (4,) or not abs(np.linalg.norm(self.orientation) - 1) < 1e-6:
            yield f"orientation is {self.orientation.tolist()}, a quaternion x y z w of norm 1 needed"


def _points(places: Sequence[ViaPoint]) -> tuple[Vector, Vector, Vector]:
    """Inputs (V, 6), outputs (V, 3) and standard deviations (V,) of places: each a point, or a point and its twelve neighbours."""
    inputs: list[Vector] = []
    outputs: list[Vector] = []
    deviations: list[float] = []
    follow = {"none": np.zeros((3, 6)), "left": np.eye(3, 6), "right": np.eye(3, 6, 3)}
    for place in places:
        steps = place.radius * np.concatenate([np.zeros((1, 6)), np.eye(6), -np.eye(6)]) if place.radius else np.zeros((1, 6))
        inputs.extend(np.array([*place.left, *place.right]) + steps)
        outputs.extend(np.array(place.tool) + steps @ follow[place.follow].T)
        deviations.extend([place.std] * len(steps))
    return np.array(inputs).reshape(-1, 6), np.array(outputs).reshape(-1, 3), np.array(deviations)


# --- learning --------------------------------------------------------------------------------------------------------------


class Demonstrated(NamedTuple):
    """One demonstration at common times: hands (T, 6) and tool (T, 7), seconds apart by `period_s`."""

    hands: Vector
    tool: Vector
    period_s: float


def learn(
    demonstrations: Sequence[Demonstrated],
    *,
    name: str = "skill",
    components: int = 10,
    points: int = 200,
    ell: float = 5.0,
    penalty: float = 2.0,
    spread_m: float = 0.01,
    seed: int = 0,
    progress: Callable[[str], None] = lambda line: None,
) -> Skill:
    """The skill of some demonstrations: a mixture (EM), its regression at sampled inputs, a KMP. Raises SkillError.

    ell [1/m²] and penalty (lambda) as in the paper, in metres; `spread_m` is added to the reference's standard deviation.
    """
    if not demonstrations:
        raise SkillError("no demonstrations given, at least 1 needed")
    pairs = [_in_phase(demonstration) for demonstration in demonstrations]

    def fitted(samples: Vector) -> KMP:
        try:
            mixture = GaussianMixture.fit(samples, components=components, seed=seed)
            inputs = mixture.sample_inputs(points, dimensions=6, seed=seed)
            reference = mixture.regress(inputs)
            reference = Gaussians(reference.mean, reference.covariance + spread_m**2 * np.eye(3))
            return KMP.fit(inputs, reference, kernel=GaussianKernel(ell), lambda_mean=penalty, prior_mean=samples[:, 6:].mean(axis=0))
        except ValueError as error:
            raise SkillError(f"cannot learn from {len(samples)} samples: {error}") from None

    each = [np.hstack([hands, tool[:, :3]]) for hands, tool in pairs]
    samples = np.concatenate(each)
    deviations = []
    for i, held_out in enumerate(each):
        progress(f"holding out demonstration {i + 1} of {len(each)}")
        others = np.concatenate(each[:i] + each[i + 1 :]) if len(each) > 1 else held_out
        covariance = fitted(others).predict(held_out[:, :6]).covariance
        deviations.append(np.sqrt(np.trace(covariance, axis1=1, axis2=2) / 3).max())
    progress(f"learning from all {len(each)}")
    return Skill(
        name=name,
        primitive=fitted(samples),
        orientation=mean_orientation(np.concatenate([tool[:, 3:] for _, tool in pairs])),
        box=np.stack([samples[:, 6:].min(axis=0) - MARGIN_M, samples[:, 6:].max(axis=0) + MARGIN_M]),
        threshold=float(GATE * max(deviations)),
        learned_from=hashlib.blake2b(b"".join(d.hands.tobytes() + d.tool.tobytes() for d in demonstrations), digest_size=16).hexdigest(),
        components=components,
    )


def _in_phase(demonstration: Demonstrated, longest_s: float = 1.0) -> tuple[Vector, Vector]:
    """Hands and tool, shifted against each other where that makes their speeds agree better: a tool that lags makes the map no function."""
    hands, tool, period_s = demonstration
    if len(hands) != len(tool):
        raise SkillError(f"a demonstration of {len(hands)} hand and {len(tool)} tool samples, as many of each needed")
    if not (np.isfinite(hands).all() and np.isfinite(tool).all()):
        raise SkillError("a demonstration holds numbers that are not finite")
    reach = min(int(longest_s / period_s), len(hands) // 4)
    if reach < 1:
        raise SkillError(f"a demonstration of {len(hands)} samples is too short to learn from")
    if max(np.abs(hands).max(), np.abs(tool[:, :3]).max()) > FARTHEST_M:
        raise SkillError(f"a demonstration goes {max(np.abs(hands).max(), np.abs(tool[:, :3]).max()):.0f} m away: is it in metres?")
    if min(np.ptp(hands, axis=0).max(), np.ptp(tool[:, :3], axis=0).max()) < LEAST_M:
        raise SkillError(f"a demonstration in which hands or tool move by less than {1000 * LEAST_M:.0f} mm teaches nothing")
    if (np.abs(np.linalg.norm(tool[:, 3:], axis=1) - 1) > 0.01).any():
        raise SkillError("a demonstration's tool orientations are not quaternions of norm 1")
    speeds = [np.linalg.norm(np.gradient(x, axis=0), axis=1) for x in (hands, tool[:, :3])]
    a, b = (s - s.mean() for s in speeds)
    inner = a[reach : len(a) - reach]
    score = [float(inner @ b[reach + shift : len(b) - reach + shift]) for shift in range(-reach, reach + 1)]
    best = int(np.argmax(score)) - reach
    if best == 0 or score[best + reach] < 1.02 * score[reach]:
        return hands, tool
    return (hands[: len(hands) - best], tool[best:]) if best > 0 else (hands[-best:], tool[: len(tool) + best])


def mean_orientation(quaternions: ArrayLike) -> Vector:
    """The mean (4,) of quaternions x y z w (M, 4), whatever their signs: the leading eigenvector of their scatter (Markley et al. 2007)."""
    q = np.asarray(quaternions, dtype=np.float64)
    q = q / np.linalg.norm(q, axis=1, keepdims=True)
    mean = np.linalg.eigh(q.T @ q)[1][:, -1]
    return np.asarray(mean * (1 if mean[3] >= 0 else -1))
