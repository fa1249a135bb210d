"""Error, lag, smoothness and stops of a tool that follows moving hands, beside rivals.

Errors are distances of the tool from the skill's target for the true hands at the same instant, lag
included.
"""

from __future__ import annotations

import functools
import itertools
import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import msgspec
import numpy as np
import rerun as rr

from thirdhand.core.skill.skill import Skill
from thirdhand.recordings.shipped import ARMS, cell_of, recordings
from thirdhand.settings.config import Settings
from thirdhand.skills.demonstration import Demonstration
from thirdhand.skills.skill_file import decoded
from thirdhand.workbench.learning.learn import learn
from thirdhand_sim.lab import gains, slow_hands, spectra
from thirdhand_sim.lab.catalogue import EXPERIMENTS
from thirdhand_sim.lab.open_loop import targets
from thirdhand_sim.lab.people.moving_hands import (
    PERIOD_S,
    SMALL_KINDS,
    STOP_S,
    Moving,
    modelled,
    person,
    reaches,
    recorded,
    slow,
    small_motion,
    stops,
)
from thirdhand_sim.lab.results import (
    ADAPTED,
    LEFT_COLOUR,
    OTHER,
    REFERENCE,
    RIGHT_COLOUR,
    TOOL_COLOUR,
    Array,
    Options,
    Results,
    brief,
    legend_below,
    pyplot,
    rgb,
)
from thirdhand_sim.lab.rivals.followers import (
    Followed,
    Follower,
    chase,
    ours,
    servo,
    truth,
    unsmoothed,
)
from thirdhand_sim.lab.rivals.linear_filters import best_linear, error_at
from thirdhand_sim.lab.workers import shared_out

TRIED_LAGS_S = (-0.06, 0.2)  # range of the lags that are tried
MOTION_SEEDS = EXPERIMENTS["motion"].seeds
PEOPLE, STOPS, SCENE, SMALL = (
    MOTION_SEEDS.evaluation[name] for name in ("people", "stops", "hands", "small")
)
SMALL_HZ = range(1, 13)
SECONDS = 15.0
SETTLED_MM = 5.0
# [s] Not judged before this time: recordings may begin in motion, the tool begins at rest.
BEGUN_S = 1.0
DIALS = ("closely", "calmly")  # values of `[tool] follow`, besides the default
# cut-off [Hz] and beta of the One-Euro filter: untuned, tuned
CHASES = ((1.5, 8.0), (2.0, 40.0), (4.0, 40.0))
SERVOS = (1.5, 20.0)  # coefficients of the Butterworth filter: the plug-in's default, smoother
MOTION_LABELS = {
    "ours": "ours, by [tool] follow (ringed: the default)",
    "chase": "One-Euro filter, then Ruckig after the target",
    "servo": "as MoveIt Servo: Butterworth and Ruckig on the joints",
}
# the follower and the group whose frequencies are shown
TRUTH = "truth"
SMOOTH = "minimum jerk"
FLOOR_GROUPS = {"clean": 100, "recorded": 30}  # Hz
# name of the group of recorded hands in which followers should follow jumps
WITH_JUMPS = "recorded, jumps in the truth"
HARDER_GROUPS = ("late", "unseen")  # clean hands made harder; only ours is measured
TICKS_MM = (1, 2, 5, 10, 20)
AS_PAPER = "experiments/as-paper.npz"
# the skill's part of a group's name
SHIPPED_SKILL_HANDS = ""
OF_SUCH_HANDS = ", skill of such hands"
TEACHERS = MOTION_SEEDS.learned["teachers"].numbers  # people who are not followed
# duration of a take for such a skill [s], and ticks from one sample to the next
TAUGHT_S = 20.0
TAUGHT_EVERY = 10
# motion of the tool in these takes, per motion of a hand
LEFT_GAIN = 0.8
RIGHT_GAIN = 0.5


@dataclass(frozen=True)
class MotionFigures:
    """One sequence with one follower.

    Overshoot and settling are only those of sudden stops, all other figures only those of other
    sequences.
    """

    follower: str
    group: str
    name: str
    person: str
    error_rms_mm: float
    error_p95_mm: float
    lag_ms: float
    acceleration_ratio: float  # root mean square, relative to the truth's
    jerk_ratio: float
    limited: float  # share of ticks in which a limit is reached
    top_speed: float  # [m/s] of the tool
    overshoot_mm: float
    settled_ms: float
    joint_speeds: list[float]  # [rad/s] by frequency, see `spectra`
    tracker: str = ""  # kind of tracker of recorded hands
    error_with_jumps_mm: float = math.nan  # rms error against the truth with the tracker's jumps


def derivative(path: Array, period_s: float, *, order: int) -> Array:
    """The derivative of an order by central differences, of the path's shape [m/s^order]."""
    for _ in range(order):
        path = np.gradient(path, period_s, axis=0)
    return path


def rms(rows: Array) -> float:
    """Root mean square of the norms of rows (N, 3)."""
    return float(np.sqrt(np.mean(np.sum(rows**2, axis=1))))


def lag_ms(target: Array, tool: Array, period_s: float) -> float:
    """The lag [ms] within TRIED_LAGS_S with the largest cross-correlation of the speeds; NaN for a
    path that is too short, or a target that does not move.
    """
    first, last = (round(limit_s / period_s) for limit_s in TRIED_LAGS_S)
    begin = -2 * first
    end = len(target) - last + 2 * first
    if end <= begin:
        return math.nan
    target_speed, tool_speed = (
        np.linalg.norm(derivative(path, period_s, order=1), axis=1) for path in (target, tool)
    )
    inner = (target_speed - target_speed.mean())[begin:end]
    tool_speed = tool_speed - tool_speed.mean()
    if not inner.any():
        return math.nan
    score = [float(inner @ tool_speed[begin + k : end + k]) for k in range(first, last + 1)]
    return float(1000 * period_s * (int(np.argmax(score)) + first))


def skill_of_such_hands(shipped: Skill, middle: Array) -> Skill:
    """A skill learned from modelled people whose tool moves with both hands."""
    centre = shipped.mean(middle[None])[0]
    demonstrations = []
    for seed in TEACHERS:
        hands = person(seed, middle, TAUGHT_S)[::TAUGHT_EVERY]
        moved = hands - middle
        tool = centre + LEFT_GAIN * moved[:, :3] + RIGHT_GAIN * moved[:, 3:]
        stamps_ns = np.arange(len(hands)) * round(1e9 * PERIOD_S * TAUGHT_EVERY)
        poses = [
            np.hstack([x, np.tile(shipped.orientation, (len(x), 1))])
            for x in (hands[:, :3], hands[:, 3:], tool)
        ]
        demonstrations.append(Demonstration(stamps_ns, poses[0], poses[1], poses[2]))
    return learn(demonstrations, name="of such hands", components=10)


def followers(skill: Skill, settings: Settings, share: float) -> dict[str, Follower]:
    """All followers; for a quick look, ours and one of each kind."""
    by_name = {"ours": ours(skill, settings)}
    first = None if share == 1 else 1
    for dial in DIALS if share == 1 else ():
        tool = msgspec.structs.replace(settings.tool, follow=dial)
        by_name[f"ours, {dial}"] = ours(skill, msgspec.structs.replace(settings, tool=tool))
    for least_hz, beta in CHASES[:first]:
        by_name[f"chase, One-Euro {least_hz:g} Hz, {beta:g}"] = chase(
            skill, settings, least_hz=least_hz, beta=beta
        )
    for coefficient in SERVOS[:first]:
        by_name[f"servo, Butterworth {coefficient:g}"] = servo(
            skill, settings, coefficient=coefficient
        )
    by_name["no smoothing"] = unsmoothed(skill, settings)
    by_name[TRUTH] = truth(skill, settings)
    return by_name


def sequences(options: Options, middle: Array) -> list[Moving]:
    """The modelled hands that are followed."""
    share = options.share
    offset = options.seed_offset
    people_numbers = PEOPLE.moved(offset).share(share)
    people = modelled(middle, numbers=people_numbers, seconds=max(4.0, SECONDS * share))
    # quick look
    if share < 1:
        people = [sequence for sequence in people if sequence.group in FLOOR_GROUPS]
    numbers = STOPS.moved(offset).share(share, least=2)
    return [
        *people,
        *reaches(seeds=SCENE.moved(offset).numbers),
        *stops(middle, numbers=numbers),
        *stops(middle, numbers=numbers, rate_hz=30, noise=0.002, group="sudden stops, 30 Hz, 2 mm"),
    ]


_known: dict[str, Any] = {}


def prepare(share: float, arm: str) -> None:
    """Load the skills and their followers, once in each process."""
    settings = cell_of(arm)
    # A skill that depends on the hands' positions only, so that only the followers differ.
    skill = decoded((recordings() / AS_PAPER).read_bytes(), origin=AS_PAPER)
    other = skill_of_such_hands(skill, skill.hands.mean(axis=0))
    for skill_key, loaded_skill in ((SHIPPED_SKILL_HANDS, skill), (OF_SUCH_HANDS, other)):
        _known[skill_key] = loaded_skill, settings, followers(loaded_skill, settings, share)


def measure(task: tuple[str, str, Moving]) -> MotionFigures:
    """The figures of one sequence with one follower, by one of the skills."""
    name, skill_key, hands = task
    skill, settings, by_name = _known[skill_key]
    target = targets(skill, hands.truth, settings)
    followed = by_name[name](hands)
    result = figures(name, replace(hands, group=hands.group + skill_key), target, followed)
    if hands.jumping is None:
        return result
    begun = round(BEGUN_S / PERIOD_S)
    error_m = followed.tool[begun:] - targets(skill, hands.jumping[begun:], settings)
    return replace(result, error_with_jumps_mm=1000 * rms(error_m))


def measure_gain(task: tuple[str, str, float, int]) -> list[float]:
    """Gains of small motion of a kind and a frequency [Hz], from target to setpoint and tool."""
    name, kind, rate_hz, number = task
    skill, settings, by_name = _known[SHIPPED_SKILL_HANDS]
    hands = small_motion(skill.hands.mean(axis=0), kind, rate_hz, number)
    target = targets(skill, hands.truth, settings)
    followed = by_name[name](hands)
    assert followed.setpoint is not None
    return [gains.gain(target, path, rate_hz) for path in (followed.setpoint, followed.tool)]


def measure_slow(task: tuple[str, float, int, int]) -> list[list[float]]:
    """Speeds of target and tool while a hand begins to move at a speed [m/s], see `slow_hands`."""
    name, speed_mps, rate_hz, number = task
    skill, settings, by_name = _known[SHIPPED_SKILL_HANDS]
    noise = slow_hands.TRACKERS[rate_hz]
    hands = slow(skill.hands.mean(axis=0), speed_mps, rate_hz, noise, number)
    target = targets(skill, hands.truth, settings)
    return slow_hands.curves(target, by_name[name](hands).tool)


def figures(name: str, hands: Moving, target: Array, seen: Followed) -> MotionFigures:
    """Figures of a path against the truth's target (N, 3) [m], from BEGUN_S on."""
    tool = seen.tool
    begun = round(BEGUN_S / PERIOD_S)
    overshoot = settled = math.nan
    if not math.isnan(hands.stop_s):
        begin = round(hands.stop_s / PERIOD_S)
        end = round((hands.stop_s + STOP_S) / PERIOD_S)
        velocity = derivative(target, PERIOD_S, order=1)[begin]
        excess_m = (tool[begin:] - target[-1]) @ (velocity / np.linalg.norm(velocity))
        overshoot = max(0.0, 1000 * float(excess_m.max()))
        late = np.flatnonzero(1000 * np.linalg.norm(tool[end:] - target[-1], axis=1) > SETTLED_MM)
        settled = 1000 * PERIOD_S * (int(late[-1]) + 1) if len(late) else 0.0
    tool = tool[begun:]
    target = target[begun:]
    off_mm = 1000 * np.linalg.norm(tool - target, axis=1)
    wanted_acceleration, acceleration = (derivative(x, PERIOD_S, order=2) for x in (target, tool))
    return MotionFigures(
        name,
        hands.group,
        hands.name,
        hands.person,
        error_rms_mm=float(np.sqrt(np.mean(off_mm**2))),
        error_p95_mm=float(np.percentile(off_mm, 95)),
        lag_ms=lag_ms(target, tool, PERIOD_S),
        acceleration_ratio=rms(acceleration) / rms(wanted_acceleration),
        jerk_ratio=rms(derivative(tool, PERIOD_S, order=3))
        / rms(derivative(target, PERIOD_S, order=3)),
        limited=seen.limited,
        top_speed=seen.top_speed,
        overshoot_mm=overshoot,
        settled_ms=settled,
        joint_speeds=spectra.speeds(seen.tool, seen.joints),
        tracker=hands.tracker,
    )


def run(results: Results, options: Options) -> dict[str, Any]:
    """Follow all hands with all followers; returns the numbers for the JSON."""
    prepare(options.share, options.arm)
    skill, _, by_name = _known[SHIPPED_SKILL_HANDS]
    if options.hands is not None:
        return _of_recorded(results, options, recorded(options.hands, skill.hands.mean(axis=0)))
    hands = sequences(options, skill.hands.mean(axis=0))
    chase = [name for name in by_name if name.startswith("chase")][-1]
    by_both = ["ours", chase]
    floor_hands = [sequence for sequence in hands if sequence.group in FLOOR_GROUPS]
    tasks = [
        (name, SHIPPED_SKILL_HANDS, sequence)
        for name, sequence in itertools.product(by_name, hands)
        if name != TRUTH or sequence.group == SMOOTH
    ]
    tasks += [
        (name, OF_SUCH_HANDS, sequence)
        for name, sequence in itertools.product(by_both, floor_hands)
    ]
    measured = _measured(tasks, options)
    table = {
        name: _summary([row for row in measured if row.follower == name])
        for name in by_name
        if name != TRUTH
    }
    for name, groups in table.items():
        results.say(f"{name}: {brief(groups)}")
    _record(results, hands[1], by_name["ours"](hands[1]))
    numbers = {
        "hands": "modelled",
        "by_follower": table,
        "by_person": _by_person(results, [row for row in measured if math.isnan(row.overshoot_mm)]),
        "best_linear_filter": _floors(floor_hands, skill),
        "gain_by_frequency": _gains(results, options, {"ours": "ours", "chase": chase}),
        "slow_hands": _slow(results, options, {"ours": "ours", "chase": chase}),
        "joint_speeds_in_the_scene": _joint_speeds(measured, (TRUTH, *by_both, "no smoothing")),
        "by_sequence": [msgspec.to_builtins(row) for row in measured if row.follower == "ours"],
        "by_arm": _by_arm(results, options, floor_hands),
    }
    draw_numbers(results, numbers)
    return numbers


def _floors(hands: Sequence[Any], skill: Skill) -> dict[str, list[dict[str, Any]]]:
    """The best linear filters of each group of hands."""
    floors: dict[str, list[dict[str, Any]]] = {}
    for group, rate_hz in FLOOR_GROUPS.items():
        sequences_of_group = [sequence for sequence in hands if sequence.group == group]
        rows = best_linear(sequences_of_group, skill, rate_hz=rate_hz)
        floors[group] = [floor._asdict() for floor in rows]
    return floors


def _summary(rows: list[MotionFigures]) -> dict[str, dict[str, float]]:
    """Means over the sequences of each group; for stops also the worst."""
    out: dict[str, dict[str, float]] = {}
    for group in dict.fromkeys(row.group for row in rows):
        of = [row for row in rows if row.group == group]
        top = max(row.top_speed for row in of)
        if math.isnan(of[0].overshoot_mm):
            names = (
                "error_rms_mm",
                "error_p95_mm",
                "lag_ms",
                "acceleration_ratio",
                "jerk_ratio",
                "limited",
            )
            out[group] = {
                name: float(np.mean([getattr(row, name) for row in of])) for name in names
            }
        else:
            overshoot = [row.overshoot_mm for row in of]
            settled = [row.settled_ms for row in of]
            out[group] = {
                "overshoot_mean_mm": float(np.mean(overshoot)),
                "overshoot_worst_mm": max(overshoot),
                "settled_worst_ms": max(settled),
            }
        out[group]["top_speed"] = top
    return out


def _measured(tasks: list[tuple[str, str, Moving]], options: Options) -> list[MotionFigures]:
    """The figures of all tasks, shared out over processes."""
    begin = functools.partial(prepare, options.share, options.arm)
    return list(shared_out(measure, tasks, options.workers, prepare=begin))


def _beside_chases(hands: list[Moving]) -> list[tuple[str, str, Moving]]:
    """The tasks of the service and of the chases on these hands."""
    names = [
        name
        for name in _known[SHIPPED_SKILL_HANDS][2]
        if name == "ours" or name.startswith("chase")
    ]
    return [(name, SHIPPED_SKILL_HANDS, sequence) for name in names for sequence in hands]


def _by_arm(
    results: Results, options: Options, hands: list[Moving]
) -> dict[str, dict[str, dict[str, float]]]:
    """The errors with each shipped arm by group, see `_compared`."""
    tasks = _beside_chases(hands)
    out = {}
    for arm in ARMS:
        # prepares this process, which measures if there is one worker
        prepare(options.share, arm)
        measured = _measured(tasks, replace(options, arm=arm))
        out[arm] = {
            group: _compared([row for row in measured if row.group == group])
            for group in FLOOR_GROUPS
        }
        results.say(f"{arm}, rms [mm]: {brief(out[arm])}")
    return out


def _gains(results: Results, options: Options, names: dict[str, str]) -> dict[str, Any]:
    """The gains of small motion by kind, follower and path, rms over the numbers of the stream."""
    rates = list(SMALL_HZ if options.share == 1 else SMALL_HZ[1::4])
    numbers = SMALL.moved(options.seed_offset).share(options.share)
    tasks = [
        (name, kind, float(hz), number)
        for kind in SMALL_KINDS
        for name in names.values()
        for hz in rates
        for number in numbers
    ]
    begin = functools.partial(prepare, options.share, options.arm)
    values = np.array(list(shared_out(measure_gain, tasks, options.workers, prepare=begin)))
    values = values.reshape(
        len(SMALL_KINDS), len(names), len(rates), len(numbers), len(gains.PATHS)
    )
    means = np.sqrt(np.mean(values**2, axis=3))
    out: dict[str, Any] = {"hz": rates}
    for kind, of_kind in zip(SMALL_KINDS, means, strict=True):
        out[kind] = {
            follower: dict(zip(gains.PATHS, of.T.tolist(), strict=True))
            for follower, of in zip(names, of_kind, strict=True)
        }
        results.say(f"gain of {kind}, by Hz: {brief(out[kind])}")
    return out


def _slow(results: Results, options: Options, names: dict[str, str]) -> dict[str, Any]:
    """Evenness of the tool's motion, and the first curve, by speed and tracker, and follower."""
    numbers = STOPS.moved(options.seed_offset).share(options.share / 3.0, least=2)
    begin = functools.partial(prepare, options.share, options.arm)
    kinds = list(itertools.product(slow_hands.SLOW_HANDS_MPS, slow_hands.TRACKERS))
    tasks = [
        (name, speed_mps, rate_hz, number)
        for speed_mps, rate_hz in kinds
        for name in names.values()
        for number in numbers
    ]
    values = np.array(list(shared_out(measure_slow, tasks, options.workers, prepare=begin)))
    values = values.reshape(len(kinds), len(names), len(numbers), *values.shape[1:])
    out: dict[str, Any] = {}
    for (speed_mps, rate_hz), of_kind in zip(kinds, values, strict=True):
        found = {name: slow_hands.evenness(rows) for name, rows in zip(names, of_kind, strict=True)}
        results.say(f"{1000 * speed_mps:g} mm/s, {rate_hz} Hz: {brief(found)}")
        out[f"{1000 * speed_mps:g} mm/s, {rate_hz} Hz"] = {
            name: {**found[name], "first": np.round(rows[0], 5).tolist()}
            for name, rows in zip(names, of_kind, strict=True)
        }
    return out


def _of_recorded(results: Results, options: Options, hands: list[Moving]) -> dict[str, Any]:
    """The numbers of recorded hands: the service beside the chases; and with late or missing
    samples.
    """
    harder = [
        ("ours", SHIPPED_SKILL_HANDS, sequence)
        for sequence in hands
        if sequence.group in HARDER_GROUPS
    ]
    hands = [sequence for sequence in hands if sequence.group in FLOOR_GROUPS]
    measured = _measured(_beside_chases(hands), options)
    takes = Counter(sequence.person for sequence in hands if sequence.group == "clean")
    measured += [
        replace(row, group=WITH_JUMPS, error_rms_mm=row.error_with_jumps_mm)
        for row in measured
        if row.group == "recorded"
    ]
    people = _by_person(results, measured)
    kinds = {person: _usual_tracker(measured, person) for person in takes}
    together: dict[str, dict[str, float]] = {}
    trackers: dict[str, dict[str, dict[str, float]]] = {}
    for group in people:
        of = [row for row in measured if row.group == group]
        together[group] = _compared(of)
        results.say(f"{group}, all: {brief(together[group])}")
        trackers[group] = {
            kind: _compared([row for row in of if kinds[row.person] == kind])
            for kind in sorted(set(kinds.values()))
        }
        results.say(f"{group}, by tracker: {brief(trackers[group])}")
    bound = _bound(
        results, [sequence for sequence in hands if sequence.group == "recorded"], measured
    )
    worse = {}
    of_harder = _measured(harder, options)
    for group in HARDER_GROUPS:
        error_mm = _pooled([row for row in of_harder if row.group == group], "ours")
        worse[group] = {"ours": error_mm, "times_clean": error_mm / together["clean"]["ours"]}
        results.say(f"{group}, all: {brief(worse[group])}")
    numbers = {
        "hands": "recorded",
        "takes": dict(takes),
        "trackers": kinds,
        "by_person": people,
        "by_tracker": trackers,
        "all": together,
        "best_linear_filter": bound,
        "harder": worse,
    }
    draw_numbers(results, numbers)
    return numbers


def _bound(
    results: Results, hands: list[Moving], found: list[MotionFigures]
) -> dict[str, dict[str, float]]:
    """Errors [mm] by tracker: of the service, and of the best linear filter with the same jerk,
    fitted to each recording; medians over recordings.
    """
    skill = _known[SHIPPED_SKILL_HANDS][0]
    mine = {
        row.name: row for row in found if row.follower == "ours" and row.group == hands[0].group
    }
    errors: dict[str, list[tuple[float, float]]] = {}
    for sequence in hands:
        floors = best_linear(
            [sequence], skill, rate_hz=round(1 / float(np.median(np.diff(sequence.stamps))))
        )
        pair = mine[sequence.name].error_rms_mm, error_at(floors, mine[sequence.name].jerk_ratio)
        for kind in (sequence.tracker, "all"):
            errors.setdefault(kind, []).append(pair)
    out = {
        kind: dict(zip(("ours", "bound"), np.median(pairs, axis=0).tolist(), strict=True))
        for kind, pairs in errors.items()
    }
    results.say(f"recorded, beside the best linear filters: {brief(out)}")
    return out


def _by_person(
    results: Results, rows: list[MotionFigures]
) -> dict[str, dict[str, dict[str, float]]]:
    """The errors of each group and person, see `_compared`."""
    out: dict[str, dict[str, dict[str, float]]] = {}
    for group in dict.fromkeys(row.group for row in rows):
        of = [row for row in rows if row.group == group]
        people = dict.fromkeys(row.person for row in of)
        out[group] = {
            person: _compared([row for row in of if row.person == person]) for person in people
        }
        results.say(f"{group}, rms [mm]: {brief(out[group])}")
    return out


def _compared(rows: list[MotionFigures]) -> dict[str, float]:
    """Errors [mm] over sequences, root mean square and median, of the service and of the best chase
    for each person; and the service's median lag.
    """
    errors: dict[str, list[float]] = {"ours": [], "chase": []}
    for name in dict.fromkeys(row.person for row in rows):
        mine = [row for row in rows if row.person == name]
        chases = sorted({row.follower for row in mine if row.follower.startswith("chase")})
        best = min(chases, key=lambda follower: _pooled(mine, follower))
        for family, follower in (("ours", "ours"), ("chase", best)):
            errors[family] += [row.error_rms_mm for row in mine if row.follower == follower]
    out = {
        family: float(np.sqrt(np.mean(np.square(errors_mm))))
        for family, errors_mm in errors.items()
    }
    medians = {
        f"{family}_median": float(np.median(errors_mm)) for family, errors_mm in errors.items()
    }
    ratios = {
        "ratio": out["ours"] / out["chase"],
        "ratio_of_medians": medians["ours_median"] / medians["chase_median"],
    }
    lag_ms = float(np.median([row.lag_ms for row in rows if row.follower == "ours"]))
    return {**out, **ratios, **medians, "lag_ms": lag_ms, "takes": len(errors["ours"])}


def _usual_tracker(rows: list[MotionFigures], name: str) -> str:
    """The kind of tracker that recorded most sequences of a person."""
    return Counter(row.tracker for row in rows if row.person == name).most_common(1)[0][0]


def _joint_speeds(found: list[MotionFigures], names: tuple[str, ...]) -> dict[str, dict[str, Any]]:
    """The joints' speeds by frequency and the share of ripple, for each follower."""
    rows = {
        row.follower: row.joint_speeds
        for row in found
        if row.group == SMOOTH and row.follower in names
    }
    kinds = {name.partition(",")[0]: rows[name] for name in names}
    return {
        kind: {"bands": bands, "ripple": spectra.ripple(bands)} for kind, bands in kinds.items()
    }


def _pooled(rows: list[MotionFigures], follower: str) -> float:
    return math.sqrt(np.mean([row.error_rms_mm**2 for row in rows if row.follower == follower]))


def draw_numbers(results: Results, numbers: dict[str, Any]) -> None:
    """The figure of the experiment's numbers: error against jerk of every follower and of the best
    linear filters; for recorded hands each person's error, ours against the chase's.
    """
    plt = pyplot()
    figure, axes = plt.subplots(1, len(FLOOR_GROUPS), figsize=(10, 4.2), layout="constrained")
    for panel, group in zip(axes, FLOOR_GROUPS, strict=True):
        if "by_follower" in numbers:
            _draw_followers(
                panel, numbers["by_follower"], group, numbers["best_linear_filter"][group]
            )
            recorded_title = "as a camera sees them, 30 Hz"
        else:
            _draw_people(panel, numbers["by_person"][group])
            recorded_title = "as recorded"
        panel.set_title("clean, 100 Hz" if group == "clean" else recorded_title)
    legend_below(figure, axes[0].get_legend_handles_labels()[0], columns=3)
    results.figure(figure)
    if "by_follower" in numbers:
        spectra.draw(
            results,
            {kind: row["bands"] for kind, row in numbers["joint_speeds_in_the_scene"].items()},
        )
        gains.draw(results, numbers["gain_by_frequency"])
        slow_hands.draw(results, numbers["slow_hands"])


def _draw_followers(
    panel: Any, table: dict[str, Any], group: str, floor: list[dict[str, float]]
) -> None:
    styles = {
        "ours": (TOOL_COLOUR, "o"),
        "chase": (ADAPTED, "s"),
        "servo": (OTHER, "^"),
        "no smoothing": (REFERENCE, "D"),
    }
    for family, (colour, marker) in styles.items():
        rows = {name: groups[group] for name, groups in table.items() if name.startswith(family)}
        points = sorted((f["jerk_ratio"], f["error_rms_mm"]) for f in rows.values())
        label = MOTION_LABELS.get(family, family)
        panel.plot(
            *zip(*points, strict=True), color=colour, marker=marker, lw=1.2, ms=5, label=label
        )
        if family == "ours":
            chosen = rows["ours"]
            panel.plot(
                chosen["jerk_ratio"], chosen["error_rms_mm"], "o", ms=11, mfc="none", color=colour
            )
    x, y = ([row[name] for row in floor] for name in ("jerk_ratio", "error_rms_mm"))
    panel.plot(x, y, "k--", lw=1, label="best linear filter, without limits and arm")
    panel.set(
        xscale="log",
        xlabel="jerk, multiple of the truth's",
        ylabel="error, rms [mm]",
        ylim=(0, None),
    )


def _draw_people(panel: Any, rows: dict[str, dict[str, float]]) -> None:
    names = sorted(rows, key=lambda name: rows[name]["chase"])
    ours, chase = ([rows[name][family] for name in names] for family in ("ours", "chase"))
    panel.hlines(range(len(names)), ours, chase, color="0.8", lw=2)
    panel.plot(
        chase,
        range(len(names)),
        "s",
        color=ADAPTED,
        ms=5,
        label="the best One-Euro filter and Ruckig",
    )
    panel.plot(ours, range(len(names)), "o", color=TOOL_COLOUR, ms=6, label="ours")
    panel.set(xscale="log", xlabel="error, rms [mm]")
    panel.set_yticks(range(len(names)), names)
    panel.set_xticks(TICKS_MM, [f"{tick:g}" for tick in TICKS_MM])
    panel.set_xticks([], minor=True)
    panel.set_xlim(0.8 * min(ours), 1.2 * max(chase))


def _record(results: Results, hands: Moving, seen: Followed) -> None:
    """One sequence in Rerun: truth, raw samples and estimate of each hand, target, setpoint and
    tool.
    """
    stream = results.recording()
    assert seen.estimate is not None
    times = np.arange(len(hands.truth)) * PERIOD_S
    ticks = np.minimum(np.round(hands.stamps / PERIOD_S).astype(int), len(times) - 1)

    def points(path: str, when: Any, positions: Any, colour: str, radius: float) -> None:
        stream.log(path, rr.Points3D.from_fields(colors=[rgb(colour)], radii=[radius]), static=True)
        index = [rr.TimeColumn("time", duration=when)]
        stream.send_columns(path, index, rr.Points3D.columns(positions=positions))

    for side, (name, colour) in enumerate((("left", LEFT_COLOUR), ("right", RIGHT_COLOUR))):
        part = slice(3 * side, 3 * side + 3)
        points(f"/{name}/truth", times, hands.truth[:, part], REFERENCE, 0.006)
        points(f"/{name}/raw", times[ticks], hands.samples[:, part], OTHER, 0.004)
        points(f"/{name}/estimate", times, seen.estimate[:, side], colour, 0.008)
    for name, path, colour in (
        ("target", seen.target, ADAPTED),
        ("setpoint", seen.setpoint, REFERENCE),
        ("tool", seen.tool, TOOL_COLOUR),
    ):
        assert path is not None
        points(f"/{name}", times, path, colour, 0.008)
        stream.log(
            f"/{name}/way",
            rr.LineStrips3D([path], colors=[rgb(colour)], radii=[0.0007]),
            static=True,
        )
    stream.disconnect()
