"""The mathematics without the service: learns a path of two coordinates from five demonstrations,
adapts it to a point that none of them went through. Try: python examples/kmp_alone.py
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from kmp import KMP, Gaussians, learn

DURATION_S, SAMPLES = 2.0, 100


def demonstrations(count: int) -> list[tuple[NDArray[np.float64], NDArray[np.float64]]]:
    """Times (T, 1) [s] and positions (T, 2) [m] of a curve that is never drawn quite the same."""
    random = np.random.default_rng(0)
    t = np.linspace(0, DURATION_S, SAMPLES)[:, None]
    path = 0.3 * np.hstack([np.sin(2 * t), np.cos(3 * t)])
    return [(t, path + 0.01 * random.normal(size=2) + 0.001 * random.normal(size=path.shape)) for _ in range(count)]


def main() -> KMP:
    """The adapted primitive; prints what it predicts."""
    skill = learn(demonstrations(5), components=8, seed=0).primitive
    there = np.array([[0.29, -0.26]])  # [m] where it is to be at 1 s
    adapted = skill.adapt(np.array([[1.0]]), Gaussians(there, np.array([1e-6 * np.eye(2)])), tolerance=0.1)
    for name, primitive in (("as learned", skill), ("adapted", adapted)):
        found = primitive.predict(np.array([[0.5], [1.0], [1.5]]))
        for t, mean, covariance in zip((0.5, 1.0, 1.5), found.mean, found.covariance, strict=True):
            std = np.sqrt(np.trace(covariance) / 2)
            print(f"{name:<11} at {t:.1f} s: ({mean[0]:+.3f}, {mean[1]:+.3f}) m, give or take {1000 * std:.0f} mm")
    return adapted


if __name__ == "__main__":
    main()
