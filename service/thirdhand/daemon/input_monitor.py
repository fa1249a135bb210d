"""The input of each hand, of the arm and of all other streams: rates, clocks, and rejected samples
with their causes.

The loop only counts samples. Everything else is computed beside it, ten times a second.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterator
from statistics import median

import msgspec

from thirdhand.contract.evidence import (
    LONGEST_NAME,
    Evidence,
    Explanation,
    Jump,
    Outside,
    explained,
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
from thirdhand.contract.messages import JointState, PoseStamped, WireError
from thirdhand.contract.records import SOURCES, Cause
from thirdhand.contract.requests import Source
from thirdhand.core.controller import Controller
from thirdhand.core.frame import Record
from thirdhand.core.intake.far_away import too_far, unit_meant
from thirdhand.core.intake.late_samples import lateness_ms
from thirdhand.core.intake.stage import Intake, Refused
from thirdhand.core.tuning import TUNING
from thirdhand.daemon.cell_streams import Arrivals, heard
from thirdhand.daemon.side_streams import side_keys
from thirdhand.settings.config import JointSettings, Settings

RATE_WINDOW_S = 1.0  # rates and clocks are taken over this time
COUNTS_EVERY_S = 10.0  # interval of the log lines that count further rejections
KEY_OF_SOURCE = dict(zip(SOURCES, ("hands/left", "hands/right", "joints/state"), strict=True))


class _History:
    """The last second of one source, and the rejections that were logged."""

    def __init__(self) -> None:
        self.counts: deque[tuple[float, int]] = deque()
        self.clocks: deque[tuple[float, float]] = deque()
        self.seen: dict[str, int] = {}
        self.logged: dict[str, int] = {}
        self.found: dict[str, Explanation] = {}  # of the newest rejected sample, by cause
        self.cause = ""
        self.refused_s = -math.inf


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
        """Each source with its name at this moment, from the state of this controller."""
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
        if (
            history.counts
            and history.counts[-1][1] != arrivals.count
            and arrivals.newest is not None
        ):
            history.clocks.append((now_s, (arrivals.at_ns - arrivals.newest.stamp_ns) / 1e6))
        history.counts.append((now_s, arrivals.count))
        while history.counts[0][0] < now_s - RATE_WINDOW_S - 0.05:
            history.counts.popleft()
        while history.clocks and history.clocks[0][0] < now_s - RATE_WINDOW_S:
            history.clocks.popleft()
        since_s, before = history.counts[0]
        counted = {
            MALFORMED: arrivals.malformed,
            FROZEN: arrivals.frozen,
            OTHER_PUBLISHER: arrivals.others,
        }
        rejected = {cause: count for cause, count in counted.items() if count}
        if intake is not None:
            counts = zip(Cause, intake.rejected[SOURCES.index(name)], strict=True)
            rejected = {word(cause): int(n) for cause, n in counts if n} | rejected
        for cause in (
            cause for cause, count in rejected.items() if count != history.seen.get(cause)
        ):
            if cause in (FROZEN, OTHER_PUBLISHER):
                history.found[cause] = explained(Condition[cause.upper()])
            elif cause == MALFORMED or intake is None:
                history.found[cause] = explained(
                    Condition.MALFORMED, Evidence(mistake=arrivals.why)
                )
            else:
                refused = intake.refused[name, Cause[cause.upper()]]
                seen_of = evidence(refused, self._settings, arrivals)
                history.found[cause] = explained(refused.cause, seen_of)
            history.cause = cause
            history.refused_s = now_s
        history.seen = rejected
        lately = now_s - history.refused_s <= RATE_WINDOW_S
        newest = history.found[history.cause] if lately else None
        return Source(
            rate_hz=round((arrivals.count - before) / (now_s - since_s), 1)
            if now_s > since_s
            else 0.0,
            clock_ms=round(median(ms for _, ms in history.clocks), 1) if history.clocks else None,
            frame="" if arrivals.newest is None else arrivals.newest.frame_id[:LONGEST_NAME],
            rejected=rejected,
            cause=history.cause if lately else "",
            refused="" if newest is None else newest.why,
            advice="" if newest is None else newest.what_to_do,
        )

    def _source(self, source: str, controller: Controller, state: Record, now_s: float) -> Source:
        index = SOURCES.index(source)
        arrivals = self.arrivals[self._keys[source]]
        sample_tick = int(state["arm_tick"] if source == "arm" else state["hand_ticks"][index])
        settings = self._settings
        age_ms = (
            None
            if sample_tick < 0
            else round((int(state["tick"]) - sample_tick) * settings.period_s * 1e3, 1)
        )
        stale_ms = (
            0.0 if source == "arm" else float(state["stale_ticks"][index]) * settings.period_s * 1e3
        )
        silent_ms = settings.arm.silent_ms if source == "arm" else stale_ms
        late = None if source == "arm" else lateness_ms(state, index, settings.period_s)
        return msgspec.structs.replace(
            self._stream(source, now_s, controller.intake),
            age_ms=age_ms,
            fresh=age_ms is not None and age_ms < silent_ms,
            late_ms=None if late is None else round(late[0], 1),
            late_95_ms=None if late is None else round(late[1], 1),
            contested=round(float(state["arm_contested"]), 3) if source == "arm" else 0.0,
            scatter_mm=None
            if source == "arm" or sample_tick < 0
            else round(1e3 * float(state["noise_variance"][index]) ** 0.5, 2),
            unit=self._unit_of(arrivals.newest),
            batches_ms=0.0
            if source == "arm"
            else round(arrivals.batches_ms(stale_ms or settings.hands.stale_ms), 1),
        )

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
        counts = now_s - self._counted_s >= COUNTS_EVERY_S
        for source, now in sources.items():
            history = self._histories[source]
            name = input_name(source)
            logged = history.logged
            explanations = history.found
            for cause in now.rejected.keys() - logged.keys():
                logged[cause] = now.rejected[cause]
                yield f"{name}: rejected as {cause}{in_full(*explanations[cause])}"
            more = {
                cause: n - logged[cause] for cause, n in now.rejected.items() if n > logged[cause]
            }
            if counts and more:
                logged |= now.rejected
                causes = ", ".join(
                    f"{n} {cause} ({now.rejected[cause]} in all)" for cause, n in more.items()
                )
                yield f"{name}: rejected in the last {now_s - self._counted_s:.0f} s: {causes}"
        if counts:
            self._counted_s = now_s


def _too_far(sample: PoseStamped, settings: Settings) -> str:
    """Message about a position that is too far away, with the setting of its unit."""
    unit = settings.hands_in(sample.frame_id).unit
    return too_far(
        sample.position, unit, f"{settings.tracker_section(sample.frame_id)} unit is {unit!r}"
    )


def evidence(refused: Refused, settings: Settings, arrivals: Arrivals) -> Evidence:
    """A rejected sample, and the other samples of its source that arrived with it."""
    cause, sample, newest_ns, _ = refused
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
        joints = settings.joints
        leaps = [*map(Jump, joints.names, refused.joints, position, joints.units)]
        sizes = [
            abs(_turned(leap, kind) / per_rad)
            for leap, kind, per_rad in zip(leaps, joints.every_kind, joints.per_rad, strict=True)
        ]
        return facts._replace(jump=leaps[sizes.index(max(sizes))])
    outside = [*_outside(settings.joints, position, velocity)]
    if cause is Cause.NOT_FINITE:
        outside = [joint for joint in outside if not math.isfinite(joint.value)]
    return facts._replace(outside=outside[0] if outside else None)


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
