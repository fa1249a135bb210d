"""Change of what moving hands, sudden stops and other short sessions measure when a tuned number
of the core is halved or doubled.

A change is the mean over the first CHANGED seeds. It is compared with the noise of the figure: its
standard deviation over all seeds at the tuned value.
"""

from __future__ import annotations

import functools
import itertools
import math
from dataclasses import replace
from typing import Any, NamedTuple, TypeAlias

import msgspec
import numpy as np

from thirdhand.contract.records import SIDES, Cause, Flag, Mode
from thirdhand.core.controller import Controller
from thirdhand.core.frame import Tick, order
from thirdhand.core.skill.skill import Skill
from thirdhand.core.tuning import TUNING, Tuning
from thirdhand.recordings.shipped import recordings, shipped_skill
from thirdhand.settings.config import Box, Obstacles, Settings, robot_description
from thirdhand.skills.skill_file import decoded
from thirdhand_sim.closed_loop import START_NS, hand_event, joints_event
from thirdhand_sim.lab import motion, reached
from thirdhand_sim.lab.catalogue import EXPERIMENTS
from thirdhand_sim.lab.open_loop import targets
from thirdhand_sim.lab.people import moving_hands
from thirdhand_sim.lab.people.moving_hands import Moving
from thirdhand_sim.lab.rehearsal import SESSION_NOISE_M, TREMOR_M, rehearse
from thirdhand_sim.lab.results import Options, Results, brief
from thirdhand_sim.lab.rivals.followers import ours
from thirdhand_sim.lab.workers import shared_out
from thirdhand_sim.scene import Scene
from thirdhand_sim.script import HandScript

SensitivityFigures: TypeAlias = dict[str, float]

TUNING_STREAMS = EXPERIMENTS["sensitivity"].seeds.tuning
SEEDS_AT_USUAL = len(TUNING_STREAMS["people"].numbers)
CHANGED = 2  # seeds of the sessions with changed values
FACTORS = (0.5, 2.0)
MOTION_S = 4.0
STOP_RATES_HZ = {100: 0.0005, 30: 0.002, 15: 0.002}  # noise [m] of the trackers by rate
WITHOUT_HAND_S = (1.7, 2.3)  # begin and end of the time without a hand
# number of bursts of three outliers, and distance of the outliers
BURSTS = 4
BURST_M = 0.2
BOX = Box((0.52, -0.2, 0.36), (0.08, 0.04, 0.3))  # on the way to the handover
# initial amplitude of an arm's tremor, and time until it ends
TREMBLE_RAD = 0.05
TREMBLE_S = 1.0
# length of the session, and share of implausible samples
IMPLAUSIBLE_S = 4.0
ODD_SHARE = 0.02


class Number(NamedTuple):
    """A tuned number, or several in a row."""

    stage: str
    name: str
    value: Any

    @property
    def key(self) -> str:
        """Name of the number in the result."""
        return f"{self.stage}.{self.name}"

    def changed(self, factor: float) -> Any:
        """The number times a factor: a count stays whole, a share is at most 1, and probabilities
        become more or less equal.
        """
        if self.name == "mode_prior":
            powers = np.power(self.value, factor)
            return tuple((powers / powers.sum()).tolist())
        if isinstance(self.value, int):
            return round(self.value * factor)
        is_share = self.name.endswith(("_share", "_shares")) and np.max(self.value) < 1.0
        changed = np.minimum(np.multiply(self.value, factor), 1.0 if is_share else math.inf)
        return tuple(changed.tolist()) if changed.ndim else float(changed)

    def tuning(self, factor: float) -> Tuning:
        """All tuned numbers, with this one changed."""
        stage = getattr(TUNING, self.stage)._replace(**{self.name: self.changed(factor)})
        return TUNING._replace(**{self.stage: stage})


def numbers() -> dict[str, Number]:
    """The tuned numbers of all stages by key."""
    stages = TUNING._asdict()
    del stages["wish"]  # the experiment `seams` measures those
    all_numbers = [
        Number(stage, *item) for stage, tuned in stages.items() for item in tuned._asdict().items()
    ]
    return {number.key: number for number in all_numbers}


@functools.cache
def _skill() -> Skill:
    """A skill that depends on the hands' positions only."""
    return decoded((recordings() / motion.AS_PAPER).read_bytes(), origin=motion.AS_PAPER)


def _followed(hands: list[Moving], tuning: Tuning) -> list[motion.MotionFigures]:
    """Figures of sequences of hands that the core follows without the bench."""
    follow = ours(_skill(), Settings(), tuning)
    return [
        motion.figures("ours", sequence, targets(_skill(), sequence.truth), follow(sequence))
        for sequence in hands
    ]


def _person(seed: int) -> list[Moving]:
    middle = _skill().hands.mean(axis=0)
    people = moving_hands.modelled(
        middle, numbers=[TUNING_STREAMS["people"].numbers[seed]], seconds=MOTION_S
    )
    return [sequence for sequence in people if sequence.group in motion.FLOOR_GROUPS]


def moving(tuning: Tuning, seed: int) -> SensitivityFigures:
    """Hands as in `motion`, with a precise and with a poor tracker."""
    rows = _followed(_person(seed), tuning)
    return {
        name: float(np.mean([getattr(row, name) for row in rows]))
        for name in ("error_rms_mm", "jerk_ratio")
    }


def stops(tuning: Tuning, seed: int) -> SensitivityFigures:
    """Overshoot of sudden stops, as in `motion`, by the rate of the tracker."""
    middle = _skill().hands.mean(axis=0)
    stop = functools.partial(
        moving_hands.stops, middle, numbers=[TUNING_STREAMS["stops"].numbers[seed]]
    )
    hands = [stop(rate_hz=rate_hz, noise=noise)[0] for rate_hz, noise in STOP_RATES_HZ.items()]
    overshoots_mm = [row.overshoot_mm for row in _followed(hands, tuning)]
    return {
        f"overshoot_{rate_hz}_hz_mm": mm
        for rate_hz, mm in zip(STOP_RATES_HZ, overshoots_mm, strict=True)
    }


def disturbed(tuning: Tuning, seed: int) -> SensitivityFigures:
    """A hand out of sight, with late samples; bursts of outliers."""
    hands = _person(seed)[0]
    random = np.random.default_rng([TUNING_STREAMS["disturbed"].seed, seed])
    late = random.uniform(0.0, moving_hands.MOST_LATE_S, (len(hands.stamps), 2))
    late[(hands.stamps > WITHOUT_HAND_S[0]) & (hands.stamps < WITHOUT_HAND_S[1]), seed % 2] = (
        math.inf
    )

    wrong = hands.samples.copy()
    for begin in random.integers(0, len(wrong) - 3, BURSTS):
        away = random.standard_normal(3)
        wrong[begin : begin + 3, :3] += BURST_M * away / np.linalg.norm(away)

    variants = [replace(hands, late=late), replace(hands, samples=wrong)]
    named = list(zip(("late", "wrong"), _followed(variants, tuning), strict=True))
    errors = {f"{name}_error_rms_mm": row.error_rms_mm for name, row in named}
    return errors | {f"{name}_jerk_ratio": row.jerk_ratio for name, row in named}


def beside_a_box(tuning: Tuning, seed: int) -> SensitivityFigures:
    """The nominal scene on the bench, with a box on the way to the handover."""
    hands_seed = TUNING_STREAMS["hands"].numbers[seed]
    script = HandScript(Scene(), seed=hands_seed, tremor_rms=TREMOR_M, noise_std=SESSION_NOISE_M)
    settings = msgspec.structs.replace(Settings(), obstacles=Obstacles(boxes=(BOX,)))
    skill_for = reached.ours(Scene())
    rehearsal = rehearse(
        script, skill_for, rate_hz=100, settings=settings, tuning=tuning, keep=True
    )
    behind_m = np.linalg.norm(rehearsal.frames["setpoint"] - rehearsal.tool, axis=1)
    return {
        "handover_error_mm": rehearsal.errors_mm[0],
        "nearest_hand_mm": 1000 * float(rehearsal.frames["hand_distance"].min()),
        "behind_mm": 1000 * float(behind_m.max()),
        "joint_speed_rms_radps": float(np.sqrt(np.mean(rehearsal.joints[:, 1] ** 2))),
        "held_s": rehearsal.held_s,
        "stuck": float(np.mean(rehearsal.frames["flags"] & int(Flag.STUCK) > 0)),
    }


def implausible(tuning: Tuning, seed: int) -> SensitivityFigures:
    """An arm with a decreasing tremor, implausible joint states and hands, and a fast clock."""
    skill = reached.taught(shipped_skill(), Scene().via_points())
    settings = msgspec.structs.replace(
        Settings(), arm=msgspec.structs.replace(Settings().arm, source="state")
    )
    controller = Controller(settings, skill, urdf=robot_description(settings), tuning=tuning)
    random = np.random.default_rng([TUNING_STREAMS["implausible"].seed, seed])
    joints = np.array(settings.arm.posture)
    via_point = skill.via_points[2 - seed % 3]
    clock_drift = random.uniform(0.0, 0.04)
    frames: list[Any] = []
    for tick in range(1, round(IMPLAUSIBLE_S / settings.period_s)):
        time_s = tick * settings.period_s
        is_odd = time_s > 1.5 * TREMBLE_S and random.random() < ODD_SHARE
        measured = joints + max(0.0, 1.0 - time_s / TREMBLE_S) * TREMBLE_RAD * random.uniform(
            -1.0, 1.0, len(joints)
        )
        measured[0] += is_odd * random.uniform(0.05, 0.6)
        stamp_ns = START_NS + round(1e9 * time_s)
        inbox = [
            joints_event(
                settings.joints.names, tuple(measured.tolist()), (0.0,) * len(joints), stamp_ns
            )
        ]
        if tick % 5 == 1:
            left = np.array(via_point.left)
            right = np.array(via_point.right) + 0.05 * math.sin(2.0 * time_s)
            left += is_odd * random.uniform(0.0, 12.0)
            hand_ns = stamp_ns - round(1e9 * (clock_drift * time_s + random.exponential(0.003)))
            hands = zip(SIDES, (left, right), strict=True)
            inbox += [hand_event(side, tuple(hand.tolist()), hand_ns) for side, hand in hands]
        if frames and frames[-1]["mode"] == Mode.FAULT:
            inbox.append(order("reset", ""))
        frames.append(controller.step(Tick(tick, tuple(inbox))))
        joints = frames[-1]["joints"] if frames[-1]["mode"] == Mode.FOLLOW else joints
    following = np.array([frame["mode"] == Mode.FOLLOW for frame in frames])
    counts = {cause.name.lower(): float(frames[-1]["rejected"][cause]) for cause in Cause}
    return counts | {
        "ready_s": settings.period_s * np.argmax(following),
        "following": float(np.mean(following)),
    }


SESSIONS = (moving, stops, disturbed, beside_a_box, implausible)


def measured(task: tuple[str, float, int]) -> SensitivityFigures | str:
    """Figures of all sessions with a seed, with the number of this key times a factor (empty key:
    no change); or the error with which they fail.
    """
    key, factor, seed = task
    tuning = numbers()[key].tuning(factor) if key else TUNING
    try:
        figures = {session.__name__: session(tuning, seed) for session in SESSIONS}
    except (ArithmeticError, ValueError) as error:
        return f"{type(error).__name__}: {error}"
    return {
        f"{session}: {name}": float(value)
        for session, row in figures.items()
        for name, value in row.items()
    }


def effect(rows: list[SensitivityFigures | str], tuned: list[SensitivityFigures]) -> dict[str, Any]:
    """Mean change of the figures of `moving` [%] and `stops` [mm], and the largest change of any
    other figure in units of its noise. A change of a figure without noise counts as one noise.
    """
    failures = [row for row in rows if isinstance(row, str)]
    if failures:
        return {"fails": failures[0]}
    changes = SensitivityFigures()
    shares = SensitivityFigures()
    noises = SensitivityFigures()
    for name in tuned[0]:
        pairs = zip(rows, tuned, strict=False)
        changes[name] = float(
            np.mean([row[name] - before[name] for row, before in pairs if isinstance(row, dict)])
        )
        shares[name] = changes[name] / max(float(np.mean([before[name] for before in tuned])), 1e-9)
        noise = float(np.std([before[name] for before in tuned], ddof=1))
        noises[name] = abs(changes[name]) / noise if noise > 0.0 else float(changes[name] != 0.0)
    others = [name for name in tuned[0] if not name.startswith(("moving", "stops"))]
    largest = max(others, key=lambda name: (math.isfinite(noises[name]), noises[name]))
    return {
        "moving_percent": [100.0 * shares[name] for name in shares if name.startswith("moving")],
        "stops_mm": [change for name, change in changes.items() if name.startswith("stops")],
        "largest": f"{largest} {changes[largest]:+.3g}",
        "noises": noises[largest],
    }


def run(results: Results, options: Options) -> dict[str, Any]:
    """The effect of each number, by its key and the factor; with fewer seeds for a quick look."""
    all_numbers = numbers().values()
    seeds = range(math.ceil(options.share * CHANGED))
    noise_seeds = range(max(3, round(options.share * SEEDS_AT_USUAL)))
    tasks = [("", 1.0, seed) for seed in noise_seeds]
    tasks += [
        (number.key, factor, seed) for number in all_numbers for factor in FACTORS for seed in seeds
    ]
    outcomes = shared_out(measured, tasks, options.workers)
    tuned = [row for row in itertools.islice(outcomes, len(noise_seeds)) if isinstance(row, dict)]
    out: dict[str, Any] = {}
    for number in all_numbers:
        effects = {
            f"{factor:g}": effect(list(itertools.islice(outcomes, len(seeds))), tuned)
            for factor in FACTORS
        }
        out[number.key] = {"value": number.value, "effects": effects}
        results.say(f"{number.key}: {brief(effects)}")
        results.numbers({"numbers": out})
    return {"numbers": out}
