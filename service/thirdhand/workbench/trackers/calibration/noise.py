"""Noise of a tracker: white noise, and an error that wanders.

Errors of neighbouring samples are alike, because a tracker's error depends on where the hand is. A
fit that takes them for independent is worse than necessary, and looks several times as accurate as
it is. With V the covariance of samples at times t_i on one axis,

    V_ij = variance (share exp(-|t_i - t_j| / time) + (1 - share) [i = j])

`share` and `time` maximise the restricted likelihood (REML, Patterson and Thompson 1971), which
accounts for the parameters that were fitted.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from scipy.linalg import solve_triangular

from thirdhand.core.frame import Vector

WANDERING_SHARES = (0.4, 0.7, 0.85, 0.93, 0.97, 0.99)  # candidates, besides 0
WANDERING_TIMES_S = tuple(np.geomspace(0.2, 12.0, 8).tolist())  # candidates


class WanderingNoise(NamedTuple):
    """Share and time [s] of the wandering error; Cholesky factor (N, N) of V / variance."""

    share: float
    time_s: float
    factor: Vector

    def whitened(self, values: Vector) -> Vector:
        """Values (N, ...) of the samples, with independent errors of the same variance."""
        flat = solve_triangular(
            self.factor, values.reshape(len(values), -1), lower=True, check_finite=False
        )
        return np.asarray(flat.reshape(values.shape))


def candidate(times_s: Vector, share: float, time_s: float) -> WanderingNoise:
    """The noise of samples at times (N,) [s] with this share and time of the wandering error."""
    correlation = share * np.exp(-np.abs(times_s[:, None] - times_s[None, :]) / time_s)
    factor = np.linalg.cholesky(correlation + (1.0 - share) * np.eye(len(times_s)))
    return WanderingNoise(share, time_s, np.asarray(factor, np.float64))


def estimated(times_s: Vector, off: Vector, jacobian: Vector) -> WanderingNoise:
    """The most likely noise of residuals (N, 3) [m] at times (N,) [s]; the Jacobian is (N, 3, K).

    The time is chosen at the middle share, then the share at that time.
    """

    def cost(noise: WanderingNoise) -> float:
        count = off.size
        parameters = jacobian.shape[2]
        residual = noise.whitened(off).ravel()
        slopes = noise.whitened(jacobian).reshape(count, parameters)
        base, triangle = np.linalg.qr(slopes)
        square = float(residual @ residual - np.square(base.T @ residual).sum())
        determinants = 3.0 * np.log(np.diag(noise.factor)).sum()
        determinants += np.log(np.maximum(np.abs(np.diag(triangle)), 1e-300)).sum()
        return float((count - parameters) * math.log(max(square, 1e-300)) + 2.0 * determinants)

    middle = WANDERING_SHARES[len(WANDERING_SHARES) // 2]
    wandering = min((candidate(times_s, middle, time_s) for time_s in WANDERING_TIMES_S), key=cost)
    shares = (share for share in (0.0, *WANDERING_SHARES) if share != middle)
    return min(
        (wandering, *(candidate(times_s, share, wandering.time_s) for share in shares)), key=cost
    )
