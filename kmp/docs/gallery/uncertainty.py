"""The deviation and its two causes, differing demonstrations and distance from them (left), and
the same skill with three values of lambda_c, which leave the mean as it is (right).
"""

import numpy as np
from letters import demonstrations
from matplotlib import pyplot as plt

import kmp

skill = kmp.learn(demonstrations(), components=8).primitive
times = np.linspace(-0.5, 3, 200)[:, None]  # [s]; the demonstrations end at 2 s
parts = skill.uncertainty(times)

figure, (left, right) = plt.subplots(1, 2, figsize=(7.2, 3.4), layout="constrained")
for name in ("variability", "distance"):
    left.plot(times, np.sqrt(getattr(parts, name)[:, 0, 0]), label=name)
for factor in (0.3, 1, 3):
    scaled = skill.with_lambda_covariance(factor * skill.lambda_covariance)
    deviation = np.sqrt(scaled.predict(times).covariance[:, 0, 0])
    right.plot(times, deviation, label=f"{factor} lambda_c")
for axes in (left, right):
    axes.axvspan(0, 2, color="0.93", zorder=0)
    axes.set(xlabel="time [s]", ylabel="deviation of x [cm]")
    axes.legend(frameon=False, loc="upper center")
left.set(yscale="log", ylim=(1e-3, 10))
right.set(ylim=(0, 1.2))
plt.show()
