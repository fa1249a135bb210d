"""A recording's hands with other settings: figures of each variant, and the best trade-off.

All variants are judged at the same ticks: those at which the arm follows with the recording's own
settings, has engaged, and the true hands are known. A variant that holds there errs by what the
hands move on.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple, TypeAlias

import msgspec
import numpy as np
from numpy.typing import NDArray

from thirdhand.contract.explain import InvalidError, validated
from thirdhand.contract.incidents import word
from thirdhand.contract.records import (
    Cause,
    Flag,
    Mode,
    Reason,
)
from thirdhand.core.frame import Records, Vector
from thirdhand.recordings.mcap_file import RecordingError
from thirdhand.settings.config import Settings
from thirdhand.workbench.report.report import Figure
from thirdhand.workbench.report.tracking import TrackingFigures, tracking
from thirdhand.workbench.report.true_hands import TrueHand, true_hands, with_true_hands
from thirdhand.workbench.takes.recorded_hands import RecordedHands
from thirdhand.workbench.takes.track_check import in_base_frame

Change: TypeAlias = Mapping[str, Mapping[str, Any]]  # values by table and setting

# What a user can set and belongs together, a row each.
CHANGES: tuple[Change, ...] = (
    {"tool": {"follow": "closely"}},
    {"tool": {"follow": "default"}},
    {"tool": {"follow": "calmly"}},
    {"tool": {"max_jerk": 200.0}},
    {"tool": {"max_jerk": 100.0}},
    {"tool": {"max_jerk": 50.0}},
    {"tool": {"follow": "closely", "max_jerk": 150.0}},
    {"tool": {"max_speed": 0.5}},  # its acceleration and jerk follow from it
    {"tool": {"max_speed": 0.3}},
    {"hands": {"stale_ms": 200.0, "unseen_ms": 1000.0}},
)
TOTALS = ("held_s", "limits_s", "rejected")  # of VariantFigures
LIMITS_OF_MOTION = ("max_speed", "max_acceleration", "max_jerk")  # a proposal never raises these
LEAST_JUDGED_S = 2.0
SAME_SHARE = 0.05  # a smaller change of error or jerk is not worth a setting
MORE_JERK, LESS_JERK = 1.1, 0.8  # a proposal has at most the first share of the jerk, or the second for the same error
MORE_OVERSHOOT_MM = 1.0
MORE_HELD_S = 0.1


class VariantFigures(NamedTuple):
    """Figures of a variant: how the tool follows, time in holds and faults by reason [s], time with
    each limit active [s], and rejected samples by cause.
    """

    name: str
    change: Change
    tracking: TrackingFigures
    held_s: Mapping[str, float]
    limits_s: Mapping[str, float]
    rejected: Mapping[str, int]

    @property
    def not_following_s(self) -> float:
        """Time in holds and faults [s]."""
        return sum(self.held_s.values())

    def figures(self) -> Iterator[Figure]:
        """The figures for a comparison of variants."""
        yield Figure("error, median of the seconds in motion", self.tracking.error_mm, "mm", 1)
        yield Figure("error, 95 %", self.tracking.error_p95_mm, "mm", 1)
        yield Figure("lag", _known(self.tracking.lag_ms), "ms", 0)
        yield Figure("jerk of the tool", self.tracking.jerk, "m/s³", 1)
        yield Figure("overshoot, largest", _known(self.tracking.overshoot_mm), "mm", 1)
        for mode in (Mode.HOLD, Mode.FAULT):
            for reason in Reason:
                name = f"{word(mode)}: {word(reason)}"
                yield Figure(name, self.held_s.get(name, 0.0), "s", 2)
        for flag in Flag:
            yield Figure(word(flag), self.limits_s.get(word(flag), 0.0), "s", 2)
        for cause in Cause:
            yield Figure(f"rejected: {word(cause)}", self.rejected.get(word(cause), 0), "", 0)


class JudgedHands(NamedTuple):
    """The judged ticks (T,) of a recording's hands, the target (T, 3) [m] of its skill for the true
    hands, their truth by side, and the frames (T,) with the recording's own settings.
    """

    hands: RecordedHands
    truth: Mapping[str, TrueHand]
    target: Vector
    judged: NDArray[np.bool_]
    frames: Records

    @classmethod
    def of(cls, hands: RecordedHands) -> JudgedHands:
        """Raises RecordingError if the arm does not follow long enough to judge anything."""
        truth = true_hands(hands.ticks, hands.settings, origin=str(hands.path))
        frames = hands.frames(hands.settings)
        ideal = hands.frames(in_base_frame(hands.settings), with_true_hands(hands.ticks, truth, hands.period_s))
        times = frames["tick"] * hands.period_s
        known = np.all([np.isfinite(hand.at(times)[:, 0]) for hand in truth.values()], axis=0)
        predicted = ideal["covariance"].any(axis=(1, 2))
        judged = known & predicted & (frames["mode"] == Mode.FOLLOW) & (frames["flags"] & Flag.ENGAGING == 0)
        if judged.sum() * hands.period_s < LEAST_JUDGED_S:
            reasons = held_s(frames, hands.period_s)
            held = ", ".join(f"{name} {lasts_s:.1f} s" for name, lasts_s in reasons.items()) or "it engages"
            raise RecordingError(
                f"{hands.path}: the arm follows for {judged.sum() * hands.period_s:.1f} s with the skill "
                f"{hands.skill.name} and known hands; {LEAST_JUDGED_S:g} s needed. Otherwise: {held}"
            )
        return cls(hands, truth, ideal["target"], judged, frames)

    @property
    def judged_s(self) -> float:
        """The judged time [s]."""
        return float(self.judged.sum()) * self.hands.period_s

    def figures(self, name: str, change: Change, frames: Records) -> VariantFigures:
        """The figures of a variant with these frames (T,)."""
        rejected = frames["rejected"][-1].astype(int) - self.hands.state["rejected"].astype(int)
        return VariantFigures(
            name,
            change,
            tracking(self.target, frames["tool"], self.hands.period_s, self.judged),
            held_s=held_s(frames, self.hands.period_s),
            limits_s={
                word(flag): count * self.hands.period_s
                for flag in Flag
                if (count := int((frames["flags"] & flag > 0).sum()))
            },
            rejected={word(cause): int(rejected[cause]) for cause in Cause if rejected[cause] > 0},
        )


def held_s(frames: Records, period_s: float) -> dict[str, float]:
    """Time [s] in each hold and fault, by its reason in words."""
    found: dict[str, float] = {}
    for mode in (Mode.HOLD, Mode.FAULT):
        for reason in Reason:
            count = int(((frames["mode"] == mode) & (frames["reason"] == reason)).sum())
            if count:
                found[f"{word(mode)}: {word(reason)}"] = count * period_s
    return found


def changed(settings: Settings, change: Change) -> Settings | None:
    """The settings with a change; None if it changes nothing, or is not valid in this cell."""
    given = msgspec.to_builtins(settings)
    for table, values in change.items():
        given[table] = given[table] | values
    try:
        found = validated(given, Settings)
    except InvalidError:
        return None
    return None if found == settings else found


def written_change(change: Change) -> str:
    """A change in one line."""
    return ", ".join(
        f"{name} = {value:g}" if isinstance(value, float) else f"{name} = {value}"
        for values in change.values()
        for name, value in values.items()
    )


def toml(change: Change) -> str:
    """The lines to write into a cell's settings for a change."""
    lines = []
    for table, values in change.items():
        lines += [f"[{table}]", *(f"{name} = {value!r}" for name, value in values.items())]
    return "\n".join(lines).replace("'", '"')


def tried(
    judged_hands: JudgedHands,
    changes: Sequence[Change],
    *,
    progress: Callable[[int], None] = lambda count: None,
) -> list[VariantFigures]:
    """The figures with the recording's own settings, and of every change that is one for its
    cell.
    """
    found = [judged_hands.figures("as recorded", {}, judged_hands.frames)]
    for i, change in enumerate(changes):
        settings = changed(judged_hands.hands.settings, change)
        if settings is not None:
            found.append(judged_hands.figures(written_change(change), change, judged_hands.hands.frames(settings)))
        progress(i + 1)
    return found


def pooled(files: Sequence[tuple[float, list[VariantFigures]]]) -> list[VariantFigures]:
    """The figures over several files, each given with its judged time [s], of the variants that all
    of them have: means weighted by these times, the largest overshoot, sums of times and counts.
    """
    if len(files) == 1:
        return files[0][1]
    found = []
    for first in files[0][1]:
        same = [(weight, one) for weight, variants in files for one in variants if one.name == first.name]
        if len(same) < len(files):
            continue
        tracking = TrackingFigures(*(_mean(same, name) for name in TrackingFigures._fields))._replace(
            overshoot_mm=max((one.tracking.overshoot_mm for _, one in same if one.tracking.stops), default=math.nan),
            stops=sum(one.tracking.stops for _, one in same),
        )
        totals = [sum((Counter(getattr(one, name)) for _, one in same), Counter()) for name in TOTALS]
        found.append(VariantFigures(first.name, first.change, tracking, *totals))
    return found


def _mean(weighted: list[tuple[float, VariantFigures]], name: str) -> Any:
    """The weighted mean of the known values of a tracking figure; NaN without any."""
    known = [(weight, v) for weight, one in weighted if not math.isnan(v := getattr(one.tracking, name))]
    return sum(weight * v for weight, v in known) / sum(weight for weight, _ in known) if known else math.nan


def best(variants: list[VariantFigures], *settings: Settings) -> tuple[VariantFigures, str]:
    """The variant with the best trade-off beside the settings that are in force, which stand first,
    and the reason. Files may have several settings.

    First choice: the least error of those without more jerk, overshoot and holding. Second choice:
    the least jerk of those without more error, overshoot and holding. No limit of motion is raised.
    """
    own = variants[0]
    fair = [one for one in variants[1:] if all(_is_fair(one, own, each) for each in settings)]
    closer = min(fair, key=lambda one: one.tracking.error_mm, default=own)
    if closer.tracking.error_mm < (1.0 - SAME_SHARE) * own.tracking.error_mm:
        return closer, (
            f"the error is {closer.tracking.error_mm:.1f} instead of {own.tracking.error_mm:.1f} mm, the jerk "
            f"{closer.tracking.jerk:.1f} instead of {own.tracking.jerk:.1f} m/s³, the overshoot{_passed(closer, own)}"
        )
    same = [one for one in fair if one.tracking.error_mm < (1.0 + SAME_SHARE) * own.tracking.error_mm]
    calmer = min(same, key=lambda one: one.tracking.jerk, default=own)
    if calmer.tracking.jerk < LESS_JERK * own.tracking.jerk:
        return calmer, (
            f"the jerk is {calmer.tracking.jerk:.1f} instead of {own.tracking.jerk:.1f} m/s³ for the same error, "
            f"the overshoot{_passed(calmer, own)}"
        )
    return own, (
        f"no variant errs less by {100 * SAME_SHARE:g} % without more than {MORE_JERK:g} times the jerk, "
        f"{MORE_OVERSHOOT_MM:g} mm more overshoot or longer holds, and none has less than {LESS_JERK:g} times the jerk "
        "for the same error"
    )


def _is_fair(one: VariantFigures, own: VariantFigures, settings: Settings) -> bool:
    limits = one.change.get("tool", {})
    raised = any(limits.get(name, 0.0) > getattr(settings.tool, name) for name in LIMITS_OF_MOTION)
    more_mm = one.tracking.overshoot_mm - own.tracking.overshoot_mm
    return (
        not raised
        and one.tracking.jerk <= MORE_JERK * own.tracking.jerk
        and not more_mm > MORE_OVERSHOOT_MM  # NaN: there are no stops
        and one.not_following_s <= own.not_following_s + MORE_HELD_S
    )


def _known(value: float) -> float | None:
    return None if math.isnan(value) else value


def _passed(one: VariantFigures, own: VariantFigures) -> str:
    if math.isnan(own.tracking.overshoot_mm):
        return " unknown without stops"
    return f" {one.tracking.overshoot_mm:.1f} instead of {own.tracking.overshoot_mm:.1f} mm"
