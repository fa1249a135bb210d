"""A letter from five demonstrations: their paths in grey, the mean, and its regions of 1 and 2
deviations.
"""

import numpy as np
from letters import TIMES, demonstrations
from matplotlib import pyplot as plt

import kmp

skill = kmp.learn(demonstrations(), components=8).primitive

figure = plt.figure(figsize=(7.2, 4.4), layout="constrained")
panels = figure.subplot_mosaic([["plane", "x"], ["plane", "y"]])
skill.plot(plane=(0, 1), axes=panels["plane"], outputs=["x", "y"], output_unit="cm")
paths = np.stack([path for _, path in demonstrations()])
panels["plane"].plot(*paths.T, color="0.6", linewidth=0.6)

for i, name in enumerate("xy"):
    panels[name].plot(TIMES, paths[:, :, i].T, color="0.6", linewidth=0.6)
    panels[name].plot(TIMES, skill.mean(TIMES)[:, i])
    panels[name].set(xlabel="time [s]", ylabel=f"{name} [cm]")
plt.show()
