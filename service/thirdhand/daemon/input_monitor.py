"""The input of each hand, of the arm and of all other streams: rates, clocks, and rejected samples
with their causes.

The loop only counts samples. Everything else is computed beside it, ten times a second.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterator, Sequence
from statistics import median
from typing import Any

import msgspec
import numpy as np

from thirdhand.contract.evidence import (
    LONGEST_NAME,
    Evidence,
    Explanation,
    Jump,
    Outside,
    explained,
    refused_wish,
)
from thirdhand.contract.incidents import (
    FROZEN,
    MALFORMED,
    OTHER_PUBLISHER,
    Condition,
    in_full,
    input_name,
    word,
)
from thirdhand.contract.joint_states import measured
from thirdhand.contract.messages import (
    JointState,
    PoseStamped,
    PoseWithCovarianceStamped,
    WireError,
)
from thirdhand.contract.records import SOURCES, Cause
from thirdhand.contract.requests import Source
from thirdhand.core.codes import TRUSTED
from thirdhand.core.controller import Controller
from thirdhand.core.frame import Record
from thirdhand.core.intake import KEPT
from thirdhand.core.intake.stage import Intake, Refused
from thirdhand.core.tuning import TUNING
from thirdhand.core.wish.stage import wish_frames
from thirdhand.core.wish.step import newest_due
from thirdhand.daemon.cell_streams import Arrivals, heard
from thirdhand.daemon.far_away import too_far, unit_meant
from thirdhand.daemon.side_streams import side_keys
from thirdhand.settings.config import JointSettings, Settings

RATE_WINDOW_S = 1.0  # rates and clocks are taken over this time
COUNTS_EVERY_S = 10.0  # interval of the log lines that count further rejections
KEY_OF_SOURCE = dict(
    zip(SOURCES, ("hands/left", "hands/right", "joints/state", "tool/wish"), strict=True)
)


class _History:
    """The last second of one source, and the rejections that were logged."""

    def __init__(self) -> None:
        self.counts: deque[tuple[float, int]] = deque()
        self.clocks: deque[tuple[float, float]] = deque()
        self.counted: dict[str, int] = {}  # rejected messages at the last update, by cause
        self.logged: dict[str, int] = {}
        self.found: dict[str, Explanation] = {}  # of the newest rejected sample, by cause
        self.cause = ""
        self.refused_s = -math.inf

    def update(self, arrivals: Arrivals, now_s: float) -> None:
        """Note the number of messages, and the difference of clocks in a new one."""
        is_new = self.counts and self.counts[-1][1] != arrivals.count
        if is_new and arrivals.newest is not None:
            self.clocks.append((now_s, (arrivals.at_ns - arrivals.newest.stamp_ns) / 1e6))
        self.counts.append((now_s, arrivals.count))

        while self.counts[0][0] < now_s - RATE_WINDOW_S - 0.05:
            self.counts.popleft()
        while self.clocks and self.clocks[0][0] < now_s - RATE_WINDOW_S:
            self.clocks.popleft()

    def rate_hz(self) -> float:
        """Rate of the messages in the last second [Hz]."""
        begin_s, before = self.counts[0]
        now_s, count = self.counts[-1]
        return round((count - before) / (now_s - begin_s), 1) if now_s > begin_s else 0.0

    def clock_ms(self) -> float | None:
        """Difference of the clocks [ms]; None without a message in the last second."""
        return round(median(ms for _, ms in self.clocks), 1) if self.clocks else None

    def newest(self, now_s: float) -> tuple[str, Explanation]:
        """The newest rejection of the last second, by its cause and in words; empty: none."""
        if now_s - self.refused_s > RATE_WINDOW_S:
            return "", Explanation("", "")
        return self.cause, self.found[self.cause]


class InputMonitor:
    """Rates, clocks and rejections of the sources of one cell. Only one thread may use it."""

    def __init__(self, settings: Settings) -> None:
        self._settings = settings
        keys = [*(channel.key for channel in heard(settings)), *side_keys(settings)]
        self.arrivals = {key: Arrivals() for key in keys}
        self._keys = {source: key for source, key in KEY_OF_SOURCE.items() if key in keys}
        self._keys |= {key: key for key in keys if key not in self._keys.values()}
        self._histories = {name: _History() for name in self._keys}
        self._counted_s = 0.0

    def update(
        self, controller: Controller, state: Record, now_s: float
    ) -> Iterator[tuple[str, Source]]:
        """Name and input of each hand and of the arm at this moment; the `state` is that of the
        controller.
        """
        for source in SOURCES:
            if source in self._keys:
                yield source, self._source(source, controller, state, now_s)

    def streams(self, now_s: float) -> dict[str, Source]:
        """All other streams at this moment, by key."""
        return {name: self._stream(name, now_s) for name in self._keys if name not in SOURCES}

    def _stream(self, name: str, now_s: float, intake: Intake | None = None) -> Source:
        """Rate, clock and rejected messages of a stream; the `intake` rejects samples of hands and
        arm.
        """
        history = self._histories[name]
        arrivals = self.arrivals[self._keys[name]]
        history.update(arrivals, now_s)
        rejected = _rejected(name, arrivals, intake)
        for cause, count in rejected.items():
            if count != history.counted.get(cause):
                history.found[cause] = self._explained(name, cause, intake)
                history.cause = cause
                history.refused_s = now_s
        history.counted = rejected

        cause, explanation = history.newest(now_s)
        return Source(
            rate_hz=history.rate_hz(),
            clock_ms=history.clock_ms(),
            frame="" if arrivals.newest is None else arrivals.newest.frame_id[:LONGEST_NAME],
            rejected=rejected,
            cause=cause,
            refused=explanation.why,
            advice=explanation.what_to_do,
        )

    def _explained(self, name: str, cause: str, intake: Intake | None) -> Explanation:
        """The newest rejection of a source for this cause, in words."""
        arrivals = self.arrivals[self._keys[name]]
        if cause in (FROZEN, OTHER_PUBLISHER):
            return explained(Condition[cause.upper()])
        if cause == MALFORMED or intake is None:
            return explained(Condition.MALFORMED, Evidence(mistake=str(arrivals.refusal)))
        refused = intake.refused[name, Cause[cause.upper()]]
        if name == "wish":
            frames = wish_frames(self._settings)
            return refused_wish(refused.cause, refused.sample, refused.newest_ns, frames)
        return explained(refused.cause, evidence(refused, self._settings, arrivals))

    def _source(self, source: str, controller: Controller, state: Record, now_s: float) -> Source:
        """A hand, the arm or the wish: its stream, its age [ms], and what only its kind has."""
        period_ms = 1e3 * self._settings.period_s
        tick = int(state["tick"])
        of_its_kind: dict[str, Any] = {}
        if source == "arm":
            sample_tick = due_tick = int(state["arm_tick"])
            silent_ms = self._settings.arm.silent_ms
            of_its_kind = {"contested": round(float(state["arm_contested"]), 3)}
        elif source == "wish":
            sample_tick = int(state["wish_tick"])
            due_tick = newest_due(state)
            silent_ms = self._settings.skill.silent_ms
        else:
            index = SOURCES.index(source)
            sample_tick = due_tick = int(state["hand_ticks"][index])
            silent_ms = self._stale_ms(state, index)
            of_its_kind = self._hand(source, state)
        return msgspec.structs.replace(
            self._stream(source, now_s, controller.intake),
            age_ms=None if sample_tick < 0 else round((tick - sample_tick) * period_ms, 1),
            fresh=sample_tick >= 0 and (tick - due_tick) * period_ms < silent_ms,
            **of_its_kind,
        )

    def _stale_ms(self, state: Record, index: int) -> float:
        """Age [ms] from which a hand is stale."""
        return float(state["stale_ticks"][index]) * self._settings.period_s * 1e3

    def _hand(self, side: str, state: Record) -> dict[str, Any]:
        """Delays, scatter and batches of a hand's samples, by field of its source."""
        index = SOURCES.index(side)
        arrivals = self.arrivals[self._keys[side]]
        stale_ms = self._stale_ms(state, index) or self._settings.hands.stale_ms
        late_ms = lateness_ms(state, index, self._settings.period_s)
        is_seen = int(state["hand_ticks"][index]) >= 0
        return {
            "late_ms": None if late_ms is None else round(late_ms[0], 1),
            "late_95_ms": None if late_ms is None else round(late_ms[1], 1),
            "unit": self._unit_of(arrivals.newest),
            "scatter_mm": round(1e3 * float(state["noise_variance"][index]) ** 0.5, 2)
            if is_seen
            else None,
            "batches_ms": round(arrivals.batches_ms(stale_ms), 1),
        }

    def _unit_of(self, newest: PoseStamped | JointState | None) -> str:
        """The unit in which a hand's position seems to be; empty if it is that of the settings."""
        if not isinstance(newest, PoseStamped):
            return ""
        return unit_meant(newest.position, self._settings.hands_in(newest.frame_id).unit)

    def clutch(self, state: Record) -> str:
        """The problem with the clutch's messages; empty if there is none, or no clutch."""
        arrivals = self.arrivals.get("clutch")
        if arrivals is None:
            return ""
        if arrivals.count == arrivals.malformed:
            return "the clutch has not been heard yet"
        silent_ms = self._settings.hands.clutch_stale_ms
        is_silent = 0 < state["clutch_until_tick"] <= state["tick"]
        return (
            f"the clutch was last heard as pressed, and then not for {silent_ms:g} ms"
            if is_silent
            else ""
        )

    def news(self, sources: dict[str, Source], now_s: float) -> Iterator[str]:
        """Lines for the log: the first rejection of each cause at once, then counts."""
        is_due = now_s - self._counted_s >= COUNTS_EVERY_S
        for source, newest in sources.items():
            history = self._histories[source]
            name = input_name(source)
            logged = history.logged
            explanations = history.found
            for cause in newest.rejected.keys() - logged.keys():
                logged[cause] = newest.rejected[cause]
                yield f"{name}: rejected as {cause}{in_full(*explanations[cause])}"
            more = {
                cause: n - logged[cause]
                for cause, n in newest.rejected.items()
                if n > logged[cause]
            }
            if is_due and more:
                logged |= newest.rejected
                causes = ", ".join(
                    f"{n} {cause} ({newest.rejected[cause]} in all)" for cause, n in more.items()
                )
                yield f"{name}: rejected in the last {now_s - self._counted_s:.0f} s: {causes}"
        if is_due:
            self._counted_s = now_s


def lateness_ms(state: Record, side: int, period_s: float) -> tuple[float, float] | None:
    """Delay of a hand's retained samples above the minimum delay, mean and 95th percentile [ms];
    None while the tracker's clock is not trusted.
    """
    if state["clock"][side] != TRUSTED or not state["kept"][side]:
        return None
    newest = (int(state["kept_newest"][side]) - np.arange(int(state["kept"][side]))) % KEPT
    late_ms = 1e3 * period_s * state["kept_late"][side][newest]
    return float(np.mean(late_ms)), float(np.percentile(late_ms, 95))


def _rejected(name: str, arrivals: Arrivals, intake: Intake | None) -> dict[str, int]:
    """Rejected messages of a source by cause: first those that the intake rejected, then those of
    the stream.
    """
    counts = {
        MALFORMED: arrivals.malformed,
        FROZEN: arrivals.frozen,
        OTHER_PUBLISHER: arrivals.others,
    }
    if intake is not None:
        of_samples = zip(Cause, intake.rejected[SOURCES.index(name)], strict=True)
        counts = {word(cause): int(count) for cause, count in of_samples} | counts
    return {cause: count for cause, count in counts.items() if count}


def _too_far(sample: PoseStamped, settings: Settings) -> str:
    """Message about a position that is too far away, with the setting of its unit."""
    unit = settings.hands_in(sample.frame_id).unit
    return too_far(
        sample.position, unit, f"{settings.tracker_section(sample.frame_id)} unit is {unit!r}"
    )


def evidence(refused: Refused, settings: Settings, arrivals: Arrivals) -> Evidence:
    """A rejected sample, and the other samples of its source that arrived with it."""
    cause, sample, newest_ns, _ = refused
    assert not isinstance(sample, PoseWithCovarianceStamped)  # those are wishes
    held_up_s = arrivals.held_up_s(newest_ns, sample.stamp_ns) if cause is Cause.AHEAD else None
    is_set_back = cause is Cause.OLDER and arrivals.is_set_back(newest_ns)
    facts = Evidence(
        settings=settings,
        sample=sample,
        newest_ns=newest_ns,
        frames=settings.tracker_frames,
        held_up_s=held_up_s,
        is_set_back=is_set_back,
    )
    if isinstance(sample, PoseStamped):
        mistake = _too_far(sample, settings) if cause is Cause.OUT_OF_RANGE else ""
        return facts._replace(mistake=mistake)
    try:
        position, velocity = measured(sample, settings.joints.names)
    except WireError as error:
        return facts._replace(mistake=str(error))
    if cause is Cause.JUMPED:
        return facts._replace(jump=_largest_jump(settings.joints, refused.joints, position))
    outside = _outside(settings.joints, position, velocity)
    if cause is Cause.NOT_FINITE:
        outside = (joint for joint in outside if not math.isfinite(joint.value))
    return facts._replace(outside=next(outside, None))


def _largest_jump(joints: JointSettings, before: Sequence[float], after: Sequence[float]) -> Jump:
    """The joint that jumped farthest between two states, given their positions (J,) [rad]."""
    jumps = [*map(Jump, joints.names, before, after, joints.units)]
    sizes = [
        abs(_turned(jump, kind) / per_rad)
        for jump, kind, per_rad in zip(jumps, joints.every_kind, joints.per_rad, strict=True)
    ]
    return jumps[sizes.index(max(sizes))]


def _turned(leap: Jump, kind: str) -> float:
    """Distance between two positions of a joint; a continuous joint's without whole turns."""
    far = leap.after - leap.before
    return math.remainder(far, 2.0 * math.pi) if kind == "continuous" else far


def _outside(
    joints: JointSettings, position: tuple[float, ...], velocity: tuple[float, ...]
) -> Iterator[Outside]:
    """Measured values outside the accepted ranges."""
    of_joints = zip(
        joints.names, joints.units, joints.per_rad, joints.lower, joints.upper, strict=True
    )
    for (name, unit, per_rad, lower, upper), value, speed in zip(
        of_joints, position, velocity, strict=True
    ):
        low = lower - TUNING.intake.max_outside_rad * per_rad
        high = upper + TUNING.intake.max_outside_rad * per_rad
        if not low <= value <= high:
            yield Outside(name, value, low, high, unit)
        if not abs(speed) <= (fastest := TUNING.intake.max_joint_radps * per_rad):
            yield Outside(name, speed, -fastest, fastest, f"{unit}/s")
