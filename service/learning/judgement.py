"""What is to be said of a skill before it is used: figures from demonstrations that were held out,
and what makes it unsafe.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, NamedTuple

import msgspec
import numpy as np

from service.contract.messages import BASE
from service.core.frame import Vector
from service.core.skill.model import LEVELS, Regions
from service.core.skill.pose import LearnedGripper, LearnedOrientation
from service.core.skill.skill import is_reachable
from service.learning.ambiguity import COMPARED, ambiguity, lengths
from service.learning.choice import NOISE_M, rms
from service.learning.demonstration import Demonstration
from service.learning.gate import Gate
from service.settings.config import Reach

if TYPE_CHECKING:
    from service.learning.regions import Apart
    from service.learning.stages import Delay

SAME_TIME = "same elapsed time"  # the way to predict that heeds no hand
SAME_M = 0.003  # demonstrations nearer to each other, root mean square, are one that was repeated
APART_M = 0.10  # tools so far apart contradict each other where the hands are the same
STANDS_OUT = 2.5  # times the median error of all demonstrations, and
NOTED_MM, UNSAFE_MM = 50.0, 100.0  # errors that are noted, and that are no skill
NOTED, UNSAFE = 1.0, 10.0  # [%] of the samples that contradict others
CAUGHT, CAUGHT_UNSAFE = 95.0, 50.0  # [%] of nonsense
HELD, HELD_UNSAFE = 5.0, 20.0  # [%] of the time that the gate holds what was demonstrated
BEYOND_UNSAFE = 20.0  # [%] of the tool's way that the arm cannot reach
LEAST_DELAY_S = 0.005  # below it a teacher was not late
OTHER_MM = 1.0  # an error at the moment that differs so from the error is told beside it
GATE_REMEDY = "take more demonstrations along the same paths, or name the places of the task (--places)"
COVERAGE = ((30.0, 80.0), (88.0, 100.0))  # [%] beyond these a region is not what it says


class HeldOut(NamedTuple):
    """What the others' primitive predicts of a demonstration: errors (T, 3) [m], tool less mean,
    covariances (T, 3, 3) [m²], and what the gate compares (T,) [m], see `Model.measure`.
    """

    errors: Vector
    covariance: Vector
    gate_m: Vector


class Posed(NamedTuple):
    """What was learned of the tool's turns and of the gripper, and what is to be said of them."""

    orientation: Vector  # (4,) the mean one, quaternion x y z w
    turn: LearnedOrientation | None  # None: it is constant
    gripper: LearnedGripper | None  # None: the demonstrations tell of none
    turn_error_deg: float | None  # root mean square of demonstrations that were held out
    gripper_right: float | None  # [%] of the held-out samples
    warnings: Sequence[str]
    unsafe: Sequence[str]


class Row(msgspec.Struct, frozen=True, kw_only=True):
    """A demonstration, predicted by what was learned from the others; or all of them."""

    name: str
    error_mm: float  # root mean square
    worst_mm: float
    moment_mm: float = 0.0  # root mean square at that moment, its lag left in, by what it had no part in
    predicted_mm: float  # what the covariance says of that, scaled without it
    within_50: float  # [%] of the samples inside the region that should hold 50 %
    within_95: float
    held: float  # [%] of the time that the gate would hold
    other_mm: dict[str, float] = {}  # root mean square error of other ways to predict it


class Figures(msgspec.Struct, frozen=True, kw_only=True):
    """What a skill's file says of the skill. Shares in per cent."""

    demonstrations: tuple[Row, ...]
    all: Row
    gate_mm: float
    held_std: float = 0.0  # of `held`, from demonstration to demonstration
    swapped: float  # of planted nonsense that is held: hands swapped,
    beside: float  # both 30 cm beside,
    one_beside: float  # one of them
    ambiguous: float  # of the samples contradict another: same hands, other tool
    beyond_reach: float  # of the tool's way
    orientation_error_deg: float | None = None  # root mean square, held out; None: none was learned or held out
    gripper_right: float | None = None  # [%] of held-out samples
    warnings: tuple[str, ...] = ()
    unsafe: tuple[str, ...] = ()  # reasons not to use it
    tried_mm: dict[str, float] = {}  # what all that the tool could be a function of missed it by, left out
    taken: str = ""  # which of these
    by_person: bool = False  # whether all of a person's demonstrations were left out at once
    delay_s: float | None = None  # how late the teacher was; None: it was not learned
    delay_std_s: float = 0.0  # of that, from demonstration to demonstration
    alone: bool | msgspec.UnsetType = msgspec.UNSET  # True: one hand conducts alone, and `beside` is of it


def figures(
    demonstrations: Sequence[Demonstration],
    paths: Sequence[tuple[Vector, Vector]],
    names: Sequence[str],
    held_out: Sequence[HeldOut],
    told: Sequence[tuple[Apart, Regions]],
    gate: Gate,
    posed: Posed,
    *,
    beside: Mapping[str, Sequence[Vector]],
    tried: Mapping[str, float],
    taken: str,
    by_person: bool,
    near_m: float,
    delay: Delay | None,
    alone: bool,
    reach: Reach,
    remarks: Sequence[str],
) -> Figures:
    """The figures of a skill: its demonstrations, their hands (T, 6) and tools (T, 3) [m] in phase,
    what was predicted of each, also at the moment with the regions of which the others tell, its
    gate, what it learned besides, and errors (T, 3) [m] of other ways to predict each
    demonstration, `beside` it. `tried` is what all inputs among which this was `taken` missed the
    tool by [m]. `near_m` is as in `ambiguity`, `delay` the teacher's, `alone` whether one hand
    conducts alone.
    """
    rows = tuple(
        _row(name, one, told[i : i + 1], gate.threshold, {way: errors[i] for way, errors in beside.items()})
        for i, (name, one) in enumerate(zip(names, held_out, strict=True))
    )
    total = HeldOut(*(np.concatenate(parts) for parts in zip(*held_out, strict=True)))
    hands, tools = zip(*paths, strict=True)
    ambiguous, contradiction = ambiguity(
        hands,
        tools,
        names,
        lengths,
        apart=APART_M,
        near_m=near_m,
        missed=[np.linalg.norm(one.errors, axis=1) for one in held_out],
        told=lambda apart_m: f"{1000 * apart_m:.0f} mm",
    )
    out = np.array([not is_reachable(at, reach) for _, tool in paths for at in tool[:: max(1, len(tool) // COMPARED)]])
    found = Figures(
        demonstrations=rows,
        all=_row("all", total, told, gate.threshold, {way: np.concatenate(errors) for way, errors in beside.items()}),
        held_std=float(np.std([row.held for row in rows])),
        gate_mm=1000 * gate.threshold,
        swapped=100 * gate.caught.swapped,
        beside=100 * gate.caught.beside,
        one_beside=100 * gate.caught.one_beside,
        ambiguous=100 * ambiguous,
        beyond_reach=100 * float(out.mean()),
        orientation_error_deg=posed.turn_error_deg,
        gripper_right=posed.gripper_right,
        tried_mm={name: 1000 * error for name, error in tried.items()},
        taken=taken if tried else "",
        by_person=by_person,
        delay_s=delay.mean_s if delay else None,
        delay_std_s=delay.std_s if delay else 0.0,
        alone=True if alone else msgspec.UNSET,
    )
    warnings, unsafe = _verdicts(found, demonstrations, contradiction, gate=gate)
    return msgspec.structs.replace(
        found, warnings=(*remarks, *warnings, *posed.warnings), unsafe=(*unsafe, *posed.unsafe)
    )


def repeated(pairs: Sequence[tuple[Vector, Vector]]) -> dict[int, int]:
    """The demonstrations that repeat an earlier one, at as many or other stamps, and which."""
    paths = []
    for hands, tool in pairs:
        both, at = np.hstack([hands, tool[:, :3]]), np.linspace(0.0, 1.0, COMPARED)
        paths.append(np.stack([np.interp(at, np.linspace(0.0, 1.0, len(both)), column) for column in both.T], axis=1))
    out: dict[int, int] = {}
    for i, path in enumerate(paths):
        for j in range(i):
            if j not in out and rms(path - paths[j]) < SAME_M:
                out[i] = j
                break
    return out


def _row(
    name: str,
    one: HeldOut,
    told: Sequence[tuple[Apart, Regions]],
    threshold: float,
    beside: Mapping[str, Vector],
) -> Row:
    inside = 100 * np.mean([apart.inside(regions) for apart, regions in told], axis=0)
    lengths = np.linalg.norm(one.errors, axis=1)
    return Row(
        name=name,
        error_mm=1000 * rms(one.errors),
        worst_mm=1000 * float(lengths.max()),
        moment_mm=1000 * rms(np.concatenate([apart.errors for apart, _ in told])),
        predicted_mm=1000 * rms(np.concatenate([apart.deviations(regions) for apart, regions in told])[:, None]),
        within_50=float(inside[LEVELS.index(0.5)]),
        within_95=float(inside[LEVELS.index(0.95)]),
        held=100 * float((one.gate_m > threshold).mean()),
        other_mm={way: 1000 * rms(errors) for way, errors in beside.items()},
    )


def _verdicts(
    found: Figures, demonstrations: Sequence[Demonstration], contradiction: str, *, gate: Gate
) -> tuple[list[str], list[str]]:
    warnings: list[str] = []
    unsafe: list[str] = []

    def say(text: str, *, bad: bool = False) -> None:
        (unsafe if bad else warnings).append(text)

    overall = found.all
    frames = sorted({one.frame for one in demonstrations})
    if len(frames) > 1:
        say(f"the demonstrations are in different frames: {', '.join(map(repr, frames))}; one needed", bad=True)
    elif frames[0] not in ("", BASE):
        say(f"the demonstrations are in frame {frames[0]!r}: it is taken to be {BASE!r}, the arm's base plate")
    if len(found.demonstrations) < 3:
        say(f"{len(found.demonstrations)} demonstration(s) tell little of how sure the skill may be; 5 advised")
    if gate.floored or overall.error_mm < 1000 * NOISE_M:
        say(
            "the demonstrations are more exact than any tracker: were they made, not taken? The gate allows for a "
            f"tracker's noise, and is {found.gate_mm:.1f} mm"
        )
    if overall.error_mm > NOTED_MM:
        say(
            f"held-out demonstrations are missed by {overall.error_mm:.0f} mm: where the hands are tells little of "
            f"where the tool is; up to {UNSAFE_MM:.0f} mm accepted",
            bad=overall.error_mm > UNSAFE_MM,
        )
    for way, error_mm in overall.other_mm.items():
        if round(error_mm) >= round(overall.error_mm):
            continue
        if way == SAME_TIME and error_mm <= min([*overall.other_mm.values(), *found.tried_mm.values()]):
            say(
                f"the task is a timetable: where the tool was after as much time misses it by {error_mm:.0f} mm, by "
                f"the hands it is missed by {overall.error_mm:.0f}"
            )
        else:
            say(f"{way}, held-out demonstrations are missed by less: {error_mm:.0f} mm, not {overall.error_mm:.0f}")
    usual = float(np.median([row.error_mm for row in found.demonstrations]))
    for row in found.demonstrations:
        if len(found.demonstrations) > 2 and row.error_mm > max(STANDS_OUT * usual, NOTED_MM / 2):
            say(f"{row.name} is unlike the others: missed by {row.error_mm:.0f} mm, they by {usual:.0f}")
    if found.ambiguous > NOTED:
        say(
            f"{found.ambiguous:.0f} % of the samples contradict others, up to {UNSAFE:.0f} % accepted: {contradiction}",
            bad=found.ambiguous > UNSAFE,
        )
    if found.beyond_reach > 0:
        say(
            f"{found.beyond_reach:.1f} % of the tool's way is out of the arm's reach, up to {BEYOND_UNSAFE:.0f} % "
            "accepted: is it in metres, in frame base?",
            bad=found.beyond_reach > BEYOND_UNSAFE,
        )
    if overall.held > HELD:
        why = "its ceiling" if gate.capped else "nonsense beyond it"
        say(
            f"the gate, kept low by {why}, holds {overall.held:.0f} % of what was demonstrated, up to "
            f"{HELD_UNSAFE:.0f} % accepted",
            bad=overall.held > HELD_UNSAFE,
        )
    kinds = (("hands swapped", found.swapped), ("hands 30 cm beside", found.beside))
    for what, share in (("the hand 30 cm beside", found.beside),) if found.alone is True else kinds:
        if share < CAUGHT:
            bad = share < CAUGHT_UNSAFE
            wanted = f"at least {CAUGHT_UNSAFE:.0f} % needed" if bad else f"{CAUGHT:.0f} % wanted"
            say(f"the gate holds {share:.1f} % of {what}, {wanted}{f': {GATE_REMEDY}' if bad else ''}", bad=bad)
    for nominal, share, (low, high) in zip((50, 95), (overall.within_50, overall.within_95), COVERAGE, strict=True):
        if not low <= share <= high:
            say(f"the {nominal} % regions hold {share:.0f} % of held-out samples")
    return warnings, unsafe


def _caught(found: Figures) -> str:
    """In words, the shares of planted nonsense that the gate holds."""
    if found.alone is True:
        return f"{found.beside:.0f} % of the hand 30 cm beside"
    return (
        f"{found.swapped:.0f} % of hands swapped, {found.beside:.0f} % of both 30 cm beside, {found.one_beside:.0f} % "
        "of one hand 30 cm beside"
    )


def table(found: Figures) -> str:
    """The figures as a short table for a terminal."""
    which = "held out" if len(found.demonstrations) > 1 else "learned from"
    which += " by person" if found.by_person else ""
    width = max(len(text) for text in (which, *(row.name for row in (*found.demonstrations, found.all))))
    ways = "".join(f"   {way}" for way in found.all.other_mm)
    rows = (*found.demonstrations, found.all)
    is_other = any(abs(row.moment_mm - row.error_mm) >= OTHER_MM for row in rows)
    moment = "  at the moment" if is_other else ""
    lines = [f"{which:<{width}}   error   worst{moment}   expected   in 50 %  in 95 %   held{ways}"]
    for row in rows:
        moment = f"        {row.moment_mm:4.0f} mm" if is_other else ""
        lines.append(
            f"{row.name:<{width}}  {row.error_mm:4.0f} mm {row.worst_mm:4.0f} mm{moment}"
            f"    {row.predicted_mm:4.0f} mm   {row.within_50:5.0f} %  {row.within_95:5.0f} %  {row.held:4.1f} %"
            + "".join(f"   {f'{mm:.0f} mm':>{len(way)}}" for way, mm in row.other_mm.items())
        )
    helds = [row.held for row in found.demonstrations]
    lines += [
        "",
        "Each row is a demonstration that was left out and predicted from the others. The columns:"
        if len(found.demonstrations) > 1
        else "The row is the demonstration that was learned from, as none could be left out. The columns:",
        "  error, worst   distance of the predicted tool from the demonstrated one: root mean square, and largest",
        *["  at the moment  that error without any allowance for a tool that is early or late"] * is_other,
        "  expected       root mean square error that the skill expects, by its covariance as calibrated",
        "  in 50 %, 95 %  share of the samples in the regions that should hold 50 % and 95 % of them",
        "  held           share of the time in which the arm would hold, as the hands are beyond the gate",
        *[f"  {', '.join(found.all.other_mm)}: errors of simpler predictions"] * bool(found.all.other_mm),
        "docs/learning.md, section Judged, explains each of them.",
        "",
        f"the gate would hold the arm for {found.all.held:.1f} % of the time, {min(helds):.1f} to {max(helds):.1f} % "
        f"of a demonstration, standard deviation {found.held_std:.1f} %",
        f"the gate, at {found.gate_mm:.0f} mm, would hold it in wrong samples: {_caught(found)}",
        f"{found.ambiguous:.1f} % of the samples contradict others: the same hands, another tool; "
        f"{found.beyond_reach:.1f} % of the tool's path is out of the arm's reach",
    ]
    if found.orientation_error_deg is not None:
        lines.append(f"the tool's orientation is missed by {found.orientation_error_deg:.1f}° rms")
    if found.gripper_right is not None:
        lines.append(f"the gripper is right in {found.gripper_right:.0f} % of the samples")
    if found.delay_s is not None:
        late = f"{found.delay_s:.2f} s" if found.delay_s >= LEAST_DELAY_S else "not"
        then = ": the tool is as late; [skill] lead_s takes it back" if found.delay_s >= LEAST_DELAY_S else ""
        lines.append(
            f"the teacher was {late} late (standard deviation {found.delay_std_s:.2f} s over demonstrations){then}"
        )
    if found.tried_mm:
        wide = max(map(len, found.tried_mm))
        lines.append(f"what the tool may be a function of, and its error when left out; {found.taken} is taken:")
        lines += (f"  {name:<{wide}}  {mm:4.0f} mm" for name, mm in found.tried_mm.items())
    lines += (f"warning: {text}" for text in found.warnings)
    return "\n".join([*lines, *(f"unsafe: {text}" for text in found.unsafe)])
