"""How a hand moves on over an interval: transition and process noise of the estimator's modes."""

from __future__ import annotations

import functools

import numpy as np
from scipy.linalg import expm

from service.core.frame import Records, Vector, structured

REVERT_A = 15.0  # [1/s] of the acceleration
REVERT_V = 100.0  # [1/s²] of the velocity


@functools.cache
def models(period_s: float, count: int) -> Records:
    """A `transition` and a process `noise` (3, 3) each, over 0 to count - 1 periods."""
    out = structured(count, [("transition", np.float64, (3, 3)), ("noise", np.float64, (3, 3))])
    for ticks, one in enumerate(out):
        one["transition"], one["noise"] = model(ticks * period_s)
    return out


def model(interval_s: float) -> tuple[Vector, Vector]:
    """Transition (3, 3), and process noise (3, 3) of unit intensity, over an interval (Van Loan,
    1978).
    """
    dynamics = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [0.0, -REVERT_V, -REVERT_A]])
    whole = np.zeros((6, 6))
    whole[:3, :3], whole[2, 5], whole[3:, 3:] = -dynamics, 1.0, dynamics.T
    grown = expm(whole * interval_s)
    transition = np.ascontiguousarray(grown[3:, 3:].T)
    return _to_digits(transition), _to_digits(transition @ grown[:3, 3:])


def _to_digits(matrix: Vector) -> Vector:
    """To 12 digits, as LAPACK's last ones are another CPU's."""
    return np.array([[float(f"{value:.11e}") for value in row] for row in matrix])
