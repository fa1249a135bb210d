"""An orientation over time, learned in the tangent space of unit quaternions: as demonstrated
(dashed), and through an upright via-point at 1 s.
"""

import numpy as np
from letters import TIMES
from matplotlib import pyplot as plt

from kmp import KMP, GaussianKernel, Gaussians, OrientationKMP
from kmp.orientation import exp, log

angle = 0.5 * np.sin(2 * TIMES)  # [rad]
quaternions = exp(np.hstack([angle, 0.4 * angle, 0.3 * TIMES]), np.array([0, 0, 0, 1.0]))  # x y z w
auxiliary = quaternions[50]
tangent = Gaussians.of(log(quaternions, auxiliary), deviation=0.1)  # [rad, half of the angle]
kernel = GaussianKernel(4)
skill = OrientationKMP(KMP.fit(TIMES, tangent, kernel=kernel, lambda_mean=1), auxiliary)
adapted = skill.adapt([[1.0]], [[0, 0, 0, 1]], np.zeros((3, 3)))

figure, axes = plt.subplots(figsize=(6.4, 3.6), layout="constrained")
for i, name in enumerate("xyzw"):
    axes.plot(TIMES, skill.mean(TIMES)[:, i], "--", color=f"C{i}", linewidth=0.8)
    axes.plot(TIMES, adapted.mean(TIMES)[:, i], color=f"C{i}", label=name)
axes.plot([1, 1], [0, 1], "o", color="0.1")
axes.set(xlabel="time [s]", ylabel="unit quaternion [-]")
axes.legend(frameon=False, ncols=4, loc="lower left")
plt.show()
