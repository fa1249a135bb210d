"""Gains from the covariance: stiff where the demonstrations agree (minimal intervention), soft where
they differ and, with the part by distance, where nothing was shown.
"""

import numpy as np
from letters import demonstrations
from matplotlib import pyplot as plt

import kmp


def minimal_intervention(covariance, effort):
    """Stiffness and damping (M, O, O) that minimise x^T Sigma^-1 x + effort |acceleration|^2."""
    variances, axes = np.linalg.eigh(covariance)
    stiffness = 1 / np.sqrt(effort * variances)  # of a double integrator, along each axis
    gains = stiffness, np.sqrt(2 * stiffness)
    return [(axes * gain[:, None, :]) @ axes.mT for gain in gains]


learned = kmp.learn(demonstrations(), components=8).primitive
skill = learned.with_lambda_covariance(0.01 * learned.lambda_covariance)  # soft sooner outside
times = np.linspace(-0.5, 3, 200)  # [s]; the demonstrations end at 2 s
parts = skill.uncertainty(times)
figure, (left, right) = plt.subplots(1, 2, figsize=(7.2, 3.4), layout="constrained")
for name, covariance in (
    ("variability alone", parts.variability),
    ("and distance", parts.variability + parts.distance),
):
    stiffness, damping = minimal_intervention(covariance, effort=1e-3)
    for axes, gain in ((left, stiffness), (right, damping)):
        axes.plot(times, gain[:, 0, 0], label=name)
for axes, what in ((left, "stiffness of x [1/s²]"), (right, "damping of x [1/s]")):
    axes.axvspan(0, 2, color="0.93", zorder=0)
    axes.set(xlabel="time [s]", ylabel=what)
    axes.legend(frameon=False, loc="upper center")
left.set(yscale="log", ylim=(1, 1000))
right.set(ylim=(0, 25))
plt.show()
