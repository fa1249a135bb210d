"""A skill without time: two hands on a line lead a tool between them, and a via-point raises the
tool where the hands are near 20 and 60 cm.
"""

import numpy as np
from matplotlib import pyplot as plt

from kmp import KMP, GaussianKernel, Gaussians

hands = np.random.default_rng(0).uniform(0, 0.8, size=(80, 2))  # left, right [m]
height = Gaussians.of(hands.mean(axis=1, keepdims=True), deviation=0.01)  # [m]
skill = KMP.fit(hands, height, kernel=GaussianKernel([10, 10]), lambda_mean=300)
adapted = skill.adapt([[0.2, 0.6]], Gaussians.of([0.6], deviation=0))

line = np.linspace(0, 0.8, 60)
left, right = np.meshgrid(line, line)
queries = np.stack([left.ravel(), right.ravel()], axis=1)
figure, panels = plt.subplots(1, 2, figsize=(7.2, 3.4), layout="constrained", sharey=True)
for axes, primitive, title in zip(panels, (skill, adapted), ("as learned", "adapted"), strict=True):
    height_m = primitive.mean(queries).reshape(left.shape)
    drawn = axes.contourf(left, right, 100 * height_m, levels=np.arange(0, 85, 5), extend="both")
    axes.plot(*hands.T, ".", color="w", markersize=2)
    axes.set(xlabel="left hand [m]", title=title, aspect="equal")
panels[0].set_ylabel("right hand [m]")
panels[1].plot(0.2, 0.6, "o", color="0.1")
figure.colorbar(drawn, ax=panels, label="height of the tool [cm]")
plt.show()
