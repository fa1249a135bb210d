"""Causes of holds and faults of the arm, as the status reported them, and preceding incidents."""

from __future__ import annotations

import bisect
import itertools
from collections.abc import Iterator

import numpy as np

from thirdhand.contract.evidence import Evidence, Explanation, explained
from thirdhand.contract.incidents import ORDERS, input_name, word
from thirdhand.contract.records import SIDES, Cause, Flag, Mode, Reason
from thirdhand.contract.requests import Source
from thirdhand.core.tuning import TUNING
from thirdhand.workbench.report.columns import Columns

BEFORE_S = 1.0  # incidents within this time before a fault are listed
LISTED_LATE_US = 1000.0  # a tick that began later than this is listed


def why(columns: Columns, begin: int, end: int) -> Explanation:
    """The reason of frames [begin, end) in words, and the remedy: from the first status among them,
    or, if none was recorded, from the first frame.
    """
    frame = columns.frames[begin]
    last = int(columns.frames["tick"][end - 1])
    named = word(Mode(int(frame["mode"]))), word(Reason(int(frame["reason"])))
    explanation = _by_frame(columns, begin)
    first = bisect.bisect_left(columns.statuses, int(frame["tick"]), key=lambda said: said.tick)
    for status in itertools.takewhile(lambda said: said.tick <= last, columns.statuses[first:]):
        if (status.mode, status.reason) == named:
            return Explanation(status.because or explanation.why, status.remedy)
    return explanation


def _by_frame(columns: Columns, row: int) -> Explanation:
    frame = columns.frames[row]
    tick = int(frame["tick"])
    settings = columns.recording.settings
    ages_ms = [
        None if age < 0 else age * columns.period_s * 1e3 for age in frame["hand_ages"].tolist()
    ]
    stale_ms = (columns.stale_ticks[row] * columns.period_s * 1e3).tolist()
    sources = {
        side: Source(age_ms=age_ms, fresh=age_ms is not None and age_ms < limit_ms)
        for side, age_ms, limit_ms in zip(SIDES, ages_ms, stale_ms, strict=True)
    }
    skill = next((change.skill for change in reversed(columns.skills) if change.tick <= tick), None)
    ends_m = 0.0 if skill is None else TUNING.intake.end_share * skill.threshold
    evidence = Evidence(
        sources=sources,
        settings=settings,
        gate_m=None if skill is None else (float(frame["gate_m"]), ends_m),
        measure="" if skill is None else skill.model.measure,
        failure=next(
            (
                order.text
                for order in reversed(columns.orders)
                if order.kind == "fault" and order.tick <= tick
            ),
            "",
        ),
    )
    return explained(Reason(int(frame["reason"])), evidence)


def before(columns: Columns, begin: int) -> Iterator[str]:
    """Sentences on the incidents before frame `begin`."""
    if begin == 0:
        yield "the fault is older than the recording"
        return
    yield _was_doing(columns, begin)
    frames = columns.frames
    tick = int(columns.frames["tick"][begin])
    first = max(0, begin - round(BEFORE_S / columns.period_s))
    more = frames["rejected"][begin].astype(np.int64) - frames["rejected"][first]
    if rejected := ", ".join(f"{more[cause]} {word(cause)}" for cause in Cause if more[cause] > 0):
        yield f"rejected in the second before: {rejected}"
    for name, cause, refused in _refused(columns, int(frames["tick"][first]), tick):
        yield f"{input_name(name)}: rejected as {cause}: {refused}"
    yield from _late(columns, int(frames["tick"][first]), tick)
    for order in columns.orders:
        ago_s = (tick - order.tick) * columns.period_s
        if order.kind != "fault" and 0.0 <= ago_s <= BEFORE_S:
            yield f"{f'{ago_s:.2f} s before: ' if ago_s > 0.005 else ''}{ORDERS[order.kind]}"


def _late(columns: Columns, first: int, last: int) -> Iterator[str]:
    """A sentence on ticks between two that were missed, or late by LATE_US or more."""
    timing = columns.timing
    timing = timing[(timing["tick"] >= first) & (timing["tick"] <= last)]
    if not len(timing):
        return
    missed = int(timing["missed"][-1] - timing["missed"][0])
    late_us = float(timing["lateness_us"].max())
    if missed or late_us >= LISTED_LATE_US:
        yield (
            f"in the second before: {missed} missed deadlines, ticks up to {late_us / 1e3:.1f} "
            "ms late"
        )


def _refused(columns: Columns, first: int, last: int) -> list[tuple[str, str, str]]:
    """Source, cause and description of the rejected samples in the statuses between two ticks, the
    newest of each source and cause.
    """
    statuses = [status for status in columns.statuses if first <= status.tick <= last]
    newest: dict[tuple[str, str], str] = {}
    for status in statuses:
        for name, source in (status.sources | status.streams).items():
            if source.refused:
                newest[name, source.cause] = source.refused
    return [(*of, refused) for of, refused in newest.items()]


def _was_doing(columns: Columns, begin: int) -> str:
    frames = columns.frames
    last = frames[begin - 1]
    mode = Mode(int(last["mode"]))
    reason = Reason(int(last["reason"]))
    differs = (frames["mode"][:begin] != mode) | (frames["reason"][:begin] != reason)
    since = begin - 1 - int(np.argmax(differs[::-1])) if differs.any() else 0
    lasts_s = (int(frames["tick"][begin]) - int(frames["tick"][since])) * columns.period_s
    doing = "it followed" if mode is Mode.FOLLOW else f"it held ({word(reason)})"
    flags = ", ".join(map(word, Flag(int(last["flags"]))))
    near = float(last["hand_distance"])
    distance = (
        f", the nearest hand {100 * near:.0f} cm from the arm"
        if (last["hand_ages"] >= 0).any()
        else ""
    )
    return f"before it: {doing} for {lasts_s:.2f} s{f' with {flags}' if flags else ''}{distance}"
