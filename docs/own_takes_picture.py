"""`python docs/own_takes_picture.py` draws own-takes.png: how far a skill of others, and the same
skill refined by three takes of a person, have the tool from where that person's teacher had it.
"""

from __future__ import annotations

from thirdhand.process import one_blas_thread  # noqa: F401

# isort: split
from pathlib import Path

import matplotlib as mpl

mpl.use("Agg")

import numpy as np
from matplotlib import pyplot as plt

from thirdhand.core.frame import Vector
from thirdhand.settings.palette import TOOL
from thirdhand.skills.skill_file import StoredSkill
from thirdhand.workbench.learning.learn import learn
from thirdhand_sim.lab.people.left_out import JUDGED_HZ, LeftOut, left_out, predicted
from thirdhand_sim.lab.reached import taught
from thirdhand_sim.made_tasks import takes

PICTURE = Path(__file__).with_name("own-takes.png")
DPI = 90
TASK = "three"
OTHERS = range(4)
PERSON = 32
OWN = 3
REST_MPS = 0.03  # both hands rest below this speed
PAUSE_S = 0.6  # a rest between the first and the last motion is a pause from this duration on


def missed_m(skill: StoredSkill, take: LeftOut) -> Vector:
    """Distance (T,) [m] of the predicted tool from the teacher's, the via-points being given."""
    said = predicted(taught(skill, take.demonstration.via_points), take)
    return np.asarray(np.linalg.norm(said.mean - take.tool, axis=1))


def pauses(take: LeftOut) -> list[tuple[float, float]]:
    """Begin and end [s] of each rest of both hands between their first and last motion."""
    speeds = np.linalg.norm(take.velocities.reshape(-1, 2, 3), axis=2).max(axis=1)
    edges = np.flatnonzero(np.diff((speeds < REST_MPS).astype(int), prepend=1, append=1))
    rests = zip(edges[1:-1:2], edges[2::2], strict=False)
    return [(a / JUDGED_HZ, b / JUDGED_HZ) for a, b in rests if b - a >= PAUSE_S * JUDGED_HZ]


def main() -> None:
    """Draw the picture beside this file."""
    of_others = learn(
        [one.demonstration for one in takes(TASK, people=OTHERS, each=2)], name="others"
    )
    mine = [one.demonstration for one in takes(TASK, people=[PERSON], each=2 * OWN)]
    refined = learn(mine[:OWN], name="mine", refined=of_others)
    rest = [left_out(f"take {OWN + 1 + i}", "", one) for i, one in enumerate(mine[OWN:])]
    skills = (
        ("skill of others", of_others, "0.6"),
        ("refined by three own takes", refined, np.array(TOOL) / 255),
    )
    figure, (along, over) = plt.subplots(
        1, 2, figsize=(11, 3.6), width_ratios=(2.2, 1.0), layout="constrained"
    )
    for k, (label, skill, colour) in enumerate(skills):
        errors = [missed_m(skill, take) for take in rest]
        worst = int(np.argmax([np.square(missed_m(of_others, take)).mean() for take in rest]))
        along.plot(rest[worst].times, 100 * errors[worst], color=colour, lw=2, label=label)
        rms_cm = [100 * np.sqrt(np.square(one).mean()) for one in errors]
        over.bar(np.arange(len(rest)) + 0.4 * k - 0.2, rms_cm, 0.38, color=colour)
    for begin, end in pauses(rest[worst]):
        along.axvspan(begin, end, color="0.93", zorder=0)
    along.set(
        xlabel="time [s]",
        ylabel="tool from the teacher's [cm]",
        title=f"{rest[worst].name}; grey: both hands rest",
    )
    along.legend(frameon=False)
    along.grid(alpha=0.3)
    over.set_xticks(range(len(rest)), [take.name for take in rest])
    over.set(ylabel="root mean square [cm]", title="Takes that were not learned from")
    figure.savefig(PICTURE, dpi=DPI)


if __name__ == "__main__":
    main()
