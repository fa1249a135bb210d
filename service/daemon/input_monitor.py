"""What comes in of each hand and of the arm, for people: rates, clocks, and what was rejected and
why, in words.

The loop only counts; all else is found out beside it, ten times a second.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterator
from statistics import median

from service.config import Settings
from service.contract.incidents import MALFORMED, SOURCE_NAMES, remedy
from service.contract.messages import BASE, JointState, PoseStamped, WireError, in_order
from service.contract.records import SOURCES, Cause
from service.contract.requests import Source
from service.core.controller import Controller
from service.core.intake.far_away import figures, too_far
from service.core.intake.intake import MAX_JOINT_SPEED, Refused
from service.core.record import Record

WINDOW_S = 1.0  # over which rates and clocks are told
TELL_EVERY_S = 10.0  # counts of what goes on being rejected
LONGEST_NAME = 64  # of a frame
TURN_RAD = 7.0  # no joint is farther from its zero
KEYS = dict(zip(SOURCES, ("hands/left", "hands/right", "joints/state"), strict=True))


class Arrivals:
    """What came in on one channel. The loop writes, other threads read."""

    __slots__ = ("at_ns", "count", "malformed", "newest", "why")

    def __init__(self) -> None:
        self.count = self.malformed = self.at_ns = 0
        self.newest: PoseStamped | JointState | None = None
        self.why = ""

    def take(self, message: PoseStamped | JointState, at_ns: int) -> None:
        """One message, and when it came by the system clock [ns]."""
        self.newest, self.at_ns = message, at_ns
        self.count += 1

    def refuse(self, why: str) -> None:
        """Bytes that are no message."""
        self.why = why
        self.count += 1
        self.malformed += 1


class _History:
    """The last second of one source, and what was told of it."""

    def __init__(self) -> None:
        self.counts: deque[tuple[float, int]] = deque()
        self.clocks: deque[tuple[float, float]] = deque()
        self.seen: dict[str, int] = {}
        self.told: dict[str, int] = {}
        self.words: dict[str, str] = {}  # of the newest rejected, by cause
        self.cause, self.refused_s = "", -math.inf


class InputMonitor:
    """What is told of the sources of one cell; for one thread."""

    def __init__(self, settings: Settings) -> None:
        self._settings = settings
        measured = settings.arm.source == "state"
        self.arrivals = {KEYS[source]: Arrivals() for source in SOURCES if measured or source != "arm"}
        self._histories = {source: _History() for source in SOURCES if KEYS[source] in self.arrivals}
        self._told_at = 0.0

    def survey(self, controller: Controller, state: Record, now_s: float) -> dict[str, Source]:
        """Each source at this moment, by the state of this controller."""
        return {source: self._source(source, controller, state, now_s) for source in self._histories}

    def _source(self, source: str, controller: Controller, state: Record, now_s: float) -> Source:
        history, arrivals, index = self._histories[source], self.arrivals[KEYS[source]], SOURCES.index(source)
        if history.counts and history.counts[-1][1] != arrivals.count and arrivals.newest is not None:
            history.clocks.append((now_s, (arrivals.at_ns - arrivals.newest.stamp_ns) / 1e6))
        history.counts.append((now_s, arrivals.count))
        while history.counts[0][0] < now_s - WINDOW_S - 0.05:
            history.counts.popleft()
        while history.clocks and history.clocks[0][0] < now_s - WINDOW_S:
            history.clocks.popleft()
        (since_s, before), intake = history.counts[0], controller.intake
        rejected = {cause.name.lower(): int(n) for cause, n in zip(Cause, intake.rejected[index], strict=True) if n}
        rejected |= {MALFORMED: arrivals.malformed} if arrivals.malformed else {}
        for cause in (cause for cause, count in rejected.items() if count != history.seen.get(cause)):
            refused = intake.refused.get((source, Cause[cause.upper()])) if cause != MALFORMED else None
            history.words[cause] = arrivals.why if refused is None else in_words(refused, self._settings)
            history.cause, history.refused_s = cause, now_s
        history.seen, lately = rejected, now_s - history.refused_s <= WINDOW_S
        seen = int(state["arm_tick"] if source == "arm" else state["hand_ticks"][index])
        settings = self._settings
        age_ms = None if seen < 0 else round((int(state["tick"]) - seen) * settings.period_s * 1e3, 1)
        silent_ms = settings.arm.silent_ms if source == "arm" else settings.hands.stale_ms
        return Source(
            rate_hz=round((arrivals.count - before) / (now_s - since_s), 1) if now_s > since_s else 0.0,
            age_ms=age_ms,
            fresh=age_ms is not None and age_ms < silent_ms,
            clock_ms=round(median(ms for _, ms in history.clocks), 1) if history.clocks else None,
            frame="" if arrivals.newest is None else arrivals.newest.frame_id[:LONGEST_NAME],
            rejected=rejected,
            cause=history.cause if lately else "",
            refused=history.words.get(history.cause, "") if lately else "",
            contested=round(float(state["contested"][index]), 3),
            scatter_mm=None if source == "arm" or seen < 0 else round(1e3 * float(state["noise"][index, 0]) ** 0.5, 2),
        )

    def news(self, sources: dict[str, Source], now_s: float) -> Iterator[str]:
        """Lines for the log: the first rejection of each kind at once, then counts."""
        counts = now_s - self._told_at >= TELL_EVERY_S
        for source, now in sources.items():
            told, words, name = self._histories[source].told, self._histories[source].words, SOURCE_NAMES[source]
            for cause in now.rejected.keys() - told.keys():
                told[cause] = now.rejected[cause]
                yield f"{name}: rejected as {cause}: {words[cause]}. What to do: {remedy(cause)}"
            more = {cause: n - told[cause] for cause, n in now.rejected.items() if n > told[cause]}
            if counts and more:
                told |= now.rejected
                which = ", ".join(f"{n} {cause} ({now.rejected[cause]} in all)" for cause, n in more.items())
                yield f"{name}: rejected in the last {now_s - self._told_at:.0f} s: {which}"
        if counts:
            self._told_at = now_s


def frames(settings: Settings) -> tuple[str, ...]:
    """The frames in which a hand's pose may be; empty: none named, as the tracker's."""
    own = settings.hands.frame
    return (BASE, "") if own in ("", BASE) else (BASE, own, "")


def in_words(refused: Refused, settings: Settings) -> str:
    """What was wrong with a sample that was rejected, and what is accepted."""
    cause, sample, newest_ns = refused
    match cause:
        case Cause.WRONG_FRAME:
            accepted = ", ".join(repr(frame) for frame in frames(settings) if frame)
            return f"frame {sample.frame_id[:LONGEST_NAME]!r}; {accepted} or none accepted"
        case Cause.REPEATED:
            return f"stamp {sample.stamp_ns * 1e-9:.3f} s again; a newer one with each sample needed"
        case Cause.OLDER | Cause.AHEAD:
            apart_s = (sample.stamp_ns - newest_ns) * 1e-9
            return f"stamped {abs(apart_s):.3g} s {'before' if apart_s < 0 else 'after'} the newest accepted one"
    return _of_pose(cause, sample, settings) if isinstance(sample, PoseStamped) else _of_joints(cause, sample, settings)


def _of_pose(cause: Cause, sample: PoseStamped, settings: Settings) -> str:
    at = figures(sample.position)
    match cause:
        case Cause.NOT_A_ROTATION:
            norm = sum(v * v for v in sample.orientation) ** 0.5
            return f"orientation {figures(sample.orientation)} of norm {norm:.3g}; norm 1 needed, x y z w"
        case Cause.NOT_FINITE:
            return f"position {at}, orientation {figures(sample.orientation)}; finite numbers needed"
        case Cause.OUT_OF_RANGE:
            return too_far(sample.position, settings.hands.unit)
        case Cause.SWAPPED:
            return f"at {at} in the tracker's frame, where the other hand was; left and right look exchanged"
    return f"at {at} in the tracker's frame, from one sample to the next"


def _of_joints(cause: Cause, sample: JointState, settings: Settings) -> str:
    joints = settings.joints
    try:
        position, velocity = in_order(sample, joints.names)
    except WireError as error:
        return str(error)
    if cause is Cause.OUT_OF_RANGE:
        for name, at, fast, low, high in zip(joints.names, position, velocity, joints.lower, joints.upper, strict=True):
            if not low <= at <= high:
                like = ", which looks like degrees" if abs(at) > TURN_RAD else ""
                return f"{name} at {at:.4g} rad{like}; {low:g} to {high:g} accepted, or 0.2 rad outside"
            if abs(fast) > MAX_JOINT_SPEED:
                return f"{name} at {fast:.4g} rad/s; up to {MAX_JOINT_SPEED:g} accepted"
    return f"positions {figures(position)}"
