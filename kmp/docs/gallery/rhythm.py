"""A motion that repeats: a figure of eight over its phase, without a seam, and the same motion with
one via-point, which is met in each period.
"""

import numpy as np
from matplotlib import pyplot as plt

from kmp import KMP, Gaussians, PeriodicKernel

phase = np.linspace(0, 2 * np.pi, 60, endpoint=False)[:, None]  # [rad]
eight = Gaussians.of(np.hstack([6 * np.sin(phase), 3 * np.sin(2 * phase)]), deviation=0.2)  # [cm]
skill = KMP.fit(phase, eight, kernel=PeriodicKernel(2, period=2 * np.pi), lambda_mean=3)
adapted = skill.adapt([[np.pi / 2]], Gaussians.of([8, 1], deviation=0))

two_periods = np.linspace(0, 4 * np.pi, 300)[:, None]
figure, (left, right) = plt.subplots(1, 2, figsize=(7.2, 3.0), layout="constrained")
for name, primitive in (("as learned", skill), ("with a via-point", adapted)):
    left.plot(*primitive.mean(two_periods).T, label=name)
    right.plot(two_periods, primitive.mean(two_periods)[:, 0])
left.plot(8, 1, "o", color="0.1")
left.set(xlabel="x [cm]", ylabel="y [cm]", ylim=(-4, 6.5))
left.legend(frameon=False, loc="upper left")
right.set(xlabel="phase [rad]", ylabel="x [cm]", xticks=2 * np.pi * np.arange(3))
right.set_xticklabels(["0", "2π", "4π"])
plt.show()
