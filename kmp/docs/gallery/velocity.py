"""A velocity via-point: the hand passes the same point at 1 s at rest, and at twice its speed; the
velocity is an output of its own.
"""

import numpy as np
from letters import TIMES, demonstrations
from matplotlib import pyplot as plt

import kmp

with_rates = [(t, np.hstack([x, np.gradient(x, t[:, 0], axis=0)])) for t, x in demonstrations()]
skill = kmp.learn(with_rates, components=8, velocity=True).primitive
now = skill.mean([[1.0]])[0]  # x y [cm], then their rates [cm/s]
points = {"at rest": [*now[:2], 0, 0], "twice as fast": [*now[:2], *2 * now[2:]]}

figure, (left, right) = plt.subplots(1, 2, figsize=(7.2, 3.4), layout="constrained")
left.plot(TIMES, skill.mean(TIMES)[:, 0], "--", color="0.5")
right.plot(TIMES, skill.mean(TIMES)[:, 2], "--", color="0.5", label="as learned")
for name, point in points.items():
    path = skill.adapt([[1.0]], kmp.Gaussians.of(point, deviation=0)).mean(TIMES)
    left.plot(TIMES, path[:, 0])
    [line] = right.plot(TIMES, path[:, 2], label=name)
    left.plot(1, point[0], "o", color="0.1", zorder=3)
    right.plot(1, point[2], "o", color=line.get_color())
left.set(xlabel="time [s]", ylabel="x [cm]")
right.set(xlabel="time [s]", ylabel="velocity of x [cm/s]")
right.legend(frameon=False)
plt.show()
