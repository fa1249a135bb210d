"""Two skills in one: the priority moves from the first to the second within 0.4 s, and the path
changes over.
"""

import numpy as np
from letters import TIMES, demonstrations
from matplotlib import pyplot as plt

from kmp import KMP, GaussianKernel, Gaussians, superposed

letter = demonstrations()[0][1]  # [cm]
first = Gaussians.of(letter, deviation=0.2)
second = Gaussians.of(letter * [-1, 1] + [6, 0], deviation=0.2)  # its mirror image
priority = np.clip(0.5 + (1 - TIMES[:, 0]) / 0.4, 1e-3, 1 - 1e-3)
blended = superposed([first, second], [priority, 1 - priority])
skill = KMP.fit(TIMES, blended, kernel=GaussianKernel(8), lambda_mean=0.1)

figure, (left, right) = plt.subplots(1, 2, figsize=(7.2, 3.6), layout="constrained")
for name, reference in (("first", first), ("second", second)):
    left.plot(*reference.mean.T, "--", linewidth=0.8, label=name)
left.plot(*skill.mean(TIMES).T, color="0.1", label="superposed")
left.set(xlabel="x [cm]", ylabel="y [cm]", aspect="equal", xlim=(-6, 22))
left.legend(frameon=False, loc="right")
right.plot(TIMES, np.stack([priority, 1 - priority], axis=1))
right.set(xlabel="time [s]", ylabel="priority [-]")
plt.show()
