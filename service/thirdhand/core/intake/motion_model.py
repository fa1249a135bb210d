"""Motion of a hand over an interval: transition and process noise of the hand filter's modes.

The filter has MODES = 4 modes: REST, STEADY, REACH and CHANGE. Each describes every axis by the
same linear system with STATES = 5 states: position p [m], velocity v [m/s], acceleration a [m/s²],
tremor y [m] and its velocity w [m/s]. Motion (p, v, a) and tremor (y, w) do not drive each other:

    dp = v dt,   dv = a dt,   da = (-k_v v - k_a a) dt + sqrt(q) dW1
    dy = w dt,   dw = (-ω² y - 2 ζ ω w) dt + sqrt(4 ζ ω³ σ²) dW2

Velocity and acceleration revert to zero by k_v (mode_velocity_reversions_per_s2) and k_a
(mode_acceleration_reversions_per_s); q is mode_intensities_m2ps5 [m²/s⁵]. These three and the
tremor's stationary standard deviation σ differ between the modes; ω, one of tremor_rates_per_s, and
ζ = tremor_damping are shared. Rate and strength of a hand's tremor are estimated (`tremor`). W1 and
W2 are independent Wiener processes.
"""

from __future__ import annotations

import functools
import math

import numpy as np

from thirdhand.core.frame import Records, Vector, structured
from thirdhand.core.intake import MODES, TREMOR_RATES
from thirdhand.core.intake.tuning import IntakeTuning
from thirdhand.core.numerics import SERIES_TERMS
from thirdhand.core.tuning import TUNING

# A hand rests, moves slowly and steadily, reaches, or changes its motion.
REST, STEADY, REACH, CHANGE = range(MODES)
ENDLESS = MODES  # motion of the bank of tremor filters: REACH that does not end


@functools.cache
def models(period_s: float, count: int, numbers: IntakeTuning = TUNING.intake) -> Records:
    """Transition and process noise of all modes over 0 to `count` - 1 periods: record n holds the
    fields of `model` for n `period_s`.
    """
    times_s: Vector = np.array([ticks * period_s for ticks in range(count)])
    fields = model(times_s, numbers)
    out = structured(count, [(name, np.float64, array.shape[1:]) for name, array in fields.items()])
    for name, array in fields.items():
        out[name] = array
    return out


def model(interval_s: float | Vector, numbers: IntakeTuning = TUNING.intake) -> dict[str, Vector]:
    """Transition F and process noise Q over intervals t (...), of the motion of each mode and of a
    tremor of unit variance at each of the tremor_rates_per_s:

    * `transition`, `noise` (..., MODES + 1, 3, 3), with A = [[0, 1, 0], [0, 0, 1], [0, -k_v, -k_a]]
      and c = q; the last one, ENDLESS, is REACH with k_v = 0
    * `tremor`, `tremor_noise` (..., TREMOR_RATES, 2, 2), with A = [[0, 1], [-ω², -2 ζ ω]] and
      c = 4 ζ ω³

        F = expm(A t),   Q = c ∫ expm(A s) e eᵀ expm(A s)ᵀ ds,  s = 0 ... t

    where e is the unit vector of the last state (acceleration or tremor velocity).
    """
    interval_s = np.asarray(interval_s, np.float64)
    transition, noise = np.empty((2, *interval_s.shape, MODES + 1, 3, 3))
    reversions = [*numbers.mode_velocity_reversions_per_s2, 0.0]
    for motion, mode in enumerate((REST, STEADY, REACH, CHANGE, REACH)):
        revert_a = numbers.mode_acceleration_reversions_per_s[mode]
        dynamics = np.array(
            [[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [0.0, -reversions[motion], -revert_a]]
        )
        transition[..., motion, :, :], driven = _over(dynamics, interval_s)
        noise[..., motion, :, :] = numbers.mode_intensities_m2ps5[mode] * driven
    tremor, tremor_noise = np.empty((2, *interval_s.shape, TREMOR_RATES, 2, 2))
    for k, rate in enumerate(numbers.tremor_rates_per_s):
        oscillator = np.array([[0.0, 1.0], [-(rate**2), -2.0 * numbers.tremor_damping * rate]])
        tremor[..., k, :, :], driven = _over(oscillator, interval_s)
        tremor_noise[..., k, :, :] = 4.0 * numbers.tremor_damping * rate * rate * rate * driven
    return {
        "transition": transition,
        "noise": noise,
        "tremor": tremor,
        "tremor_noise": tremor_noise,
    }


def _over(dynamics: Vector, interval_s: Vector) -> tuple[Vector, Vector]:
    """Transition F (..., N, N) over intervals (...), and the covariance Q (..., N, N) of white
    noise of unit intensity that drives the last state.

    One matrix exponential gives both (Van Loan, IEEE TAC 23(3), 1978), with E = e eᵀ:

        expm([[-A, E], [0, Aᵀ]] t) = [[..., F⁻¹ Q], [0, Fᵀ]]
    """
    n = len(dynamics)
    block = np.zeros((2 * n, 2 * n))
    block[:n, :n] = -dynamics
    block[n - 1, 2 * n - 1] = 1.0
    block[n:, n:] = dynamics.T
    expm = _exponential(block * interval_s[..., None, None])
    transition = np.swapaxes(expm[..., n:, n:], -1, -2)
    return np.ascontiguousarray(transition), _product(transition, expm[..., :n, n:])


def _exponential(matrices: Vector) -> Vector:
    """Matrix exponentials (..., N, N) by squaring, with the same bits on every processor.

    exp(M) = (sum of (M / 2^s)^k / k!, k = 0 ... SERIES_TERMS)^(2^s),   |M| / 2^s < 1/2
    """
    largest = float(np.abs(matrices).sum(axis=-1).max(initial=0.0))
    squarings = max(0, math.frexp(2.0 * largest)[1])
    scaled = matrices * 0.5**squarings
    identity = np.eye(matrices.shape[-1])
    power = np.broadcast_to(identity, matrices.shape)
    for term in range(SERIES_TERMS, 0, -1):
        power = identity + _product(scaled, power) / term
    for _ in range(squarings):
        power = _product(power, power)
    return power


def _product(left: Vector, right: Vector) -> Vector:
    """Products (..., N, N) of matrices, whose sums are in order: those of BLAS are not."""
    product: Vector = left[..., :, :1] * right[..., :1, :]
    for k in range(1, left.shape[-1]):
        product = product + left[..., :, k, None] * right[..., None, k, :]
    return product
