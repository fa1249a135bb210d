"""A via-point, and twelve paths drawn from the adapted skill: they meet in the point, which none of
the demonstrations passed through.
"""

from letters import TIMES, demonstrations
from matplotlib import pyplot as plt

import kmp

skill = kmp.learn(demonstrations(), components=8).primitive
point = kmp.Gaussians.of([2.5, 1.5], deviation=0)  # [cm], exact
adapted = skill.adapt([[1.0]], point)

figure, (left, right) = plt.subplots(1, 2, figsize=(7.2, 4.0), layout="constrained", sharey=True)
names = {"plane": (0, 1), "outputs": ["x", "y"], "output_unit": "cm"}
adapted.plot(axes=left, label="adapted", **names)
right.plot(*adapted.sample(TIMES, 12).T, color="C0", linewidth=0.6)
right.plot(*point.mean.T, "o", color="0.1", zorder=3)
right.set(xlabel="x [cm]", title="12 draws", aspect="equal")
plt.show()
