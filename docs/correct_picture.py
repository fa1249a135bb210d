"""`python docs/correct_picture.py` draws correct.png: the tool's motion before and after one
correction, in closed loop, as the left hand moves to the handover.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import matplotlib as mpl

mpl.use("Agg")

import msgspec
import numpy as np
from matplotlib import pyplot as plt

from thirdhand.core.controller import Controller, run
from thirdhand.core.frame import Frame, Tick, Vector
from thirdhand.core.skill.skill import Skill
from thirdhand.recordings.shipped import shipped_skill
from thirdhand.settings.config import Settings, robot_description
from thirdhand.settings.palette import LEFT, TOOL
from thirdhand.skills.corrections import corrected, correction_at
from thirdhand.skills.via_points import adapted
from thirdhand_sim.closed_loop import START_NS, hand_event
from thirdhand_sim.scene import Scene

PICTURE = Path(__file__).with_name("correct.png")
DPI = 90
# the correction is made halfway to the handover
SEGMENT = 0
SHARE = 0.5
LED_M = np.array([0.03, 0.0, 0.07])  # [m] displacement of the tool that is led
REST_S = 1.0
MOVE_S = 2.5
SAMPLE_TICKS = 5


def hands_at(skill: Skill, time_s: float) -> Vector:
    """Hands (6,) [m], which move once through the segment with minimum jerk."""
    t = min(max((time_s - REST_S) / MOVE_S, 0.0), 1.0)
    begin, end = skill.model.hands[SEGMENT : SEGMENT + 2]
    return np.asarray(begin + (10 * t**3 - 15 * t**4 + 6 * t**5) * (end - begin))


def motion(skill: Skill, path: Skill, settings: Settings) -> tuple[Vector, Vector]:
    """Left hand (T, 3) and tool (T, 3) [m] while the hands move through the segment of `path`."""
    times = np.arange(0.0, 2.0 * REST_S + MOVE_S, settings.period_s)

    def ticks() -> Iterator[Tick]:
        for k, time_s in enumerate(times):
            hands = hands_at(path, float(time_s)).reshape(2, 3)
            stamp_ns = START_NS + k * 2_000_000
            both = [
                hand_event(side, tuple(at), stamp_ns)
                for side, at in zip(("left", "right"), hands.tolist(), strict=True)
            ]
            yield Tick(k, tuple(both) if k % SAMPLE_TICKS == 0 else ())

    frames: list[Frame] = []
    controller = Controller(settings, skill, urdf=robot_description(settings))
    run(controller, ticks(), [lambda _, frame: frames.append(frame)])
    return np.array([frame["hands"][0] for frame in frames]), np.array(
        [frame["tool"] for frame in frames]
    )


def main() -> None:
    """Draw the picture beside this file."""
    settings = Settings()
    settings = msgspec.structs.replace(
        settings, arm=msgspec.structs.replace(settings.arm, source="assumed")
    )
    before = adapted(shipped_skill(), Scene().via_points(), tolerance=0.05)
    begin, end = before.model.hands[SEGMENT : SEGMENT + 2]
    held = begin + SHARE * (end - begin)
    tool = before.mean(held[None], [before.model.names[SEGMENT + 1]])[0] + LED_M
    made = correction_at(before, held, SEGMENT, tool)
    after, effect = corrected(before, made.among(before.via_points), made.point)

    begun = round(REST_S / settings.period_s)
    hand, old = (one[begun // 2 :] for one in motion(before, before, settings))
    _, new = (one[begun // 2 :] for one in motion(after, before, settings))
    green, blue = (np.array(colour) / 255 for colour in (TOOL, LEFT))
    figure, (side, change) = plt.subplots(
        1, 2, figsize=(11, 4), width_ratios=(1.3, 1.0), layout="constrained"
    )
    side.plot(hand[:, 0], hand[:, 2], "--", color=blue, label="left hand")
    side.plot(old[:, 0], old[:, 2], color="0.6", lw=2, label="tool before")
    side.plot(new[:, 0], new[:, 2], color=green, lw=2, label="tool after")
    side.plot(held[0], held[2], "o", color=blue, ms=9)
    side.text(held[0] + 0.012, held[2] + 0.01, "hand at the hold", color=blue)
    side.plot(tool[0], tool[2], "*", color=green, ms=15, mec="k")
    side.text(tool[0] + 0.015, tool[2], "led to here", va="center")
    side.set_ylim(top=tool[2] + 0.04)
    side.set(xlabel="x [m]", ylabel="z [m]", title="From the side")
    side.set_aspect("equal")
    side.grid(alpha=0.3)
    side.legend(frameon=False, loc="upper right")
    away = np.linalg.norm(hand - held[:3], axis=1) * np.where(hand[:, 0] > held[0], -1.0, 1.0)
    change.plot(100 * away, 100 * np.linalg.norm(new - old, axis=1), color=green, lw=2)
    change.axhline(50 * effect.moved_m, color="0.5", ls=":")
    for sign in (-1.0, 1.0):
        change.axvline(100 * sign * effect.reach_m, color="0.5", ls=":")
    change.text(
        0.0,
        50 * effect.moved_m - 0.3,
        f"reach {100 * effect.reach_m:.0f} cm",
        ha="center",
        va="top",
    )
    change.set(
        xlabel="left hand before and after the hold's place [cm]", ylabel="change of the tool [cm]"
    )
    change.set_title("How far the correction reaches")
    change.grid(alpha=0.3)
    figure.savefig(PICTURE, dpi=DPI)


if __name__ == "__main__":
    main()
