"""The skill's compiled step: what the frame shows of a prediction, and how certain it is."""

from __future__ import annotations

import math

import numpy as np

from kmp.compiled import compiled
from service.core.frame import Record, Vector
from service.core.skill.model import COVARIANCE_ROUND_TO, REGION_95, Target
from service.core.skill.skill import Prediction
from service.core.skill.tuning import TRAIL_S


def write(frame: Record, found: Prediction, target: Target) -> None:
    frame["target"], frame["target_velocity"], frame["target_acceleration"] = target[:3]
    frame["gate_m"] = found.gate_m
    frame["orientation"], frame["turning"], frame["orientation_covariance"] = found.turn


@compiled
def recent(position: Vector, passed_s: float, trail: Vector) -> Vector:
    """The tool's velocity over the last TRAIL_S (3,) [m/s], by the trail (3,) [m] that it leaves:
    a filter of first order, which follows.
    """
    out, share = np.empty(3), 1.0 - math.exp(-passed_s / TRAIL_S)
    for i in range(3):
        trail[i] += share * (position[i] - trail[i])
        out[i] = (position[i] - trail[i]) / TRAIL_S
    return out


@compiled
def calibrate(covariance: Vector, velocity: Vector, scale: float, std_s: float, out: Vector) -> float:
    """A model's covariance (3, 3) [m²], of a tool that lately moved so (3,) [m/s], as `Regions` has
    it, rounded, into `out`; how far its 95 % region reaches [m].
    """
    for i in range(3):
        for j in range(3):
            found = scale * (covariance[i, j] + std_s * std_s * velocity[i] * velocity[j])
            out[i, j] = np.rint(found * COVARIANCE_ROUND_TO) / COVARIANCE_ROUND_TO
    mean = (out[0, 0] + out[1, 1] + out[2, 2]) / 3.0  # the greatest eigenvalue: Smith 1961
    a, b, c = out[0, 0] - mean, out[1, 1] - mean, out[2, 2] - mean
    d, e, f = out[0, 1], out[0, 2], out[1, 2]
    spread = math.sqrt((a * a + b * b + c * c + 2.0 * (d * d + e * e + f * f)) / 6.0)
    if spread > 0.0:
        half = 0.5 * (a * b * c + 2.0 * d * e * f - a * f * f - b * e * e - c * d * d) / spread**3
        mean += 2.0 * spread * math.cos(math.acos(min(max(half, -1.0), 1.0)) / 3.0)
    return math.sqrt(REGION_95 * max(mean, 0.0))
