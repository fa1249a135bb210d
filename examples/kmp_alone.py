"""The mathematics without the service: learns a path of two coordinates from five demonstrations,
adapts it to a point that none of them went through. Try: python examples/kmp_alone.py
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from kmp import KMP, GaussianKernel, Gaussians

Array = NDArray[np.float64]
TIMES = np.linspace(0, 2, 100)[:, None]  # (T, 1) [s]


def demonstrations(count: int) -> Array:
    """Positions (D, T, 2) [m] of a curve that is never drawn quite the same."""
    random = np.random.default_rng(0)
    path = 0.3 * np.hstack([np.sin(2 * TIMES), np.cos(3 * TIMES)])
    return (
        path
        + 0.01 * random.normal(size=(count, 1, 2))
        + 0.001 * random.normal(size=(count, *path.shape))
    )


def reference(shown: Array) -> Gaussians:
    """Where the demonstrations were at each time, and how far they differed."""
    off = shown - shown.mean(axis=0)
    covariance = np.einsum("dti,dtj->tij", off, off) / (len(shown) - 1)
    return Gaussians(shown.mean(axis=0), covariance + 1e-6 * np.eye(2))  # 1 mm is nobody's merit


def main() -> KMP:
    """The adapted primitive; prints what it predicts."""
    skill = KMP.fit(
        TIMES, reference(demonstrations(5)), kernel=GaussianKernel(ell=8.0), lambda_mean=1.0
    )
    there = Gaussians(np.array([[0.20, 0.10]]), np.array([1e-10 * np.eye(2)]))  # [m], to 10 µm
    adapted = skill.adapt(np.array([[1.0]]), there, tolerance=0.05)
    for name, primitive in (("as learned", skill), ("adapted", adapted)):
        found = primitive.predict(np.array([[0.5], [1.0], [1.5]]))
        for t, mean, covariance in zip((0.5, 1.0, 1.5), found.mean, found.covariance, strict=True):
            std = np.sqrt(np.trace(covariance) / 2)
            print(
                f"{name:<11} at {t:.1f} s: ({mean[0]:+.3f}, {mean[1]:+.3f}) m, give or take "
                f"{1000 * std:.1f} mm"
            )
    return adapted


if __name__ == "__main__":
    main()
