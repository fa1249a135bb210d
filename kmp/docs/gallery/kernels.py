"""Seven reference points and four kernels: between the points, and outside of them, the kernel
decides.
"""

import numpy as np
from matplotlib import pyplot as plt

from kmp import KMP, GaussianKernel, Gaussians, Matern32, PeriodicKernel

inputs = np.linspace(0, 2, 7)[:, None]  # [s]
heights = Gaussians.of([[0], [3], [5], [4], [6], [2], [0]], deviation=0.05)  # [cm]
kernels = {
    "Gaussian": GaussianKernel(8),
    "Matérn 3/2": Matern32(8),
    "sum of both, lengths 1 : 4": 0.5 * GaussianKernel(2) + 0.5 * Matern32(32),
    "periodic, 2 s": PeriodicKernel(8, period=2),
}

times = np.linspace(-0.5, 3, 300)[:, None]
figure, axes = plt.subplots(figsize=(6.4, 3.6), layout="constrained")
for name, kernel in kernels.items():
    skill = KMP.fit(inputs, heights, kernel=kernel, lambda_mean=0.01)
    axes.plot(times, skill.mean(times), label=name)
axes.plot(inputs, heights.mean, "o", color="0.1")
axes.set(xlabel="time [s]", ylabel="height [cm]", ylim=(-1.5, 9))
axes.legend(frameon=False, ncols=2, loc="upper center")
plt.show()
