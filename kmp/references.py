"""References from others: several in one by priority, and frames that move with the task (IJRR 2019)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from kmp.checks import Array, numbers
from kmp.gaussians import Gaussians, check_pairs
from kmp.gmm import GaussianMixture
from kmp.immutable import Immutable
from kmp.kernel import Kernel
from kmp.primitive import KMP


def superposed(references: Sequence[Gaussians], priorities: ArrayLike) -> Gaussians:
    """The reference that L references over the same N inputs agree on, by their priorities (L,) or (L, N), of sum 1.

    Sigma = (sum_l (Sigma_l / g_l)^-1)^-1, mu = Sigma sum_l (Sigma_l / g_l)^-1 mu_l. IJRR 2019, superposition. A
    reference of priority 0 has no say; priorities that change along the inputs blend from one reference to the next.
    """
    if len(references) == 0:
        raise ValueError("references: none given, at least 1 needed.")
    first = references[0]
    for n, other in enumerate(references):
        if other.mean.shape != first.mean.shape:
            raise ValueError(f"references[{n}]: means of shape {other.mean.shape} given, {first.mean.shape} needed.")
    given = np.asarray(priorities, dtype=np.float64)
    g = numbers("priorities", given[:, None] if given.ndim == 1 else given, len(references), "N")
    if g.shape[1] not in {1, len(first)}:
        raise ValueError(f"priorities: shape {given.shape} given, ({len(references)},) or {(len(references), len(first))} needed.")
    if (g < 0).any() or np.abs(g.sum(axis=0) - 1).max() > 1e-6:
        raise ValueError(f"priorities: from {g.min():g}, of sum {g.sum(axis=0)[0]:g} given; needed are sums of 1, none below 0.")
    precisions = [weight[:, None, None] * np.linalg.inv(one.covariance) for weight, one in zip(g, references, strict=True)]
    covariance = np.linalg.inv(np.sum(precisions, axis=0))
    pulls = [precision @ one.mean[:, :, None] for precision, one in zip(precisions, references, strict=True)]
    return Gaussians((covariance @ np.sum(pulls, axis=0))[:, :, 0], (covariance + covariance.swapaxes(1, 2)) / 2)


@dataclass(frozen=True, eq=False)
class Frame(Immutable):
    """Task parameters (A, b): where a frame lies, xi = A xi' + b for its coordinates xi'. matrix (O, O), offset (O,).

    Read-only. Rotations and translations keep the unit; any matrix that can be inverted will do.
    """

    matrix: Array
    offset: Array

    def __post_init__(self) -> None:
        offset = numbers("offset", self.offset, "O")
        matrix = numbers("matrix", self.matrix, len(offset), len(offset))
        if np.linalg.cond(matrix) > 1e12:
            raise ValueError(f"matrix: {matrix.tolist()} given, and it must have an inverse.")
        object.__setattr__(self, "offset", offset)
        object.__setattr__(self, "matrix", matrix)

    @classmethod
    def at(cls, origin: ArrayLike) -> Frame:
        """The frame at an origin (O,), not turned: a start, or a goal."""
        offset = numbers("origin", origin, "O")
        return cls(np.eye(len(offset)), offset)

    @classmethod
    def start_and_goal(cls, path: ArrayLike) -> tuple[Frame, Frame]:
        """The frames at the first and the last point of a path (T, O)."""
        points = numbers("path", path, "T", "O")
        return cls.at(points[0]), cls.at(points[-1])

    def with_velocity(self) -> Frame:
        """The frame of positions and their velocities, 2 O outputs: a velocity is turned and not moved."""
        o = len(self.offset)
        return Frame(np.asarray(np.kron(np.eye(2), self.matrix), dtype=np.float64), np.concatenate([self.offset, np.zeros(o)]))

    def local(self, points: ArrayLike) -> Array:
        """The coordinates in this frame of points (T, O)."""
        return np.asarray(np.linalg.solve(self.matrix, (numbers("points", points, "T", len(self.offset)) - self.offset).T).T)

    def localised(self, normals: Gaussians) -> Gaussians:
        """The same normals in this frame's coordinates."""
        inverse = np.linalg.inv(self.matrix)
        return normals.affine(inverse, -inverse @ self.offset)

    def placed(self, normals: Gaussians) -> Gaussians:
        """The normals that are given in this frame's coordinates, in those of the world."""
        return normals.affine(self.matrix, self.offset)


@dataclass(frozen=True, eq=False)
class LocalKMP(Immutable):
    """A skill in F frames at once: one primitive in each one's coordinates, and where the frames are now. IJRR 2019.

    From `learn`, for the frames of the last demonstration; `placed` moves it. Each frame's prediction is mapped back,
    (A mu + b, A Sigma A^T), and the product of the normals is the prediction: the frame that is surer prevails.
    """

    primitives: tuple[KMP, ...]
    frames: tuple[Frame, ...]

    @classmethod
    def learn(
        cls,
        demonstrations: Sequence[tuple[ArrayLike, ArrayLike]],
        frames: Sequence[Sequence[Frame]],
        inputs: ArrayLike,
        *,
        kernel: Kernel,
        lambda_mean: float,
        lambda_covariance: float | None = None,
        components: int,
        seed: int,
        regularization: float = 1e-6,
    ) -> LocalKMP:
        """The skill of demonstrations, each inputs (T, I) and outputs (T, O), and F frames for each.

        In each frame a mixture of `components` gives the reference at `inputs` (N, I), and that the primitive.
        """
        if len(frames) != len(demonstrations) or len(frames) == 0 or len({len(one) for one in frames}) != 1:
            raise ValueError(f"frames: {[len(one) for one in frames]} given for {len(demonstrations)} demonstrations, as many for each needed.")
        where = numbers("inputs", inputs, "N", "I")
        primitives = []
        for f in range(len(frames[0])):
            samples = [
                np.hstack([numbers("inputs", s, "T", where.shape[1]), frame[f].local(xi)])
                for (s, xi), frame in zip(demonstrations, frames, strict=True)
            ]
            mixture = GaussianMixture.fit(np.concatenate(samples), components=components, seed=seed, regularization=regularization)
            reference = mixture.regress(where)
            prior = reference.mean.mean(axis=0)
            prior[len(prior) // kernel.channels :] = 0
            primitives.append(
                KMP.fit(
                    where,
                    reference,
                    kernel=kernel,
                    lambda_mean=lambda_mean,
                    lambda_covariance=lambda_covariance,
                    prior_mean=prior,
                )
            )
        return cls(tuple(primitives), tuple(frames[-1]))

    def placed(self, frames: Sequence[Frame]) -> LocalKMP:
        """The skill with its frames elsewhere."""
        if [len(frame.offset) for frame in frames] != [len(frame.offset) for frame in self.frames]:
            raise ValueError(f"frames: {len(frames)} given, {len(self.frames)} over {len(self.frames[0].offset)} outputs needed.")
        return LocalKMP(self.primitives, tuple(frames))

    def predict(self, queries: ArrayLike) -> Gaussians:
        """xi(s) with its covariance at queries (M, I): the product of what the frames say."""
        first, *others = (frame.placed(primitive.predict(queries)) for frame, primitive in zip(self.frames, self.primitives, strict=True))
        return first.product(*others)

    def mean(self, queries: ArrayLike) -> Array:
        """xi(s) at queries (M, I): (M, O)."""
        return self.predict(queries).mean

    def adapt(self, inputs: ArrayLike, desired: Gaussians, *, tolerance: float) -> LocalKMP:
        """A new skill through desired points (V, I), V normals in the world's coordinates: mapped into each frame."""
        via = numbers("inputs", inputs, "V", self.primitives[0].inputs.shape[1])
        check_pairs(via, desired, self.primitives[0].outputs)
        adapted = [
            primitive.adapt(via, frame.localised(desired), tolerance=tolerance) for frame, primitive in zip(self.frames, self.primitives, strict=True)
        ]
        return LocalKMP(tuple(adapted), self.frames)
