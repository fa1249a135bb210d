"""An incident explained with the figures of the moment: what was found, and what to do about it.

Without figures, the words are those of the table in `incidents.py`; a closer cause that the figures
show has a row of its own there.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Any, NamedTuple, TypeAlias

from thirdhand.contract.incidents import (
    SOURCE_NAMES,
    THEN_RESET,
    Condition,
    Member,
    what_happened,
    what_to_do,
    word,
)
from thirdhand.contract.messages import JointState, PoseStamped
from thirdhand.contract.records import FARTHEST_WISH_S, SIDES, Cause, Flag, Reason
from thirdhand.contract.requests import Source

LONGEST_NAME = 64  # characters of a frame's name
# reasons that a busy machine causes too, unless the samples of these sources are rejected
OF_A_BUSY_MACHINE = {
    Reason.STALE_HAND: SIDES,
    Reason.ARM_ERROR: ("arm",),
    Reason.ARM_SILENT: ("arm",),
}
FULL_TURN_RAD = 7.0  # no joint is farther from its zero: larger values are degrees

Exceeded: TypeAlias = tuple[float, float]  # a value and its limit


class Explanation(NamedTuple):
    """An incident in words for people; both are empty where there is none."""

    why: str
    what_to_do: str


class Outside(NamedTuple):
    """Value of a joint outside the accepted range."""

    joint: str
    value: float
    low: float
    high: float
    unit: str = "rad"


class Jump(NamedTuple):
    """Jump of a joint between two states."""

    joint: str
    before: float
    after: float
    unit: str = "rad"


class Inside(NamedTuple):
    """A part of the arm that is inside of a thing."""

    joint: str  # the joint that moves the part
    thing: str
    depth_m: float


class Stuck(NamedTuple):
    """A tool that does not reach its target, and its way out."""

    off_m: float
    joints_at_limits: tuple[str, ...]
    posture: int  # number of the posture on the way out that is next; 0: no way out is known
    postures: int


class Evidence(NamedTuple):
    """Figures at the time of an incident; unknown ones are left out."""

    sources: Mapping[str, Source] = MappingProxyType({})
    contested: float = 0.0  # accepted share of the arm's states that contradict the rest
    settings: Any = None  # of the cell
    # deviation from what the skill knows, and the one below which the hold ends
    gate_m: Exceeded | None = None
    measure: str = ""  # the skill's name for that deviation
    outside: Outside | None = None
    inside: Inside | None = None
    stuck: Stuck | None = None
    error_rad: Exceeded | None = None  # largest joint error at the fault
    late_s: float = 0.0  # delay of the arm behind its commands; 0: none was found
    # the joint that is farthest from its command now, with unit
    worst_joint: tuple[str, float, str] | None = None
    measured_speed: Exceeded | None = None  # of the tool [m/s]
    commanded_speed: Exceeded | None = None
    failure: str = ""  # of the service
    clutch: str = ""  # the problem with the clutch's messages; empty: it was released
    busy: str = ""  # signs of a busy machine when the incident began
    # About a rejected sample:
    sample: PoseStamped | JointState | None = None
    newest_ns: int = 0  # stamp of the newest sample accepted before
    frames: tuple[str, ...] = ()  # accepted frames
    mistake: str = ""  # in its unit, its names or its bytes
    jump: Jump | None = None
    # delay of the newest accepted sample beyond the others; None: the clock differs
    held_up_s: float | None = None
    is_set_back: bool = False  # all samples since the newest accepted one are stamped before it


NOTHING = Evidence()


def explained(member: Member, seen: Evidence = NOTHING) -> Explanation:
    """An incident in words, with the figures that were seen."""
    finding = ""
    remedy = ""
    match member:
        case Reason():
            finding, remedy = _reason(member, seen)
        case Flag.STUCK:
            finding = _stuck(seen.stuck)
        case Cause() | Condition.MALFORMED:
            finding, remedy = _rejection(member, seen)
    named = word(member)
    why = finding or what_happened(named, seen.settings)
    remedy = remedy or what_to_do(named)
    if seen.busy and isinstance(member, Reason) and _is_of_a_busy_machine(member, seen):
        why = f"this machine was too busy, {seen.busy}; {why}"
        remedy = f"{what_to_do(Condition.MACHINE_BUSY)}; {remedy}"
    return Explanation(why, remedy)


def _reason(reason: Reason, seen: Evidence) -> tuple[str, str]:  # noqa: C901, PLR0912 - a case for each reason
    """The finding and its remedy if the figures show a closer cause; empty otherwise."""
    finding = ""
    closer = ""
    match reason:
        case Reason.NO_HANDS | Reason.STALE_HAND:
            finding = _unseen(seen)
            closer = _unseen_remedy(reason, seen)
        case Reason.FAR_FROM_DEMONSTRATIONS:
            finding, closer = _far_from_demonstrations(seen)
        case Reason.TWO_SOURCES:
            finding = _contest(seen)
        case Reason.ARM_NOT_READY:
            finding, closer = _not_ready(seen)
        case Reason.BLOCKED:
            finding = _stuck(seen.stuck)
        case Reason.ARM_ERROR:
            finding = _joint_error(seen)
            if contradiction := _contradiction(seen):
                finding = (
                    f"{contradiction}; {finding or what_happened(word(reason), seen.settings)}"
                )
                closer = what_to_do(Condition.TWO_DRIVERS) + THEN_RESET
            elif seen.late_s:
                finding = f"the arm is about {lasting(1000.0 * seen.late_s)} late; {finding}"
                closer = what_to_do(Condition.ARM_LATE) + THEN_RESET
        case Reason.ARM_SILENT:
            finding = _silence(seen)
            if _rate_too_low(seen, "arm"):
                closer = what_to_do(Condition.JOINTS_TOO_RARE) + THEN_RESET
        case Reason.TOOL_SPEED if seen.measured_speed is not None:
            finding = "the tool was measured at {:.2f} m/s, {:g} accepted".format(
                *seen.measured_speed
            )
        case Reason.TOOL_SPEED if seen.commanded_speed is not None:
            finding = "a command reached {:.2f} m/s, {:g} accepted".format(*seen.commanded_speed)
        case Reason.SERVICE:
            finding = seen.failure
        case Reason.CLUTCH:
            finding = seen.clutch
    return finding, closer


def _unseen_remedy(reason: Reason, seen: Evidence) -> str:
    """The remedy for hands that are not seen, if the figures show a closer cause; else empty."""
    if remedy := _rejected_remedy(seen, *SIDES):
        return remedy
    if reason is Reason.STALE_HAND and any(_rate_too_low(seen, side) for side in SIDES):
        return what_to_do(Condition.HANDS_TOO_RARE)
    is_delayed = any(hand.batches_ms for hand in _hands(seen))
    return what_to_do(Condition.DELAYED) if is_delayed else ""


def _far_from_demonstrations(seen: Evidence) -> tuple[str, str]:
    """The finding on hands far from the demonstrations, and its remedy if it has a closer cause."""
    if unit := _unit_of_all(seen):
        finding = (
            f"the hands' positions look like {unit}, which is not the unit of their tracker in "
            "the settings"
        )
        return finding, unit_advice(unit)
    if seen.gate_m is None:
        return "", ""
    finding = "{} is {:.1f} cm; the hold ends below {:.1f}".format(
        seen.measure, *(100 * value for value in seen.gate_m)
    )
    jumping = [SOURCE_NAMES[side] for side in SIDES if _jumps(seen, side)]
    if not jumping:
        return finding, ""
    jumped = f"the {' and the '.join(jumping)} jumped in the last second"
    return f"{jumped}; {finding}", what_to_do(word(Cause.JUMPED))


def _rejection(cause: Cause | Condition, seen: Evidence) -> tuple[str, str]:  # noqa: C901, PLR0912 - a case for each cause
    """The rejected sample, and what to do if the figures show a closer cause; empty otherwise."""
    if seen.sample is None:
        return seen.mistake, ""
    sample = seen.sample
    finding = seen.mistake
    closer = ""
    turned = getattr(sample, "orientation", ())
    advanced_s = (sample.stamp_ns - seen.newest_ns) * 1e-9
    position_text = (
        f"at {figures(sample.position)} in the tracker's frame"
        if turned
        else f"joints at {figures(sample.position)}"
    )
    match cause:
        case Cause.NOT_FINITE if (out := seen.outside) is not None:
            finding = f"{out.joint} at {out.value:g} {out.unit}; a finite number needed"
        case Cause.NOT_FINITE:
            finding = (
                f"{position_text}{f', orientation {figures(turned)}' if turned else ''}; finite "
                "numbers needed"
            )
        case Cause.NOT_A_ROTATION:
            norm = sum(v * v for v in turned) ** 0.5
            finding = f"orientation {figures(turned)} of norm {norm:.3g}; norm 1 needed, x y z w"
        case Cause.OUT_OF_RANGE if (out := seen.outside) is not None:
            is_degrees = out.unit == "rad" and abs(out.value) > FULL_TURN_RAD
            like = ", which looks like degrees" if is_degrees else ""
            finding = (
                f"{out.joint} at {out.value:.4g} {out.unit}{like}; {out.low:g} to {out.high:g} "
                "accepted"
            )
            closer = what_to_do(Condition.DEGREES) if is_degrees else ""
        case Cause.REPEATED:
            finding = (
                f"stamp {sample.stamp_ns * 1e-9:.3f} s again; a newer one with each sample needed"
            )
        case Cause.OLDER:
            finding = f"stamped {lasting(-1000 * advanced_s)} before the newest accepted one"
            if seen.is_set_back:
                finding = f"{finding}: its clock was set back"
                closer = what_to_do(Condition.CLOCK_STEPPED)
        case Cause.AHEAD:
            finding = f"stamped {lasting(1000 * advanced_s)} after the newest accepted one"
            if seen.held_up_s is None:
                finding = f"{finding}: its clock stepped ahead"
                closer = what_to_do(Condition.CLOCK_STEPPED)
            else:
                finding += (
                    f", which arrived {lasting(1000 * seen.held_up_s)} late (its clock is right)"
                )
                closer = what_to_do(Condition.DELAYED)
        case Cause.JUMPED if (jump := seen.jump) is not None:
            finding = (
                f"{jump.joint} from {jump.before:.4g} to {jump.after:.4g} {jump.unit}, from one "
                "sample to the next"
            )
        case Cause.JUMPED:
            finding = f"{position_text}, from one sample to the next"
        case Cause.WRONG_FRAME:
            accepted = ", ".join(repr(frame) for frame in seen.frames if frame)
            finding = f"frame {sample.frame_id[:LONGEST_NAME]!r}; {accepted} or none accepted"
    return finding, closer


def refused_wish(cause: Cause, wish: Any, now_ns: int, frames: tuple[str, ...]) -> Explanation:
    """A wish that was rejected at the time `now_ns` [ns], in words."""
    off_ms = (wish.stamp_ns - now_ns) * 1e-6 if wish.stamp_ns else 0.0
    clock = "stamp wishes by the clock of the daemon's machine, or with 0 for now"
    match cause:
        case Cause.OLDER:
            return Explanation(
                f"due {lasting(-off_ms)} ago; up to 1 s accepted",
                f"drop what a policy answers too late; {clock}",
            )
        case Cause.AHEAD if off_ms <= 1000.0 * FARTHEST_WISH_S:
            return Explanation("128 poses wait already", "send poses farther apart, or fewer")
        case Cause.AHEAD:
            return Explanation(
                f"due in {lasting(off_ms)}; up to 1 s accepted",
                f"send the end of a long chunk later; {clock}",
            )
        case Cause.OUT_OF_RANGE:
            return Explanation(
                f"at {figures(wish.position)} in frame {wish.frame_id[:LONGEST_NAME]!r}; up to 10 "
                "m from the base plate accepted",
                "publish wishes in the unit of their frame, metres in `base`",
            )
        case Cause.NOT_FINITE:
            return Explanation(
                f"at {figures(wish.position)}, orientation {figures(wish.orientation)}; finite "
                "numbers, and a covariance from 0 to 1e6, needed",
                "publish nothing while the policy has no answer",
            )
    facts = Evidence(sample=wish, newest_ns=now_ns, frames=frames)
    return Explanation(_rejection(cause, facts)[0], what_to_do(word(cause)))


def _unseen(seen: Evidence) -> str:
    """The hands that are not seen, since when, and what of them is rejected."""
    clauses = []
    for side in SIDES:
        if (source := seen.sources.get(side)) is not None and not source.fresh:
            since = (
                "has not been seen yet"
                if source.age_ms is None
                else f"was last seen {lasting(source.age_ms)} ago"
            )
            since = f"arrives {rate}" if (rate := _rate_too_low(seen, side)) else since
            since += (
                f", and arrives in batches, {lasting(source.batches_ms)} apart"
                if source.batches_ms
                else ""
            )
            instead = (
                f", as what arrives is rejected as {source.cause}: {source.refused}"
                if _is_rejected(source)
                else ""
            )
            clauses.append(f"the {SOURCE_NAMES[side]} {since}{instead}")
    return "; ".join(clauses)


def _unit_of_all(seen: Evidence) -> str:
    """The unit in which the positions of all hands that arrive seem to be; empty otherwise."""
    units = {hand.unit for hand in _hands(seen) if hand.rate_hz}
    return units.pop() if len(units) == 1 else ""


def _hands(seen: Evidence) -> list[Source]:
    return [seen.sources[side] for side in SIDES if side in seen.sources]


def _jumps(seen: Evidence, side: str) -> bool:
    """True if the newest rejected sample of a hand, within the last second, had jumped."""
    return side in seen.sources and seen.sources[side].cause == word(Cause.JUMPED)


def _contest(seen: Evidence) -> str:
    """The share of the arm's states that contradict each other, in words."""
    if (arm := seen.sources.get("arm")) is None:
        return ""
    when = "in the last second" if arm.rate_hz else "before it ended"
    return f"{SOURCE_NAMES['arm']}, {when}: {arm.contested:.0%} of the states contradict the rest"


def unit_advice(unit: str) -> str:
    """The remedy for positions that seem to be in another unit than that of the settings."""
    return f'{what_to_do(Condition.WRONG_UNIT)}: unit = "{unit}"'


def _joint_error(seen: Evidence) -> str:
    """The largest joint error at the fault, and the worst joint now."""
    if seen.error_rad is None or seen.worst_joint is None:
        return ""
    joint, deviation, unit = seen.worst_joint
    half = "" if unit == "rad" else ", half as many m for one that slides"
    at_fault = "a joint was {:.3f} rad off, {:g} accepted".format(*seen.error_rad)
    return f"{at_fault}{half}; now {joint} is off by {deviation:.3f} {unit}"


def _contradiction(seen: Evidence) -> str:
    """The contradiction among the arm's states of the last second; empty if there is none."""
    if (arm := seen.sources.get("arm")) is None:
        return ""
    if arm.contested > seen.contested:
        return f"{arm.contested:.0%} of the arm's states in the last second contradict the rest"
    return (
        f"states of the arm were rejected as jumped: {arm.refused}"
        if arm.cause == word(Cause.JUMPED)
        else ""
    )


def _rate_too_low(seen: Evidence, name: str) -> str:
    """The rate of a source whose samples still arrive, but at longer intervals than accepted, and
    the least rate; empty otherwise.
    """
    source = seen.sources.get(name)
    if seen.settings is None or source is None or source.age_ms is None or _is_rejected(source):
        return ""
    accepted_ms = (
        seen.settings.arm.silent_ms if name == "arm" else seen.settings.hands.longest_stale_ms
    )
    # the next sample is not overdue by a whole interval
    continues = source.age_ms * source.rate_hz < 2000.0
    if not continues or not 0.0 < source.rate_hz * accepted_ms < 1000.0:
        return ""
    return f"at {source.rate_hz:.1f} Hz, {1000 / accepted_ms:g} Hz at least needed"


def _silence(seen: Evidence) -> str:
    """The time without joint states, or their rate if it is too low; empty otherwise."""
    source = seen.sources.get("arm")
    if rate := _rate_too_low(seen, "arm"):
        return f"joint states arrive {rate}"
    if source is None or source.fresh:
        return ""
    return (
        "no joint states arrived yet"
        if source.age_ms is None
        else f"no joint states for {lasting(source.age_ms)}"
    )


def _not_ready(seen: Evidence) -> tuple[str, str]:
    """The condition that keeps the arm from being ready, and its remedy."""
    source = seen.sources.get("arm")
    out = seen.outside
    if source is None:
        return "", ""
    if rejected := _rejected_remedy(seen, "arm"):
        return (
            f"what arrives from the arm is rejected as {source.cause}: {source.refused}",
            rejected,
        )
    condition = "the arm has not rested in one posture for long enough"
    closer = ""
    if out is not None:
        condition = (
            f"{out.joint} at {out.value:.3f} {out.unit} is outside {out.low:g} to {out.high:g}, "
            "and is moved back"
        )
    elif seen.inside is not None:
        condition = "the part that {} moves is inside of {} by {:.3f} m".format(*seen.inside)
    if seen.inside is not None:
        closer = what_to_do(Condition.ARM_INSIDE)
    elif _rate_too_low(seen, "arm"):
        closer = what_to_do(Condition.JOINTS_TOO_RARE)
    elif source.fresh:
        closer = what_to_do(Condition.ARM_UNSETTLED)
    return _silence(seen) or condition, closer


def _stuck(seen: Stuck | None) -> str:
    """The distance of a stuck tool from its target, what limits it, and its way out."""
    if seen is None:
        return ""
    limits = (
        f"{', '.join(seen.joints_at_limits)} at a limit"
        if seen.joints_at_limits
        else "it cannot come nearer"
    )
    way_out = (
        f"on its way out, posture {seen.posture} of {seen.postures}"
        if seen.posture
        else "no way out is known yet"
    )
    return f"the tool is {seen.off_m:.2f} m from its target: {limits}; {way_out}"


def _is_rejected(source: Source) -> bool:
    """True if messages of a source arrive, and none is accepted."""
    return source.rate_hz > 0 and not source.fresh and bool(source.cause)


def _rejected_remedy(seen: Evidence, *needed: str) -> str:
    """The remedy for the first needed source whose samples are all rejected; empty otherwise."""
    rejected = (
        source
        for name in needed
        if (source := seen.sources.get(name)) is not None and _is_rejected(source)
    )
    return next((source.advice or what_to_do(source.cause) for source in rejected), "")


def _is_of_a_busy_machine(reason: Reason, seen: Evidence) -> bool:
    """True if a busy machine may have caused the reason, and nothing closer did."""
    if reason not in OF_A_BUSY_MACHINE or (reason is Reason.ARM_ERROR and _contradiction(seen)):
        return False
    if reason is Reason.STALE_HAND and any(hand.fresh or hand.batches_ms for hand in _hands(seen)):
        return False  # a machine that is late is late with both hands
    return not _rejected_remedy(seen, *OF_A_BUSY_MACHINE[reason])


def lasting(duration_ms: float) -> str:
    """A duration for people: 30 ms, 4.2 s, 3 h, 12 days."""
    if duration_ms < 1000.0:
        return f"{duration_ms:.0f} ms"
    sizes_ms = {"days": 86.4e6, "h": 3.6e6, "min": 60e3}
    unit, size_ms = next(
        (size for size in sizes_ms.items() if duration_ms >= 2.0 * size[1]), ("s", 1000.0)
    )
    count = duration_ms / size_ms
    return f"{count:.{3 if count < 1000.0 else 4}g} {unit}"


def figures(values: Sequence[float]) -> str:
    """Numbers for people: (980, -320, 60)."""
    return f"({', '.join(f'{v:.4g}' for v in values)})"
