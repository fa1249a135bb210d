"""Skills in coordinate frames that move with the task: local KMP of IJRR 2019.

xi = A xi' + b. In F frames the predictions N(mu_f, Sigma_f) combine to the normal distribution of
Sigma = (sum_f (A_f Sigma_f A_f^T)^-1)^-1, mu = Sigma sum_f (A_f Sigma_f A_f^T)^-1 (A_f mu_f + b_f).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from kmp.arrays.checks import (
    Array,
    Seed,
    brief,
    check_some,
    checked_demonstrations,
    numbers,
    parts_of,
    whole,
)
from kmp.arrays.immutable import Immutable, frozen
from kmp.arrays.linear_algebra import symmetric
from kmp.functionals import Functionals
from kmp.gaussians import Gaussians, check_gaussians, check_pairs, unchecked
from kmp.kernel import Kernel, checked_kernel
from kmp.mixture import GaussianMixture
from kmp.outputs import inside, mixes
from kmp.plot import Plotted, Points, Shown
from kmp.predictor import Uncertainty, drawn_paths
from kmp.primitive import KMP, Saved, checked_primitive
from kmp.query import MotionPrediction

# step of differences over the kernel's length: slopes are best here, curvatures have 6 digits
_DIFFERENCE = 1e-3


@dataclass(frozen=True, eq=False, repr=False)
class CoordinateFrame(Immutable):
    """Task parameters (A, b): xi = A xi' + b for coordinates xi' in the frame. Read-only.

    matrix A (O, O), offset b (O,) [unit of the outputs]. Any matrix with an inverse is allowed;
    rotations keep the unit. Raises ValueError if shapes do not agree, a number is not finite, or
    the matrix has no inverse.
    """

    matrix: Array
    offset: Array

    def __post_init__(self) -> None:
        offset = numbers("offset", self.offset, "O")
        check_some("offset", offset)
        matrix = numbers("matrix", self.matrix, len(offset), len(offset))
        if np.linalg.cond(matrix) > 1e12:
            raise ValueError(f"matrix: {brief(matrix)} given, and it must have an inverse.")
        self.__dict__.update(matrix=matrix, offset=offset)

    @classmethod
    def at(cls, origin: ArrayLike) -> CoordinateFrame:
        """The frame at an origin (O,), without rotation: a start, or a goal.

        Raises ValueError if the shape differs or a number is not finite.
        """
        offset = numbers("origin", origin, "O")
        check_some("origin", offset)
        return cls(np.eye(len(offset)), offset)

    @classmethod
    def start_and_goal(cls, path: ArrayLike) -> tuple[CoordinateFrame, CoordinateFrame]:
        """The frames at the first and the last point of a path (T, O).

        Raises ValueError if the shape differs, a number is not finite, or there is no point.
        """
        points = numbers("path", path, "T", "O")
        if points.size == 0:
            raise ValueError("path: no point given, at least 1 needed.")
        return cls.at(points[0]), cls.at(points[-1])

    def with_velocity(self) -> CoordinateFrame:
        """The frame of values and their rates, 2 O outputs: rates rotate and do not move."""
        matrix = np.asarray(np.kron(np.eye(2), self.matrix), dtype=np.float64)
        return CoordinateFrame(matrix, np.concatenate([self.offset, np.zeros(len(self.offset))]))

    def local(self, points: ArrayLike) -> Array:
        """The coordinates (T, O) of points (T, O) in this frame: A^-1 (xi - b).

        Raises ValueError if the shape differs or a number is not finite.
        """
        moved = numbers("points", points, "T", len(self.offset)) - self.offset
        return np.asarray(np.linalg.solve(self.matrix, moved.T).T)

    def localised(self, normals: Gaussians) -> Gaussians:
        """The normals in this frame's coordinates. Raises ValueError if O differs."""
        check_gaussians("normals", normals, len(self.offset))
        inverse = np.linalg.inv(self.matrix)
        return normals.affine(inverse, -inverse @ self.offset)

    def placed(self, normals: Gaussians) -> Gaussians:
        """Normals of this frame in the world's coordinates. Raises ValueError if O differs."""
        check_gaussians("normals", normals, len(self.offset))
        return normals.affine(self.matrix, self.offset)


def _localised(
    frame: CoordinateFrame, primitive: KMP, inputs: Array, desired: Gaussians
) -> Gaussians:
    """Via-points (V, I) of the world in a frame, whose primitive this is."""
    parameters = primitive.inner.solution.hyperparameters
    points = Functionals(inputs)
    shifted = unchecked(desired.mean - frame.offset, desired.covariance)
    if mixes(parameters, points, frame.matrix, shifted).any():
        return inside(parameters, points, frame.matrix, shifted)
    return frame.localised(desired)


def _check_frames(name: str, frames: Sequence[CoordinateFrame]) -> int:
    """The number of frames. Raises ValueError unless all are frames."""
    return len(parts_of(name, frames, CoordinateFrame, "CoordinateFrame(matrix, offset)"))


@dataclass(frozen=True, eq=False, repr=False)
class LocalKMP(Immutable, Plotted, Saved):
    """A skill in F coordinate frames: a primitive in each, and the frames' present positions.

    `learn` returns it with the frames of the last demonstration; `placed` moves it. Each frame's
    prediction is mapped to the world, (A mu + b, A Sigma A^T); the prediction is the product of
    these normals, in which the smallest covariance weighs most. IJRR 2019.

    To add a frame, make another one of all primitives and frames.
    """

    primitives: tuple[KMP, ...]
    frames: tuple[CoordinateFrame, ...]

    def __post_init__(self) -> None:
        for i, primitive in enumerate(parts_of("primitives", self.primitives)):
            checked_primitive(primitive, f"primitives[{i}]")
        _check_frames("frames", self.frames)
        needed = [primitive.outputs for primitive in self.primitives]
        if (outputs := [len(frame.offset) for frame in self.frames]) != needed:
            raise ValueError(
                f"frames: over {brief(outputs)} outputs given, over {brief(needed)} needed."
            )

    @classmethod
    def learn(
        cls,
        demonstrations: Sequence[tuple[ArrayLike, ArrayLike]],
        frames: Sequence[Sequence[CoordinateFrame]],
        inputs: ArrayLike,
        *,
        kernel: Kernel,
        lambda_mean: float,
        lambda_covariance: float | None = None,
        components: int,
        seed: Seed = 0,
        regularization: float = 1e-6,
    ) -> LocalKMP:
        """The skill of demonstrations, each inputs (T, I), outputs (T, O), and F frames for each.

        In each frame, the regression of a mixture of `components` at `inputs` (N, I) is the
        primitive's reference. The other parameters are those of `GaussianMixture.fit` and
        `KMP.fit`.

        Raises ValueError if a demonstration does not have F frames, and as these two do.
        """
        kernel = checked_kernel(kernel)
        data = checked_demonstrations(demonstrations)
        counts = [
            _check_frames(f"frames[{h}]", frame_set)
            for h, frame_set in enumerate(parts_of("frames", frames))
        ]
        if len(counts) != len(data) or len(set(counts)) != 1:
            raise ValueError(
                f"frames: {brief(counts)} given for {len(data)} demonstrations, as many for each "
                "needed."
            )
        where = numbers("inputs", inputs, "N", data[0][0].shape[1])
        primitives = []
        for f in range(counts[0]):
            samples = [
                np.hstack([s, frame[f].local(xi)])
                for (s, xi), frame in zip(data, frames, strict=True)
            ]
            mixture = GaussianMixture.fit(
                np.concatenate(samples),
                components=components,
                seed=seed,
                regularization=regularization,
            )
            reference = mixture.regress(where)
            prior = reference.mean.mean(axis=0)
            prior[len(prior) // kernel.channels :] = 0
            primitive = KMP.fit(
                where,
                reference,
                kernel=kernel,
                lambda_mean=lambda_mean,
                lambda_covariance=lambda_covariance,
                prior_mean=prior,
            )
            primitives.append(primitive)
        return cls(tuple(primitives), tuple(frames[-1]))

    def placed(self, frames: Sequence[CoordinateFrame]) -> LocalKMP:
        """The skill with its F frames moved. Raises ValueError if F or O differs."""
        _check_frames("frames", frames)
        return LocalKMP(self.primitives, tuple(frames))

    def predict(self, queries: ArrayLike) -> Gaussians:
        """The product of the frames' predictions at queries (M, I): M normals.

        Raises ValueError as `KMP.predict` does.
        """
        pairs = zip(self.frames, self.primitives, strict=True)
        first, *others = (frame.placed(primitive.predict(queries)) for frame, primitive in pairs)
        return first.product(*others)

    def mean(self, queries: ArrayLike) -> Array:
        """The mean (M, O) [unit of the outputs] of `predict`. Raises ValueError as that does."""
        return self.predict(queries).mean

    def jacobian(self, query: ArrayLike) -> Array:
        """d mean / ds (O, I) at one query (I,), by differences, to some 1e-8 of its size.

        Raises ValueError as `KMP.jacobian` does.
        """
        s = self._checked("query", query)
        columns = [self._differences(s, axis)[1] for axis in np.eye(len(s))]
        return np.stack(columns, axis=1)

    def predict_motion(
        self,
        query: ArrayLike,
        velocity: ArrayLike,
        acceleration: ArrayLike,
        *,
        covariance: bool = True,
    ) -> MotionPrediction:
        """The output at one query (I,) and its motion with the input, as `KMP.predict_motion`.

        By differences: velocities to some 1e-8 of their sizes, accelerations to 1e-6. Raises
        ValueError as that does.
        """
        s = self._checked("query", query)
        v = self._checked("velocity", velocity)
        a = self._checked("acceleration", acceleration)
        mean, along, curvature = self._differences(s, v)
        jacobian = self.jacobian(s)
        spread = self.predict(s[None]).covariance[0] if covariance else None
        return MotionPrediction(mean, along, jacobian @ a + curvature, spread, jacobian, curvature)

    def _checked(self, name: str, value: ArrayLike) -> Array:
        return self.primitives[0]._checked(name, value)  # noqa: SLF001 (of its own kind)

    def _differences(self, query: Array, velocity: Array) -> tuple[Array, Array, Array]:
        """Mean and its two derivatives (O,) along a line through the query, of fourth order."""
        mean = self.mean(query[None])[0]
        speeds = [np.linalg.norm(np.sqrt(p.kernel.ell) * velocity) for p in self.primitives]
        if max(speeds) == 0.0:
            return mean, 0.0 * mean, 0.0 * mean
        step = _DIFFERENCE / max(speeds)
        first, second, third, fourth = self.mean(
            query + step * np.array([-2.0, -1.0, 1.0, 2.0])[:, None] * velocity
        )
        slope = (first - 8 * second + 8 * third - fourth) / (12 * step)
        bend = (-first + 16 * second - 30 * mean + 16 * third - fourth) / (12 * step**2)
        return mean, slope, bend

    def sample(self, queries: ArrayLike, count: int, *, seed: Seed = 0) -> Array:
        """Paths (count, M, O) through queries (M, I), of the product of the frames' joint normals.

        Their mean is not `mean`: that is of a product for each query by itself, and here the
        correlations between queries count, too. Raises ValueError as `KMP.sample` does.
        """
        whole("count", count)
        joint = [primitive.predict_joint(queries) for primitive in self.primitives]
        outputs = len(self.frames[0].offset)
        points = joint[0].outputs // outputs
        mean = np.zeros(points * outputs)
        covariance = np.zeros((0, 0))
        for frame, normal in zip(self.frames, joint, strict=True):
            wide = np.kron(np.eye(points), frame.matrix)
            other = wide @ normal.mean[0] + np.tile(frame.offset, points)
            spread = wide @ normal.covariance[0] @ wide.T
            if not covariance.size:
                mean, covariance = other, spread
                continue
            gain = np.linalg.lstsq(covariance + spread, covariance, rcond=1e-14)[0].T
            mean = mean + gain @ (other - mean)
            covariance = symmetric(covariance - gain @ covariance)
        product = unchecked(mean[None], covariance[None])
        drawn = drawn_paths(product, np.ones(len(mean)), count, seed)
        return drawn.reshape(count, points, outputs)

    def uncertainty(self, queries: ArrayLike) -> Uncertainty:
        """The covariance of `predict`, by its causes, of which each frame's share counts as in the
        mean. Raises ValueError as `predict` does.
        """
        total = self.predict(queries).covariance
        variability, distance = np.zeros((2, *total.shape))
        for frame, primitive in zip(self.frames, self.primitives, strict=True):
            causes = primitive.uncertainty(queries)
            whole_causes = causes.variability + causes.distance
            share = total @ np.linalg.inv(frame.matrix @ whole_causes @ frame.matrix.T)
            mapped = share @ frame.matrix
            variability += mapped @ causes.variability @ mapped.mT
            distance += mapped @ causes.distance @ mapped.mT
        return Uncertainty(frozen(symmetric(variability)), frozen(symmetric(distance)))

    def adapt(
        self,
        inputs: ArrayLike,
        desired: Gaussians,
        *,
        frame: int | None = None,
        tolerance: float | None = None,
    ) -> LocalKMP:
        """A new skill through desired points (V, I), V normals in the world's coordinates.

        They are mapped into each frame, or into the one with this number only: they then move with
        it. `tolerance` [unit of the inputs] is that of `KMP.adapt`. Raises ValueError as that does.
        """
        via = numbers("inputs", inputs, "V", self.primitives[0].inputs.shape[1])
        if frame is not None:
            whole("frame", frame, least=0, most=len(self.frames) - 1)
        check_pairs("desired", via, desired, self.primitives[0].outputs)
        adapted = list(self.primitives)
        for n in range(len(adapted)) if frame is None else [frame]:
            local = _localised(self.frames[n], adapted[n], via, desired)
            adapted[n] = adapted[n].adapt(via, local, tolerance=tolerance)
        return LocalKMP(tuple(adapted), self.frames)

    def _to_plot(self) -> Shown:
        """The references of all frames and the via-points, in the world's coordinates."""
        plots = [primitive._to_plot() for primitive in self.primitives]  # noqa: SLF001
        placed = [
            Points(plot.references.inputs, frame.placed(plot.references.normals))
            for frame, plot in zip(self.frames, plots, strict=True)
        ]
        inputs = np.concatenate([points.inputs for points in placed])
        references = Points(inputs, Gaussians.concatenated([points.normals for points in placed]))
        via = plots[0].via_points
        return plots[0]._replace(
            references=references, via_points=Points(via.inputs, self.frames[0].placed(via.normals))
        )
