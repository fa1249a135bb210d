"""Random soldering scenes: places, speed, pauses and reversals of the hands, each from a seed and
its number.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from thirdhand_sim.lab.rehearsal import SESSION_NOISE_M, TREMOR_M
from thirdhand_sim.lab.results import Array
from thirdhand_sim.scene import MOST_MOVED, Scene
from thirdhand_sim.script import Clock, HandScript, ScriptPause

LOWEST_M = 0.05  # least height above the table
OFFSET_M = 0.008  # deviation of the hands' stops, each axis


class Drawn(NamedTuple):
    """A random scene, with the speed and the pauses of its hands."""

    scene: Scene
    speed: float
    pauses: tuple[ScriptPause, ...]
    seed: int

    def script(self) -> HandScript:
        """The hands: a new script each time, as its noise is drawn in order."""
        return HandScript(
            self.scene,
            seed=self.seed,
            speed=self.speed,
            pauses=self.pauses,
            offset_std=OFFSET_M,
            tremor_rms=TREMOR_M,
            noise_std=SESSION_NOISE_M,
        )

    @property
    def turns(self) -> int:
        """The number of times that the hands move back on their path."""
        return sum(pause.depth > 1 for pause in self.pauses)


def draw(number: int, *, seed: int) -> Drawn:
    """One random scene.

    Handover, glass and soldering place lie anywhere within 15 cm of the nominal ones, at least 5 cm
    above the table. Hands are 0.5 to 2 times as fast. In two scenes of three they pause once; in
    every other scene they move back on their path once, and forward again.
    """
    random = np.random.default_rng([seed, number])
    nominal = Scene()
    scene = Scene(
        handover=_moved(nominal.handover, random),
        glass=_moved(nominal.glass, random),
        soldering=_moved(nominal.soldering, random),
    )
    speed = float(2 ** random.uniform(-1, 1))
    lasts_s = scene.duration_s / speed
    pauses: list[ScriptPause] = []
    stops = random.random() < 2 / 3
    turns = random.random() < 1 / 2
    halves = [0, 1] if random.random() < 1 / 2 else [1, 0]
    for half, has_pause, depth, longest_s in (
        (halves[0], stops, 1.0, 2.0),
        (halves[1], turns, 2.0, 1.5),
    ):
        if has_pause:
            # Pause and reversal lie in different halves of the script; the first one delays the
            # second.
            at_s = (0.08 + 0.42 * half + random.uniform(0, 0.3)) * lasts_s
            pauses.append(ScriptPause(at_s, float(random.uniform(0.6, longest_s)), depth))
    ordered = sorted(pauses)
    if len(ordered) == 2:
        first, second = ordered
        ordered = [first, second._replace(at_s=second.at_s + first.depth * first.lasts_s)]
    return Drawn(scene, speed, tuple(_never_before_the_start(ordered, speed)), 1000 * seed + number)


def _never_before_the_start(pauses: list[ScriptPause], speed: float) -> list[ScriptPause]:
    """The pauses; reversals are shortened so that the hands do not move back beyond their start."""
    shorter = list(pauses)
    for i in range(len(shorter)):
        while (
            shorter[i].depth > 1
            and shorter[i].lasts_s > 0.6
            and _script_s_after(shorter[i], shorter, speed) < 0
        ):
            shorter[i] = shorter[i]._replace(lasts_s=max(0.6, shorter[i].lasts_s - 0.1))
    return shorter


def _script_s_after(pause: ScriptPause, pauses: list[ScriptPause], speed: float) -> float:
    return Clock(speed=speed, pauses=pauses).at(pause.at_s + pause.lasts_s)[0]


def _moved(
    place: tuple[float, float, float], random: np.random.Generator
) -> tuple[float, float, float]:
    """A random place in a ball around a place, and high enough above the table."""
    while True:
        step: Array = random.uniform(-1, 1, 3)
        x, y, z = np.round(np.array(place) + MOST_MOVED * step, 6).tolist()
        if np.linalg.norm(step) < 0.999 and z >= LOWEST_M:
            return x, y, z
