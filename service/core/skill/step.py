"""Compiled step of the skill: calibrate the prediction's covariance and write it into the frame."""

from __future__ import annotations

import math

import numpy as np

from kmp.compiled import compiled
from service.core.frame import Record, Vector
from service.core.skill.model import COVARIANCE_ROUND_TO, REGION_95, Target
from service.core.skill.skill import Prediction
from service.core.skill.tuning import TRAIL_S


def write(frame: Record, found: Prediction, target: Target) -> None:
    """Write the clamped target, the gate's distance and the orientation into the frame."""
    frame["target"], frame["target_velocity"], frame["target_acceleration"] = target[:3]
    frame["gate_m"] = found.gate_m
    frame["orientation"], frame["turning"], frame["orientation_covariance"] = found.turn


@compiled
def recent(position: Vector, passed_s: float, trail: Vector) -> Vector:
    """Mean velocity v (3,) [m/s] of the tool over about the last T = TRAIL_S, from a first-order
    lowpass m (3,) [m] of its positions p (3,), `trail`, which is updated in place:

        m = m + (1 - exp(-elapsed / T)) (p - m),   v = (p - m) / T
    """
    out, share = np.empty(3), 1.0 - math.exp(-passed_s / TRAIL_S)
    for i in range(3):
        trail[i] += share * (position[i] - trail[i])
        out[i] = (position[i] - trail[i]) / TRAIL_S
    return out


@compiled
def calibrate(covariance: Vector, velocity: Vector, scale: float, std_s: float, out: Vector) -> float:
    """Calibrated covariance C (3, 3) [m²] of a model's covariance Σ, written rounded to `out`, and
    the largest distance [m] of its 95 % region from the mean:

        C = scale (Σ + std_s² v vᵀ),   reach = sqrt(REGION_95 λ_max(C))

    v (3,) [m/s] is the recent velocity of the tool. λ_max, the largest eigenvalue, is found in
    closed form (Smith 1961). See `Regions`.
    """
    for i in range(3):
        for j in range(3):
            found = scale * (covariance[i, j] + std_s * std_s * velocity[i] * velocity[j])
            out[i, j] = np.rint(found * COVARIANCE_ROUND_TO) / COVARIANCE_ROUND_TO
    mean = (out[0, 0] + out[1, 1] + out[2, 2]) / 3.0  # from here on, the largest eigenvalue: Smith 1961
    a, b, c = out[0, 0] - mean, out[1, 1] - mean, out[2, 2] - mean
    d, e, f = out[0, 1], out[0, 2], out[1, 2]
    spread = math.sqrt((a * a + b * b + c * c + 2.0 * (d * d + e * e + f * f)) / 6.0)
    if spread > 0.0:
        half = 0.5 * (a * b * c + 2.0 * d * e * f - a * f * f - b * e * e - c * d * d) / spread**3
        mean += 2.0 * spread * math.cos(math.acos(min(max(half, -1.0), 1.0)) / 3.0)
    return math.sqrt(REGION_95 * max(mean, 0.0))
