"""Left-out takes: the hands as the service's core estimates them, its predictions of the tool, and
their judgement.

Hands pass sample by sample through the core's stages `intake` and `skill`, each take from a fresh
state, alone or in a session: the same take again and again, with the hands' return and a rest
before each further round. Targets are clamped only if a reach is given, as most recordings lie
outside the arm's reach.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import NamedTuple

import msgspec
import numpy as np

from thirdhand.contract.explain import in_words
from thirdhand.contract.records import SIDES
from thirdhand.contract.requests import Hands, ViaPoint
from thirdhand.core.codes import HANDS_KNOWN
from thirdhand.core.controller import start_state
from thirdhand.core.frame import Event, blank, frame_layout
from thirdhand.core.intake.stage import Intake
from thirdhand.core.skill.skill import Skill
from thirdhand.core.skill.stage import SkillStage
from thirdhand.core.skill.tuning import UNSURE_M
from thirdhand.recordings.shipped import shipped_skill
from thirdhand.settings.config import Reach, Settings
from thirdhand.skills.demonstration import Demonstration
from thirdhand_sim.closed_loop import START_NS, hand_event
from thirdhand_sim.lab.results import Array, ExperimentError
from thirdhand_sim.lab.rivals.method import Observed, Predicted

CORE_HZ = 125
JUDGED_HZ = 25
LONGEST_SHIFT_S = 1.0
PROBABILITIES = np.logspace(-4.0, 0.0, 60)
SESSION_RESTS_S = (0.5, 1.0, 3.0, 6.0)  # rests before the further rounds of a session
BACK_S = 2.0  # duration of the hands' return to the begin of the take
UNBOUNDED_M = 1e3  # corners of a workspace that does not clamp
UNBOUNDED_REACH = Reach(inner=1e-6, outer=UNBOUNDED_M, min_x=-UNBOUNDED_M, min_z=-UNBOUNDED_M)
VIA_POINT_STD_M = 0.003  # deviation of a via-point at the begin or end of a take


class LeftOut(NamedTuple):
    """A take: its name, the group with which it is left out, and the hands as estimated by
    intake.
    """

    name: str
    group: str
    demonstration: Demonstration
    times: Array  # (T,) [s], JUDGED_HZ
    hands: Array  # (T, 6) [m]; twice the hand that conducts alone
    velocities: Array  # (T, 6) [m/s]
    tool: Array  # (T, 3) [m] the teacher's tool

    @property
    def seen(self) -> Observed:
        """The hands, without an estimate of their stillness."""
        return Observed(self.times, self.hands, self.velocities, np.zeros((len(self.times), 2)))


class Judged(NamedTuple):
    """The judgement of a take: sums of squared errors [m²], and numbers of samples, for example
    inside the region of each of LEVELS.
    """

    samples: int
    squares: float
    shifted: float  # squared errors with the time shift that minimises them
    shift_s: float  # this shift; above 0, the prediction is ahead of the teacher
    worst_m: float
    inside: tuple[int, ...] | None
    held: int | None
    unsure: int | None
    wrong: int  # samples with a larger error than UNSURE_M
    # number of wrong samples, and of the others, at which the skill held or was unsure
    told: int | None
    falsely_told: int | None
    # numbers (2, B) of right and wrong samples by their probability of an error, at PROBABILITIES
    by_probability: Array | None
    brier: float  # sum of the squared differences of these probabilities from 0 and 1


@cache
def _settings(reach: Reach) -> Settings:
    return msgspec.structs.replace(Settings(), rate_hz=CORE_HZ, reach=reach)


def left_out(name: str, group: str, demonstration: Demonstration) -> LeftOut:
    """A take, passed through intake once."""
    times, moving, _ = _through_core(demonstration)
    stamps = (demonstration.stamps_ns - demonstration.stamps_ns[0]) * 1e-9
    tool = np.stack(
        [np.interp(times, stamps, column) for column in demonstration.tool[:, :3].T], axis=1
    )
    return LeftOut(name, group, demonstration, times, moving[:, 0], moving[:, 1], tool)


def predicted(skill: Skill, take: LeftOut, *, reach: Reach | None = None) -> Predicted:
    """The core's prediction of a take with a skill; if `reach` is given, targets are clamped to it
    and to the skill's workspace.
    """
    return _through_core(take.demonstration, skill, reach)[2]


def predicted_rounds(
    skill: Skill, take: LeftOut, *, reach: Reach | None = None, broken_share: float = 0.0
) -> list[Predicted]:
    """The core's predictions in each round of a session, see `session_of`; the first one equals
    `predicted`.
    """
    hands, begins = session_of(take.demonstration, broken_share)
    prediction = _through_core(hands, skill, reach, begins)[2]
    count = len(take.times)
    assert prediction.covariance is not None
    assert prediction.held is not None
    assert prediction.uncertain is not None
    assert prediction.probability is not None
    parts = [slice(begin, begin + count) for begin in begins]
    return [
        Predicted(
            prediction.mean[part],
            prediction.covariance[part],
            prediction.held[part],
            prediction.uncertain[part],
            prediction.radii,
            prediction.probability[part],
        )
        for part in parts
    ]


def session_of(take: Demonstration, broken_share: float = 0.0) -> tuple[Demonstration, list[int]]:
    """The hands of a session, and the sample at JUDGED_HZ with which each round begins. If
    `broken_share` is not 0, this share of the take is done and broken off before each further
    round.

    During the return, the position is a minimum-jerk polynomial over BACK_S, and the orientation is
    the normalized mean of the ends. The tool is that of the take, and is not used.
    """
    seconds = [take.seconds]
    poses = [np.hstack([take.left, take.right])]
    begins = [0]
    whole_s = seconds[0]
    whole = poses[0]
    for rest_s in SESSION_RESTS_S:
        for share in (broken_share, 1.0):
            if share == 0.0:
                continue
            over_s = seconds[-1][-1]
            begin = math.ceil((seconds[-1][-1] + BACK_S + rest_s) * JUDGED_HZ)
            way_s = np.arange(take.period_s, BACK_S, take.period_s)
            rest_at_s = np.arange(
                over_s + BACK_S, begin / JUDGED_HZ - 0.5 * take.period_s, take.period_s
            )
            done = max(2, round(share * len(whole)))
            seconds += [over_s + way_s, rest_at_s, begin / JUDGED_HZ + whole_s[:done]]
            poses += [
                _way(poses[-1][-1], whole[0], way_s / BACK_S),
                np.tile(whole[0], (len(rest_at_s), 1)),
                whole[:done],
            ]
            if share == 1.0:
                begins.append(begin)
    # one sample more, as rounding may cut off the last one
    seconds.append(seconds[-1][-1:] + 1.0 / JUDGED_HZ)
    poses.append(poses[-1][-1:])
    hands = np.concatenate(poses)
    stamps = np.round(1e9 * (1.0 + np.concatenate(seconds))).astype(np.int64)
    return take._replace(
        stamps_ns=stamps, left=hands[:, :7], right=hands[:, 7:], tool=hands[:, :7]
    ), begins


def _way(first: Array, last: Array, shares: Array) -> Array:
    """Poses (T, 14) of both hands between `first` and `last` (14,), at shares (T,) of the time."""
    moved = (shares**3 * (10.0 - 15.0 * shares + 6.0 * shares**2))[:, None]
    out = first + moved * (last - first)
    for part in (slice(3, 7), slice(10, 14)):
        nearer = math.copysign(1.0, float(first[part] @ last[part])) * last[part]
        turned = first[part] + moved * (nearer - first[part])
        out[:, part] = turned / np.linalg.norm(turned, axis=1, keepdims=True)
    return out


def _through_core(
    demonstration: Demonstration,
    skill: Skill | None = None,
    reach: Reach | None = None,
    begins: Sequence[int] = (0,),
) -> tuple[Array, Array, Predicted]:
    """Times (T,) [s]; positions and velocities (T, 2, 6) of both hands; and a skill's predictions.

    While no hands are known, the last prediction is kept. If a request began the demonstration, so
    does one each round, at the samples `begins`.
    """
    settings = _settings(reach or UNBOUNDED_REACH)
    used = skill or shipped_skill()
    if reach is None:
        used = replace(used, workspace=np.array([[-UNBOUNDED_M] * 3, [UNBOUNDED_M] * 3]))
    intake = Intake(settings)
    stage = SkillStage(settings, used)
    state = start_state(settings, used)
    frame = blank(frame_layout(len(settings.joints.names)))
    alone = None if demonstration.conducts == "both" else SIDES.index(demonstration.conducts)
    received = hand_events(demonstration, range(2) if alone is None else [alone])
    every = CORE_HZ // JUDGED_HZ
    moving = []
    means = []
    covariances = []
    held = []
    unsure = []
    probabilities = []
    for tick, inbox in enumerate(received):
        intake_flags = intake.step(state, frame, 1, inbox)
        if demonstration.begun_s is not None and tick % every == 0 and tick // every in begins:
            stage.begin(state)
        hands = state["hands"]
        if alone is not None:
            intake_flags = HANDS_KNOWN * bool(
                frame["hand_ages"][alone] < frame["stale_ticks"][alone]
            )
            hands = hands[[alone, alone]]
        goes = bool(intake_flags & HANDS_KNOWN)
        if skill is not None and goes:
            prediction = stage.step(state, frame)
            goes = prediction.gate_m <= used.threshold and not prediction.is_ambiguous
        if tick % every == 0:
            moving.append(hands[:, :2].transpose(1, 0, 2).reshape(2, 6))
            means.append(frame["target"].copy())
            covariances.append(frame["covariance"].copy())
            held.append(not goes)
            unsure.append(bool(state["unsure"]))
            probabilities.append(float(frame["error_probability"]))
    times = np.arange(len(moving)) / JUDGED_HZ
    flags = (np.array(held), np.array(unsure))
    return (
        times,
        np.array(moving),
        Predicted(
            np.array(means),
            np.array(covariances),
            *flags,
            used.regions.radii,
            np.array(probabilities),
        ),
    )


def hand_events(demonstration: Demonstration, sides: Sequence[int]) -> list[list[Event]]:
    """The samples of a take's hands at each tick, RATE_HZ."""
    since = demonstration.stamps_ns - demonstration.stamps_ns[0]
    inboxes: list[list[Event]] = [[] for _ in range(int(since[-1] * 1e-9 * CORE_HZ) + 1)]
    for side in sides:
        poses = (demonstration.left, demonstration.right)[side].tolist()
        for ns, (x, y, z, *turn) in zip(since.tolist(), poses, strict=True):
            if (tick := int(np.ceil(ns * 1e-9 * CORE_HZ - 1e-6))) < len(inboxes):
                inboxes[tick].append(hand_event(SIDES[side], (x, y, z), START_NS + ns, tuple(turn)))
    return inboxes


def judged(take: LeftOut, said: Predicted) -> Judged:
    """The judgement of a prediction of a take."""
    count = len(take.tool)
    errors = take.tool - said.mean
    shifted = []
    for shift in range(-round(LONGEST_SHIFT_S * JUDGED_HZ), round(LONGEST_SHIFT_S * JUDGED_HZ) + 1):
        if abs(shift) <= count // 2:
            target_m = take.tool[max(0, shift) : count + min(0, shift)]
            error_m = target_m - said.mean[max(0, -shift) : count - max(0, shift)]
            shifted.append((float(np.mean(np.sum(error_m**2, axis=1))), abs(shift), shift))
    least, _, shift = min(shifted)
    inside = None
    if said.covariance is not None:
        squares = np.einsum(
            "ti,ti->t", errors, np.linalg.solve(said.covariance, errors[:, :, None])[:, :, 0]
        )
        inside = tuple(int((squares <= radius).sum()) for radius in said.radii)
    lengths = np.linalg.norm(errors, axis=1)
    held = said.held
    unsure = said.uncertain
    wrong = lengths > UNSURE_M
    warned = None if held is None or unsure is None else held | unsure
    by_probability = None
    brier = 0.0
    if said.probability is not None:
        bins = np.searchsorted(PROBABILITIES, said.probability)
        by_probability = np.array(
            [np.bincount(bins[rows], minlength=len(PROBABILITIES)) for rows in (~wrong, wrong)]
        )
        brier = float(np.sum((said.probability - wrong) ** 2))
    return Judged(
        count,
        float(np.sum(errors**2)),
        count * least,
        shift / JUDGED_HZ,
        float(lengths.max()),
        inside,
        None if held is None else int(held.sum()),
        None if unsure is None else int(unsure.sum()),
        int(wrong.sum()),
        None if warned is None else int((wrong & warned).sum()),
        None if warned is None else int((~wrong & warned).sum()),
        by_probability,
        brier,
    )


def read(path: Path, *, named: bool = False) -> Demonstration:
    """A recorded take: `.npz` with t (T,) [s], and left, right and tool (T, 3) [m]; a hand with NaN
    only was not seen, and the other one conducts alone. `named`: begin and end of the take are its
    places.

    Raises ExperimentError.
    """
    try:
        with np.load(path, allow_pickle=False) as data:
            times, left, right, tool = (
                np.asarray(data[name], np.float64) for name in ("t", "left", "right", "tool")
            )
    except (KeyError, ValueError, OSError) as error:
        raise ExperimentError(
            f"{path}: not a recording of hands and tool: {in_words(error, named=False)}"
        ) from None
    conducts: Hands = "both"
    if np.isnan(left).all():
        conducts = "right"
        left = right
    elif np.isnan(right).all():
        conducts = "left"
        right = left
    if not all(np.isfinite(part).all() for part in (times, left, right, tool)):
        raise ExperimentError(
            f"{path}: holds numbers that are not finite, beside a hand that was not seen at all"
        )
    rows = [
        {
            "name": name,
            **{
                part: x[i].tolist()
                for part, x in (("left", left), ("right", right), ("tool", tool))
            },
            "std": VIA_POINT_STD_M,
            "radius": 0.03,
        }
        for name, i in (("start", 0), ("end", -1))
    ]
    untold = np.tile([0.0, 0.0, 0.0, 1.0], (len(times), 1))
    of_left, of_right, of_tool = (np.hstack([x, untold]) for x in (left, right, tool))
    return Demonstration(
        np.round(1e9 * (times - times[0] + 1.0)).astype(np.int64),
        of_left,
        of_right,
        of_tool,
        via_points=msgspec.convert(rows, tuple[ViaPoint, ...]) if named else (),
        conducts=conducts,
    )
