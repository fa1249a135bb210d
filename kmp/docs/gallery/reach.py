"""The change that a via-point at 1 s makes at other times, for three values of ell (left) and for
three kernels (right).
"""

import numpy as np
from letters import TIMES, demonstrations
from matplotlib import pyplot as plt

from kmp import KMP, GaussianKernel, Gaussians, Matern32, Matern52

reference = Gaussians.of(demonstrations()[0][1], deviation=0.3)  # [cm]
families = (
    {f"ell = {ell} / s²": GaussianKernel(ell) for ell in (2, 8, 32)},
    {
        "Gaussian, ell = 8 / s²": GaussianKernel(8),
        "Matérn 3/2, ell = 8 / s²": Matern32(8),
        "sum of two Matérn 5/2": 0.5 * Matern52(2) + 0.5 * Matern52(32),
    },
)

times = np.linspace(0, 2, 401)[:, None]  # [s]
figure, panels = plt.subplots(1, 2, figsize=(7.2, 3.4), layout="constrained", sharey=True)
for axes, kernels in zip(panels, families, strict=True):
    for name, kernel in kernels.items():
        skill = KMP.fit(TIMES, reference, kernel=kernel, lambda_mean=0.1)
        point = Gaussians.of(skill.mean([[1.0]]) + 1, deviation=0)
        change_cm = skill.adapt([[1.0]], point).mean(times) - skill.mean(times)
        axes.plot(times, change_cm[:, 0], label=name)
    axes.set(xlabel="time [s]", ylim=(-0.35, 1.7))
    axes.legend(frameon=False, loc="upper left", fontsize="small")
panels[0].set_ylabel("change of x [cm]")
plt.show()
