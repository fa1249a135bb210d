"""Why the arm does what it does, in words: the one place where a mode, a reason, a flag or a cause
of rejection is explained, with the figures known at the time, and what to do about it.

Status, `doctor`, log, viewer, report and docs/incidents.md take their words from here. A new reason
is a member in records.py, its words here, and the stage that decides it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Final, Literal, NamedTuple, TypeAlias, assert_never

from service.contract.messages import JointState, PoseStamped
from service.contract.records import GONE_S, SIDES, Cause, Flag, Mode, Reason
from service.contract.requests import Source

SOURCE_NAMES = {"left": "left hand", "right": "right hand", "arm": "arm"}
MALFORMED: Final = "malformed"  # bytes that could not be decoded: counted beside the causes
FAULTS = (Reason.ARM_ERROR, Reason.ARM_SILENT, Reason.TOOL_SPEED, Reason.SETPOINT, Reason.SERVICE)  # all others: holds
LONGEST_NAME = 64  # of a frame
OF_TIME = {  # reasons that a machine which is too busy causes as well, unless samples of these sources are refused
    Reason.STALE_HAND: SIDES,
    Reason.ARM_ERROR: ("arm",),
    Reason.ARM_SILENT: ("arm",),
}
FREE_THE_MACHINE = "see what else runs on this machine, `thirdhand bench` measures it; or lower `rate_hz`"
FULL_TURN_RAD = 7.0  # no joint is farther from its zero

Excess: TypeAlias = tuple[float, float]  # a value, and the greatest that is accepted
Member: TypeAlias = Mode | Reason | Flag | Cause | Literal["malformed"]


class Incident(NamedTuple):
    """What a member means, what to do about it, and what was found, where figures were known."""

    about: str
    remedy: str
    found: str = ""

    @property
    def why(self) -> str:
        """The sentence for people."""
        return (self.found or self.about).replace("`", "")

    @property
    def what_to_do(self) -> str:
        """The remedy for people."""
        return self.remedy.replace("`", "")


class Outside(NamedTuple):
    """A joint's value outside of what is accepted."""

    joint: str
    value: float
    low: float
    high: float
    unit: str = "rad"


class Jump(NamedTuple):
    """A joint that leapt from one state to the next."""

    joint: str
    before: float
    after: float
    unit: str = "rad"


class Inside(NamedTuple):
    """A part of the arm that is inside of something."""

    joint: str  # that moves the part
    thing: str
    depth_m: float


class Stuck(NamedTuple):
    """A tool that does not come to its target, and what of a way out is known."""

    off_m: float
    at_limits: tuple[str, ...]  # joints
    posture: int  # of the way out, that it goes to; 0: there is none
    postures: int


class Evidence(NamedTuple):
    """What is known at the time; what is not is left out."""

    sources: Mapping[str, Source] = MappingProxyType({})
    contested: float = 0.0  # accepted share of samples that contradict the rest
    scatter_mm: float = 0.0  # accepted of a hand's samples
    gate_m: Excess | None = None  # what the skill's threshold is for
    measure: str = ""  # what that is, in words
    outside: Outside | None = None
    inside: Inside | None = None
    stuck: Stuck | None = None
    error_rad: Excess | None = None  # of a joint from its command, at the fault
    worst_joint: tuple[str, float, str] | None = None  # the one farthest from its command now, and the unit
    measured_speed: Excess | None = None  # of the tool [m/s]
    commanded_speed: Excess | None = None
    failure: str = ""  # of the service
    silent_ms: float = 0.0  # accepted between states of the arm
    stale_ms: float = 0.0  # accepted between samples of a hand
    busy: str = ""  # how this machine was too busy when it began
    # of a sample that was rejected:
    sample: PoseStamped | JointState | None = None
    newest_ns: int = 0  # stamp of the newest one accepted before
    frames: tuple[str, ...] = ()  # that are accepted
    mistake: str = ""  # in its unit, its names or its bytes
    jump: Jump | None = None
    held_up_s: float | None = None  # delay of the newest accepted one beyond the others; None: its clock differs


NOTHING = Evidence()
NO_SAMPLE = PoseStamped(0, "", (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))


def word(member: Member) -> str:
    """The word for a member in statuses and recordings; empty for no reason."""
    return member if isinstance(member, str) else "" if member is Reason.NONE else str(member.name).lower()


def explained(member: Member, seen: Evidence = NOTHING) -> Incident:
    """What a member means, with what was seen; a new one does not type-check until it is told."""
    match member:
        case Mode():
            return Incident(*_mode(member))
        case Reason():
            return _reason(member, seen)
        case Flag():
            return Incident(*_flag(member), _stuck(seen.stuck) if member is Flag.STUCK else "")
        case Cause() | "malformed":
            return _cause(member, seen)


def _mode(mode: Mode) -> tuple[str, str]:
    """What the arm does, and how the mode ends."""
    match mode:
        case Mode.FOLLOW:
            return "follows the hands", "with any reason below"
        case Mode.HOLD:
            ends = "by itself once the reason is gone; after `hold` by `thirdhand resume`"
            return "has come to rest, or is on its way there, within its limits", ends
        case Mode.FAULT:
            ends = "by `thirdhand reset`, once the cause is mended"
            return "has come to rest; commands are no longer sent", ends
        case _:
            assert_never(mode)


def _reason(reason: Reason, seen: Evidence) -> Incident:
    found = ""
    arm = seen.sources.get("arm")
    contradiction = _contradiction(arm, seen.contested) if reason is Reason.ARM_ERROR else ""
    match reason:
        case Reason.NONE:
            about = remedy = ""
        case Reason.NO_HANDS:
            about, found = "a hand has not been seen since the start", _unseen(seen)
            remedy = "start the tracker; `hand_age_ms` in the status names the hands that are there"
            remedy = _of_rejected(seen, *SIDES) or remedy
        case Reason.STALE_HAND:
            about = "no accepted sample of both hands for 100 ms, or of one for 500 ms; at once where the tool needs it"
            found = _unseen(seen)
            remedy = "look at the tracker; growing counters under `rejected` mean that samples come and are refused; "
            remedy += f"a hand that the skill does without is waited for {GONE_S:g} s only"
            if any(_is_seldom(seen, side, seen.stale_ms) for side in SIDES):
                remedy = "publish hands more often, or raise `[hands] stale_ms`"
            remedy = _of_rejected(seen, *SIDES) or remedy
        case Reason.FAR_FROM_DEMONSTRATIONS:
            about = "the skill is not sure where the tool belongs with the hands as they are"
            remedy = "bring the hands back to where it was demonstrated, or demonstrate this too"
            if seen.gate_m is not None:
                value_cm, accepted_cm = (100 * value for value in seen.gate_m)
                found = f"{seen.measure} is {value_cm:.1f} cm, {accepted_cm:.1f} accepted"
        case Reason.TWO_SOURCES:
            about = "a quarter of what came in the last second says that a hand, or the arm, is somewhere else; or "
            about += "a hand's samples scatter by more than 12 mm"
            remedy = "two trackers or drivers publish under one key: stop one; "
            remedy += "`rejected` counts `older` and `jumped` meanwhile"
            found = _contest(seen)
        case Reason.OPERATOR:
            about, remedy = "a hold was requested, or the daemon was stopped", "`thirdhand resume`"
        case Reason.ARM_NOT_READY:
            about = "the arm does not say where it is, does not rest within its limits yet, or stands in something"
            found = _not_ready(seen)
            remedy = "start the arm's driver; `joints/state` must name the joints as `joints/command` does"
            if arm is not None and arm.fresh:
                remedy = "wait: it begins by itself once the arm has rested within its limits for 0.1 s"
            remedy = _of_rate(seen) or remedy
            if seen.inside is not None:
                remedy = "bring the arm out by hand, or by `thirdhand reset`, which moves it out slowly; "
                remedy += "where nothing is there mend [table], [obstacles] or the URDF"
            remedy = _of_rejected(seen, "arm") or remedy
        case Reason.BLOCKED:
            about = "joints at their ends, or things around it, keep the tool from its target, wherever it goes"
            remedy = "a way out is looked for, and gone; where none is found it tries again for another target"
            found = _stuck(seen.stuck)
        case Reason.AMBIGUOUS:
            about = "two stages of the task go with the hands as they are, and the tool is elsewhere in each"
            remedy = "go on: the hands will tell; or say it, `thirdhand stage NAME`"
        case Reason.ARM_ERROR:
            about = "the arm was measured farther from where it was told to be than `[arm] fault_error_rad`"
            remedy = "see what blocked or pushed it, then `thirdhand reset`"
            if seen.error_rad is not None and seen.worst_joint is not None:
                found = "a joint was {:.3f} rad off, {:g} accepted".format(*seen.error_rad)
                found += "; " if seen.worst_joint[2] == "rad" else ", half as many m for one that slides; "
                found += "now {} is off by {:.3f} {}".format(*seen.worst_joint)
            if contradiction:
                found = f"{contradiction}; {found or about}"
                remedy = "see whether two drivers publish `joints/state`, and stop one, then `thirdhand reset`"
        case Reason.ARM_SILENT:
            about, found = "the arm told nothing for 100 ms while it was to move", _silence(seen)
            remedy = "look at its driver and the network, then `thirdhand reset`"
            if advice := _of_rate(seen):
                remedy = f"{advice}, then `thirdhand reset`"
        case Reason.TOOL_SPEED:
            about = "the tool was measured faster than `[tool] fault_speed` for 30 ms"
            remedy = "the arm does not do what it is told: check the driver before `thirdhand reset`"
            if seen.measured_speed is not None:
                found = "the tool was measured at {:.2f} m/s, {:g} accepted".format(*seen.measured_speed)
            elif seen.commanded_speed is not None:
                found = "a command came to {:.2f} m/s, {:g} accepted".format(*seen.commanded_speed)
        case Reason.SETPOINT:
            about = "a bound of the setpoint was passed, which cannot happen"
            remedy = "keep the recording and report it"
        case Reason.SERVICE:
            about = "a thread or the loop of the service failed; it is begun anew, and the log says which and why"
            remedy, found = "keep log and recording, report it, then `thirdhand reset`", seen.failure
        case _:
            assert_never(reason)
    if seen.busy and reason in OF_TIME and not (contradiction or _of_rejected(seen, *OF_TIME[reason])):
        found, remedy = f"this machine was too busy, {seen.busy}; {found or about}", f"{FREE_THE_MACHINE}; {remedy}"
    return Incident(about, remedy, found)


def _flag(flag: Flag) -> tuple[str, str]:
    match flag:
        case Flag.TARGET_CLAMPED:
            about = "the target lies outside the workspace or the arm's reach; the nearest point inside is taken"
            return about, "come nearer, or move the place"
        case Flag.SPEED_LIMITED:
            return "the hands ask for more than the tool's or a joint's limits", "nothing: the tool arrives later"
        case Flag.NEAR_JOINT_LIMIT:
            about = "a joint is close to its position limit; the tool's direction may give way"
            return about, "work from where the arm is less bent"
        case Flag.SEPARATION:
            about = "a hand, the table, a configured box or the arm itself is near; the arm goes slower toward it, "
            about += "or stops"
            remedy = "give it room; `hand_distance_m` and `hand_limit_m_s` in the status say how near and how fast"
            return about, remedy
        case Flag.STUCK:
            about = "the tool has come no nearer to its target for 0.8 s; a way out is looked for"
            return about, "wait, or bring the hands elsewhere"
        case Flag.UNSURE:
            about = "the region that holds the right target 95 times in 100 reaches farther than 10 cm"
            return about, "watch the tool; demonstrate more of what the hands do here"
        case _:
            assert_never(flag)


def _cause(cause: Cause | Literal["malformed"], seen: Evidence) -> Incident:
    came, found = seen.sample or NO_SAMPLE, seen.mistake
    apart_s, turned = (came.stamp_ns - seen.newest_ns) * 1e-9, getattr(came, "orientation", ())
    at = f"at {figures(came.position)} in the tracker's frame" if turned else f"joints at {figures(came.position)}"
    match cause:
        case Cause.NOT_FINITE:
            also = f", orientation {figures(turned)}" if turned else ""
            about, found = "a NaN, an infinity", f"{at}{also}; finite numbers needed"
            remedy = "publish nothing while the tracker has lost the hand, or the driver a joint; "
            remedy += "a joint's velocity may be NaN where it is not measured"
            if (out := seen.outside) is not None:
                found = f"{out.joint} at {out.value:g} {out.unit}; a finite number needed"
        case Cause.NOT_A_ROTATION:
            norm = sum(v * v for v in turned) ** 0.5
            about = "a quaternion that is not of norm 1"
            remedy = "send `0 0 0 1` for an orientation that is not measured"
            found = f"orientation {figures(turned)} of norm {norm:.3g}; norm 1 needed, x y z w"
        case Cause.OUT_OF_RANGE:
            about = "a position no hand or arm can have"
            remedy = "for a tracker in millimetres set `[hands] unit`; joints are in radians, from the URDF's zero"
            if (out := seen.outside) is not None:
                like = ", which looks like degrees" if out.unit == "rad" and abs(out.value) > FULL_TURN_RAD else ""
                found = f"{out.joint} at {out.value:.4g} {out.unit}{like}; {out.low:g} to {out.high:g} accepted"
        case Cause.REPEATED:
            about, remedy = "the same stamp again", "stamp each sample when it was measured, and send it once"
            found = f"stamp {came.stamp_ns * 1e-9:.3f} s again; a newer one with each sample needed"
        case Cause.OLDER:
            about = "a stamp more than 0.1 s before the newest; of the arm, any before it"
            found = f"stamped {-apart_s:.3g} s before the newest accepted one"
            remedy = "stop the second tracker or driver of this key; look for a network that reorders"
        case Cause.AHEAD:
            about = "a stamp farther ahead than the time that has passed: its clock stepped, or samples were held up"
            remedy = "mend the publisher's clock, or see what holds samples up; the status says which of the two; "
            remedy += "accepted again once the source was silent"
            found = f"stamped {apart_s:.3g} s after the newest accepted one"
            if came.stamp_ns and seen.held_up_s is None:
                found += ": its clock stepped ahead"
                remedy = "mend the publisher's clock; it is believed once the source was silent"
            elif came.stamp_ns:
                found += f", which was held up for {seen.held_up_s:.3g} s on its way; the clock is right"
                remedy = "see what holds samples up: the network, or a publisher or daemon that is too busy"
        case Cause.JUMPED:
            about = "a hand or a joint that leapt; a hand is believed after three samples over 20 ms that agree"
            remedy, found = "look for reflections and for a second source", f"{at}, from one sample to the next"
            if (jump := seen.jump) is not None:
                found = f"{jump.joint} from {jump.before:.4g} to {jump.after:.4g} {jump.unit}, "
                found += "from one sample to the next"
        case Cause.SWAPPED:
            about = "a hand where the other one was, and the other where it was; believed after 2 s"
            remedy = "the tracker takes left for right: let it see both hands apart for a moment"
            found = f"{at}, where the other hand was; left and right look exchanged"
        case Cause.WRONG_FRAME:
            about = "a pose in a frame that is neither `base` nor the configured one"
            remedy = "set `[hands] frame` and `base_from_tracker`, or publish in `base`"
            accepted = ", ".join(repr(frame) for frame in seen.frames if frame)
            found = f"frame {came.frame_id[:LONGEST_NAME]!r}; {accepted} or none accepted"
        case Cause.INCOMPLETE:
            about = "joints that are not all there, or named twice"
            remedy = "publish all joints under the names that `joints/command` has, one position each"
        case "malformed":
            about, remedy = "bytes that are no such message", "publish the type and encoding of the wire's table"
        case _:
            assert_never(cause)
    return Incident(about, remedy, found if seen.sample or seen.mistake else "")


def _unseen(seen: Evidence) -> str:
    """Since when which hand is not there, and what of it is rejected instead."""
    said = []
    for side in SIDES:
        if (source := seen.sources.get(side)) is not None and not source.fresh:
            since = "has not been seen yet" if source.age_ms is None else f"was last seen {_time(source.age_ms)} ago"
            if _is_seldom(seen, side, seen.stale_ms):
                since = f"comes {_seldom(source, seen.stale_ms)}"
            instead = f", as what comes is rejected as {source.cause}: {source.refused}" if _is_refused(source) else ""
            said.append(f"the {SOURCE_NAMES[side]} {since}{instead}")
    return "; ".join(said)


def _contest(seen: Evidence) -> str:
    """Whose samples contradict each other, or scatter, and by how much."""
    if not seen.sources:
        return ""
    name, source = max(seen.sources.items(), key=lambda item: item[1].contested)
    what = f"{source.contested:.0%} of what came contradicts the rest"
    if source.contested <= seen.contested:
        name, source = max(seen.sources.items(), key=lambda item: item[1].scatter_mm or 0.0)
        if source.scatter_mm is None:
            return ""
        what = f"what came scatters by {source.scatter_mm:.0f} mm an axis, {seen.scatter_mm:.0f} accepted"
    return f"{SOURCE_NAMES[name]}, {'in the last second' if source.rate_hz else 'before it ended'}: {what}"


def _contradiction(arm: Source | None, accepted: float) -> str:
    """How the arm's states of the last second contradict each other; empty where they do not."""
    if arm is None:
        return ""
    if arm.contested > accepted:
        return f"{arm.contested:.0%} of the arm's states in the last second contradict the rest"
    return f"states of the arm were rejected as jumped: {arm.refused}" if arm.cause == word(Cause.JUMPED) else ""


def _is_seldom(seen: Evidence, name: str, most_ms: float) -> bool:
    """True if samples of a source still arrive, but at longer intervals than accepted."""
    source = seen.sources.get(name)
    if source is None or source.age_ms is None or _is_refused(source):
        return False
    goes_on = source.age_ms * source.rate_hz < 2000.0  # the next one is not overdue by a whole interval
    return goes_on and 0.0 < source.rate_hz * most_ms < 1000.0


def _seldom(source: Source, most_ms: float) -> str:
    """The rate of a source that is too low, and the lowest one that is accepted."""
    return f"at {source.rate_hz:.1f} Hz, {1000 / most_ms:g} Hz at least needed"


def _of_rate(seen: Evidence) -> str:
    """Remedy for states that arrive too seldom; empty if they do not."""
    is_seldom = _is_seldom(seen, "arm", seen.silent_ms)
    return "publish `joints/state` more often, or raise `[arm] silent_ms`" if is_seldom else ""


def _silence(seen: Evidence) -> str:
    """For how long the arm says nothing, or that it does so too seldom; empty where it does."""
    source = seen.sources.get("arm")
    if source is not None and _is_seldom(seen, "arm", seen.silent_ms):
        return f"joint states come {_seldom(source, seen.silent_ms)}"
    if source is None or source.fresh:
        return ""
    return "no joint states came yet" if source.age_ms is None else f"no joint states for {_time(source.age_ms)}"


def _not_ready(seen: Evidence) -> str:
    """What the arm lacks."""
    source, out = seen.sources.get("arm"), seen.outside
    if source is None:
        return ""
    if _is_refused(source):
        return f"what comes of the arm is rejected as {source.cause}: {source.refused}"
    at = "the arm has not told one posture for long enough"
    if out is not None:
        at = f"{out.joint} at {out.value:.3f} {out.unit} is outside {out.low:g} to {out.high:g}, and is moved back"
    elif seen.inside is not None:
        at = "what {} moves is inside of {} by {:.3f} m".format(*seen.inside)
    return _silence(seen) or at


def _stuck(seen: Stuck | None) -> str:
    """What is known of a tool that is stuck."""
    if seen is None:
        return ""
    ends = f"{', '.join(seen.at_limits)} at the end of its way" if seen.at_limits else "it cannot come nearer"
    way = f"on its way out, posture {seen.posture} of {seen.postures}" if seen.posture else "no way out is known yet"
    return f"the tool is {seen.off_m:.2f} m off its target: {ends}; {way}"


def _is_refused(source: Source) -> bool:
    """Whether something comes of a source, and nothing of it is accepted."""
    return source.rate_hz > 0 and not source.fresh and bool(source.cause)


def _of_rejected(seen: Evidence, *needed: str) -> str:
    """What to do about the first needed source whose samples are all rejected."""
    refused = (source for name in needed if (source := seen.sources.get(name)) is not None and _is_refused(source))
    return next((source.advice or BY_WORD[source.cause].remedy for source in refused), "")


def _time(duration_ms: float) -> str:
    return f"{duration_ms:.0f} ms" if duration_ms < 1000 else f"{duration_ms / 1000:.1f} s"


def figures(values: Sequence[float]) -> str:
    """Numbers for people: (980, -320, 60)."""
    return f"({', '.join(f'{v:.4g}' for v in values)})"


BY_WORD = {word(member): explained(member) for member in (*Reason, *Flag, *Cause, MALFORMED)}


def remedy(named: str) -> str:
    """What to do about a reason, a flag or a cause by its word; empty for any other."""
    return BY_WORD[named].what_to_do if named in BY_WORD else ""


def in_brief(mode: str, reason: str) -> str:
    """Mode and reason as one term."""
    return f"{mode} ({reason})" if reason else mode


def in_full(why: str, what_to_do: str) -> str:
    """What follows that term: the reason in words, and what to do; empty where there is none."""
    return (f": {why}" if why else "") + (f". What to do: {what_to_do}" if what_to_do else "")
