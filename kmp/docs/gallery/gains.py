"""Gains from the covariance: stiff where the demonstrations agree (minimal intervention), and soft
by the part of distance where nothing was shown.
"""

import numpy as np
from letters import demonstrations
from matplotlib import pyplot as plt

import kmp


def minimal_intervention(covariance, effort):
    """Stiffness and damping (M, O, O) of least x^T Sigma^-1 x + effort |acceleration|^2."""
    variances, axes = np.linalg.eigh(covariance)
    stiffness = 1 / np.sqrt(effort * variances)
    gains = stiffness, np.sqrt(2 * stiffness)
    return [(axes * gain[:, None, :]) @ axes.mT for gain in gains]


learned = kmp.learn(demonstrations(), components=8).primitive
skill = learned.with_lambda_covariance(0.01 * learned.lambda_covariance)  # soft sooner outside
times = np.linspace(-0.5, 3, 200)  # [s]; the demonstrations end at 2 s
parts = skill.uncertainty(times)
total = parts.variability + parts.distance
figure, panels = plt.subplots(1, 2, figsize=(7.2, 3.4), layout="constrained")
for name, covariance in (("variability alone", parts.variability), ("and distance", total)):
    for axes, gain in zip(panels, minimal_intervention(covariance, effort=1e-3), strict=True):
        axes.plot(times, gain[:, 0, 0], label=name)
panels[0].set(xlabel="time [s]", ylabel="stiffness of x [1/s²]", yscale="log", ylim=(1, 1000))
panels[1].set(xlabel="time [s]", ylabel="damping of x [1/s]", ylim=(0, 25))
panels[0].legend(frameon=False, loc="upper center")
plt.show()
