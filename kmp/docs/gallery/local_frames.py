"""A skill in two frames, one at the start and one at the goal: both are moved, and the path adapts
to them.
"""

import numpy as np
from letters import TIMES, demonstrations
from matplotlib import pyplot as plt

from kmp import CoordinateFrame, GaussianKernel, LocalKMP

random = np.random.default_rng(1)
ends_cm = 2 * random.normal(size=(8, 2, 2))  # each letter has another start and goal
share = TIMES / 2  # of the way
letters = [
    (times, path + (1 - share) * start + share * goal)
    for (times, path), (start, goal) in zip(demonstrations(8), ends_cm, strict=True)
]
frames = [CoordinateFrame.start_and_goal(path) for _, path in letters]
choice = {"kernel": GaussianKernel(8), "lambda_mean": 0.01, "components": 16}
skill = LocalKMP.learn(letters, frames, TIMES, **choice)

figure, axes = plt.subplots(figsize=(6.4, 4.2), layout="constrained")
axes.plot(*np.stack([path for _, path in letters]).T, color="0.7", linewidth=0.8)
for start, goal in (([4, 6], [-4, -6]), ([8, 6], [-8, -4]), ([6, 9], [2, -9])):
    placed = skill.placed((CoordinateFrame.at(start), CoordinateFrame.at(goal)))
    [line] = axes.plot(*placed.mean(TIMES).T)
    axes.plot(*start, "s", *goal, "o", color=line.get_color())
axes.plot([], [], "ks", label="start")
axes.plot([], [], "ko", label="goal")
axes.set(xlabel="x [cm]", ylabel="y [cm]", aspect="equal")
axes.legend(frameon=False)
plt.show()
