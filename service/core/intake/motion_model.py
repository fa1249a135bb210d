"""How a hand moves on over an interval: transition and process noise of the estimator's modes.

Acceleration and velocity revert to 0, and tremor is a damped oscillation beside them:

    dx = v dt    dv = a dt    da = -REVERT_A a dt - REVERT_V v dt + sqrt(intensity) dW
    dy = w dt    dw = -TREMOR_RATE² y dt - 2 TREMOR_DAMPING TREMOR_RATE w dt + ... dW

Against that samples are weighed. For KEPT_ON_S after the newest one a hand in motion keeps its
velocity, and its acceleration fades: that its motion will end would say too early that it does.
"""

from __future__ import annotations

import functools

import numpy as np
from scipy.linalg import expm

from service.core.frame import Records, Vector, structured
from service.core.intake import MODES, STATES
from service.core.intake.tuning import (
    ACCELERATION_FADE_PER_S,
    MODE_ACCELERATION_REVERSIONS_PER_S,
    MODE_INTENSITIES,
    MODE_VELOCITY_REVERSIONS_PER_S2,
    TREMOR_DAMPING,
    TREMOR_RATE_PER_S,
    TREMOR_STDS_M,
    VELOCITY_KEPT_S,
)

REST, REACH, CHANGE = range(MODES)  # the modes


@functools.cache
def models(period_s: float, count: int) -> Records:
    """A `transition` and a process `noise` each, of all modes, over 0 to count - 1 periods; and
    `onward`, the motion since the newest sample.
    """
    kinds = [(name, np.float64, (MODES, STATES, STATES)) for name in ("transition", "noise")]
    out = structured(count, [*kinds, ("onward", np.float64, (MODES, 3, 3))])
    for ticks, one in enumerate(out):
        one["transition"], one["noise"] = model(ticks * period_s)
        kept_on_s = min(ticks * period_s, VELOCITY_KEPT_S)
        one["onward"] = (
            model(ticks * period_s - kept_on_s)[0][:, :3, :3]
            @ _over(_motion(0.0, ACCELERATION_FADE_PER_S), kept_on_s)[0]
        )
        one["onward"][REST] = one["transition"][REST, :3, :3]
    return out


def model(interval_s: float) -> tuple[Vector, Vector]:
    """Transitions and process noise (MODES, STATES, STATES) of the modes over an interval."""
    transition, noise, motion, tremor = *np.zeros((2, MODES, STATES, STATES)), slice(0, 3), slice(3, STATES)
    dynamics = np.array([[0.0, 1.0], [-(TREMOR_RATE_PER_S**2), -2.0 * TREMOR_DAMPING * TREMOR_RATE_PER_S]])
    trembles, driven = _over(dynamics, interval_s)
    for mode in range(MODES):
        moves, driving = _over(
            _motion(MODE_VELOCITY_REVERSIONS_PER_S2[mode], MODE_ACCELERATION_REVERSIONS_PER_S[mode]), interval_s
        )
        transition[mode, motion, motion], noise[mode, motion, motion] = moves, MODE_INTENSITIES[mode] * driving
        transition[mode, tremor, tremor] = trembles
        noise[mode, tremor, tremor] = 4.0 * TREMOR_DAMPING * TREMOR_RATE_PER_S**3 * TREMOR_STDS_M[mode] ** 2 * driven
    return transition, noise


def _motion(revert_v: float, revert_a: float) -> Vector:
    """How position, velocity and acceleration change (3, 3)."""
    return np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [0.0, -revert_v, -revert_a]])


def _over(dynamics: Vector, interval_s: float) -> tuple[Vector, Vector]:
    """The transition (N, N), and the noise (N, N) when the last state is driven by unit intensity
    (Van Loan, 1978).
    """
    n = len(dynamics)
    whole = np.zeros((2 * n, 2 * n))
    whole[:n, :n], whole[n - 1, 2 * n - 1], whole[n:, n:] = -dynamics, 1.0, dynamics.T
    grown = expm(whole * interval_s)
    transition = grown[n:, n:].T
    return _to_digits(transition), _to_digits(transition @ grown[:n, n:])


def _to_digits(matrix: Vector) -> Vector:
    """To 12 digits, as LAPACK's last ones are another CPU's."""
    return np.array([[float(f"{value:.11e}") for value in row] for row in matrix])
