"""Linear constraints: y stays above -6 cm and x below 3 cm, at each of the inputs at which they are
given.
"""

import numpy as np
from letters import TIMES, demonstrations
from matplotlib import pyplot as plt

import kmp

skill = kmp.learn(demonstrations(), components=8).primitive
normals = np.repeat([[0.0, 1.0], [-1.0, 0.0]], len(TIMES), axis=0)
bounds_cm = np.repeat([-6.0, -3.0], len(TIMES))  # normal · output >= bound
limits = kmp.LinearConstraints(np.vstack([TIMES, TIMES]), normals, bounds_cm)
within = skill.constrained(limits)

figure, axes = plt.subplots(figsize=(5.4, 4.2), layout="constrained")
axes.plot(*skill.mean(TIMES).T, "--", color="0.5", label="as learned")
axes.plot(*within.mean(TIMES).T, label="constrained")
axes.axhspan(-10, -6, color="0.9", zorder=0)
axes.axvspan(3, 7, color="0.9", zorder=0)
axes.set(xlabel="x [cm]", ylabel="y [cm]", xlim=(-7, 7), ylim=(-10, 10))
axes.legend(frameon=False, loc="upper left")
plt.show()
