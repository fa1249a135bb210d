"""A goal that moves: three ends for one skill, and the skill without its via-points, which is the
learned one again.
"""

from letters import TIMES, demonstrations
from matplotlib import pyplot as plt

import kmp

skill = kmp.learn(demonstrations(), components=8).primitive
goals = [kmp.Gaussians.of(goal, deviation=0.01) for goal in ([-7, -3], [-8, -8], [-2, -4])]  # [cm]

figure, axes = plt.subplots(figsize=(5.4, 4.4), layout="constrained")
for goal in goals:
    adapted = skill.adapt(TIMES[-1:], goal)
    [line] = axes.plot(*adapted.mean(TIMES).T)
    axes.plot(*goal.mean.T, "o", color=line.get_color())

restored = adapted.without_via_points(TIMES[-1:])
axes.plot(*restored.mean(TIMES).T, "--", color="0.1", label="without via-points")
axes.set(xlabel="x [cm]", ylabel="y [cm]", aspect="equal")
axes.legend(frameon=False)
plt.show()
