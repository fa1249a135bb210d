"""The table of incidents: each with its title, what happened, and what to do.

Status, log, `doctor`, viewer, report, live page and docs/incidents.md take their words from here;
`evidence.py` adds the figures of the moment. A new reason to hold is a member in `records.py`, a
row here, and the stage that decides it.
"""

from __future__ import annotations

import enum
import re
from collections.abc import Mapping
from typing import Any, NamedTuple, TypeAlias

from thirdhand.contract.records import Cause, Flag, Mode, Reason

SOURCE_NAMES = {"left": "left hand", "right": "right hand", "arm": "arm", "wish": "wish"}
ORDERS = {
    "hold": "the operator stopped the arm, which holds until it is resumed",
    "resume": "the operator ended the hold",
    "reset": "the operator ended the fault",
}
THEN_RESET = "; then thirdhand reset"
_SETTING = re.compile(r"\{(\w+)\.(\w+) (\S+)\}")


# Incidents that are no reason, flag or cause: findings of `doctor`, and closer causes of others.
Condition = enum.StrEnum(
    "Condition",
    "MALFORMED FROZEN OTHER_PUBLISHER CLOCK_STEPPED DELAYED HANDS_TOO_RARE JOINTS_TOO_RARE "
    "ARM_UNSETTLED ARM_INSIDE TWO_DRIVERS MACHINE_BUSY HAND_SILENT JOINTS_SILENT KEY_MISSPELT "
    "RATE_LOW WRONG_UNIT DEGREES Y_UP HANDS_EXCHANGED HAND_ELSEWHERE ARM_LATE NO_DRIVER "
    "DRIVES_OFF OFF_TARGET CLOCKS_DIFFER NO_REAL_TIME NOT_LOCKED NOT_RECORDED TICKS_LOST "
    "DISK_SHORT STARTING VERSIONS_DIFFER NO_DAEMON NO_ANSWER OTHER_CELL PORT_CLOSED NO_WAY "
    "PORT_FOREIGN NO_ARM CALIBRATION_OFF LIMIT_BINDS HUMBLE NOISY CLOCK_SET",
)


class Incident(NamedTuple):
    """One row of the table. In `what_happened`, `{hands.stale_ms ms}` is that setting of the cell,
    with its unit; parts between backticks are names.
    """

    member: Member
    mode: Mode | None  # of the arm meanwhile; None: it does not follow from the incident
    title: str
    what_happened: str
    what_to_do: str


Member: TypeAlias = Mode | Reason | Flag | Cause | Condition


# They are sorted by what a person notices, as in docs/incidents.md.
INCIDENTS: Mapping[str, tuple[Incident, ...]] = {
    "The mode of the arm": (
        Incident(
            Mode.FOLLOW,
            None,
            "follow",
            "the arm follows the hands",
            "nothing; it ends with any reason below",
        ),
        Incident(
            Mode.HOLD,
            None,
            "hold",
            "the arm brakes within its limits, then rests; with `blocked` or `arm_not_ready` it "
            "may move slowly by itself, past what blocks it or back within its limits",
            "nothing; it ends by itself when its reason has ended, or after `hold` by `thirdhand "
            "resume`",
        ),
        Incident(
            Mode.FAULT,
            None,
            "fault",
            "the arm rests; no commands are sent",
            "remove the cause, then end it by `thirdhand reset`",
        ),
    ),
    "The arm does not begin to move": (
        Incident(
            Reason.NO_HANDS,
            Mode.HOLD,
            "no hands yet",
            "a hand has not been seen since the start",
            "start the tracker; `hand_age_ms` in the status names the hands that have been seen",
        ),
        Incident(
            Reason.NO_WISH,
            Mode.HOLD,
            "no wish yet",
            "no wish has come on tool/wish since the start",
            "start the policy, connected to the daemon; `rejected` counts what is not taken",
        ),
        Incident(
            Reason.OPERATOR,
            Mode.HOLD,
            "operator request",
            "an operator requested a hold, or the daemon was stopped",
            "`thirdhand resume`",
        ),
        Incident(
            Reason.CLUTCH,
            Mode.HOLD,
            "clutch released",
            "the clutch of `[hands] clutch` is not pressed, or was not heard for "
            "{hands.clutch_stale_ms ms}",
            "press the clutch and hold it; it must be published again and again, at 10 Hz or more",
        ),
        Incident(
            Reason.GUIDED,
            Mode.HOLD,
            "arm led by hand",
            "the arm's driver reports that somebody leads the arm by hand; this is an operator's "
            "hold",
            "lead the tool to where it belongs and run `thirdhand correct`; or end guiding, then "
            "`thirdhand resume`",
        ),
        Incident(
            Reason.ARM_NOT_READY,
            Mode.HOLD,
            "arm not ready",
            "the arm does not report its joints, does not rest within its limits, or is inside of "
            "something",
            "start the arm's driver; `joints/state` must use the joint names of `joints/command`",
        ),
        Incident(
            Condition.ARM_UNSETTLED,
            None,
            "arm not settled",
            "the arm reports its joints, but moves, or is outside its limits",
            "wait: the service begins by itself once the arm has rested within its limits "
            "for 0.1 s",
        ),
        Incident(
            Condition.ARM_INSIDE,
            None,
            "arm inside of something",
            "a part of the arm is inside of the table, of a box or of another part",
            "move the arm out by hand, or by `thirdhand reset`, which moves it out slowly; if "
            "nothing is there, correct the URDF, `[table]` and `[obstacles]`",
        ),
        Incident(
            Condition.HAND_SILENT,
            None,
            "no hand arrives",
            "no messages of a hand arrive",
            "start the tracker, connected to the daemon",
        ),
        Incident(
            Condition.JOINTS_SILENT,
            None,
            "no joint states arrive",
            "no messages of the arm arrive",
            "start the driver, connected to the daemon",
        ),
        Incident(
            Condition.KEY_MISSPELT,
            None,
            "another key",
            "messages arrive under a key that is not the cell's",
            "let it publish under the cell's key",
        ),
        Incident(
            Condition.HUMBLE,
            None,
            "ROS 2 Humble",
            "a node of ROS 2 Humble publishes under keys without the hash of the type, which no "
            "cell hears",
            "run the node with ROS 2 Iron or later, or connect it by zenoh-bridge-ros2dds",
        ),
        Incident(
            Condition.NO_DRIVER,
            None,
            "no driver",
            "nobody subscribes to `joints/command`",
            "let the arm's driver subscribe to `joints/command`",
        ),
        Incident(
            Condition.DRIVES_OFF,
            None,
            "drives off",
            "a joint has not moved since commands began",
            "are the drives on? Check their power, brakes and emergency stop; then `thirdhand "
            "reset`",
        ),
        Incident(
            Condition.ARM_LATE,
            None,
            "arm late",
            "the arm follows its commands late",
            "let the arm's driver lead by the lag: set lag_s of its class, or `thirdhand follow "
            "--lag`; then measure again",
        ),
        Incident(
            Condition.NO_ARM,
            None,
            "arm assumed",
            "the daemon assumes the arm's posture, and measures nothing",
            "with an arm, start the daemon with `--joints state`",
        ),
    ),
    "The arm stops now and then, and continues by itself": (
        Incident(
            Reason.STALE_HAND,
            Mode.HOLD,
            "hand out of sight",
            "no sample of the hands was accepted for {hands.stale_ms ms}, or up to `[hands] "
            "stale_max_ms` if they arrive in bursts; one hand alone, where the target does not "
            "depend on it, may be missing for {hands.unseen_ms ms}",
            "look at the tracker; if a counter under `rejected` grows, samples arrive but are "
            "rejected; a hand that the skill does not need is waited for only 5 s",
        ),
        Incident(
            Reason.FAR_FROM_DEMONSTRATIONS,
            Mode.HOLD,
            "hands far from the demonstrations",
            "the hands are farther from the demonstrations than the skill accepts",
            "move the hands back to where the task was demonstrated, or demonstrate this too",
        ),
        Incident(
            Reason.STALE_WISH,
            Mode.HOLD,
            "policy silent",
            "no wish is due, and none came for {skill.silent_ms ms}",
            "let the policy answer sooner, or in longer chunks; the arm goes on with its next wish",
        ),
        Incident(
            Reason.JUMPED_WISH,
            Mode.HOLD,
            "wish jumped",
            "a wish was more than 0.25 m from the ones before it, in the last 0.5 s",
            "wait: the tool then moves there slowly; if it goes on, look for two policies in one "
            "program, or for mixed frames and units",
        ),
        Incident(
            Reason.UNREACHABLE_WISH,
            Mode.HOLD,
            "wish out of reach",
            "the wished pose is outside of `[reach]`",
            "wish for poses within the arm's reach; the arm goes on with the first of them",
        ),
        Incident(
            Reason.TWO_SOURCES,
            Mode.HOLD,
            "two sources contradict each other",
            "a quarter of the last second's joint states report the arm in another posture",
            "two drivers may publish under one key: stop one; `rejected` counts `older` and "
            "`jumped` meanwhile",
        ),
        Incident(
            Reason.BLOCKED,
            Mode.HOLD,
            "tool blocked",
            "joint limits or things around the arm keep the tool from its target",
            "wait while the arm looks for a way out and takes it; if that does not lead to the "
            "target, move the hands: it tries again with another target",
        ),
        Incident(
            Reason.AMBIGUOUS,
            Mode.HOLD,
            "segment of the task unclear",
            "the hands fit two segments of the task, with the tool at different positions",
            "continue, as the hands will show which segment it is; or name it by `thirdhand "
            "segment NAME`",
        ),
        Incident(
            Condition.HANDS_TOO_RARE,
            None,
            "hands arrive too rarely",
            "more than {hands.stale_ms ms}, or `[hands] stale_max_ms` if longer, pass between "
            "samples of a hand",
            "publish hands more often, or raise `[hands] stale_ms`; or `[hands] stale_max_ms` if "
            "they come in bursts",
        ),
        Incident(
            Condition.JOINTS_TOO_RARE,
            None,
            "joint states arrive too rarely",
            "more than {arm.silent_ms ms} pass between joint states",
            "publish `joints/state` more often, or raise `[arm] silent_ms`",
        ),
    ),
    "The arm has stopped, and waits for a reset": (
        Incident(
            Reason.ARM_ERROR,
            Mode.FAULT,
            "arm not where commanded",
            "a joint was measured more than {arm.fault_error_rad rad} from its command",
            "find what blocked or pushed the arm, and whether its drives are on; then `thirdhand "
            "reset`",
        ),
        Incident(
            Reason.ARM_SILENT,
            Mode.FAULT,
            "arm silent",
            "no joint states arrived for {arm.silent_ms ms} while the arm followed or moved",
            "check the arm's driver and the network; then `thirdhand reset`",
        ),
        Incident(
            Reason.TOOL_SPEED,
            Mode.FAULT,
            "tool too fast",
            "the tool was measured faster than {tool.fault_speed m/s} for 30 ms",
            "check the driver, because the arm does not follow its commands; "
            "then `thirdhand reset`",
        ),
        Incident(
            Reason.SETPOINT,
            Mode.FAULT,
            "setpoint out of bounds",
            "the setpoint passed one of its own bounds: this is a defect of the service",
            "keep the recording and report it; then `thirdhand reset`",
        ),
        Incident(
            Reason.SERVICE,
            Mode.FAULT,
            "service failed",
            "a thread or the loop of the service failed and was started again; the log names it",
            "keep the log and the recording, and report it; then `thirdhand reset`",
        ),
        Incident(
            Condition.TWO_DRIVERS,
            None,
            "two drivers",
            "joint states contradict each other",
            "check whether two drivers publish `joints/state`, and stop one",
        ),
    ),
    "The arm is slow, or the tool is not where it should be": (
        Incident(
            Flag.TARGET_CLAMPED,
            Mode.FOLLOW,
            "target out of reach",
            "the target lies outside the workspace or the arm's reach; the tool moves to the "
            "nearest point inside",
            "move the hands nearer to the arm, or teach the via-point elsewhere",
        ),
        Incident(
            Flag.ENGAGING,
            Mode.FOLLOW,
            "engaging",
            "following has just begun: the tool moves at {tool.engage_speed m/s} at most until it "
            "is within 2 cm of its target",
            "wait; if the tool does not catch up with the hands, hold them still for a moment",
        ),
        Incident(
            Flag.SPEED_LIMITED,
            Mode.FOLLOW,
            "at a speed limit",
            "the hands require more than the limits of the tool or a joint",
            "nothing: the tool arrives later",
        ),
        Incident(
            Condition.LIMIT_BINDS,
            None,
            "one limit binds",
            "one limit of a joint or of the tool keeps the tool from following faster",
            "move the task to where the arm is faster, or choose another `[arm] posture`; raise "
            "that limit in the cell's settings only if the arm's data sheet and the task allow "
            "more",
        ),
        Incident(
            Flag.NEAR_JOINT_LIMIT,
            Mode.FOLLOW,
            "near a joint limit",
            "a joint is close to its position limit; the tool may deviate from its direction",
            "work where this joint is farther from its limit",
        ),
        Incident(
            Flag.SEPARATION,
            Mode.FOLLOW,
            "something is near",
            "a hand, the table, a configured box or the arm itself is near; the arm slows down "
            "toward it, or stops",
            "give it room; `hand_distance_m` and `hand_limit_m_s` in the status are distance and "
            "allowed speed",
        ),
        Incident(
            Flag.STUCK,
            Mode.FOLLOW,
            "tool stuck",
            "the tool has come no nearer to its target for 0.8 s; the arm looks for a way out",
            "wait, or move the hands elsewhere",
        ),
        Incident(
            Flag.UNSURE,
            Mode.FOLLOW,
            "target uncertain",
            "the probability that the tool belongs more than 10 cm from its target is above the "
            "skill's alarm; for a skill without an alarm: the region that contains the right "
            "target in 95 of 100 cases extends more than 10 cm from the predicted one",
            "watch the tool; demonstrate more of what the hands do here",
        ),
        Incident(
            Condition.OFF_TARGET,
            None,
            "tool off its target",
            "the tool has been more than 5 cm from its target for some time",
            "check that the arm's driver follows commands, and as fast",
        ),
        Incident(
            Condition.NOISY,
            None,
            "hand noisy",
            "the samples of a hand scatter by more than those of a tracker that sees it well",
            "look at what the tracker sees: light, reflections, distance; a second tracker that "
            "does not name itself may publish this hand, too",
        ),
        Incident(
            Condition.Y_UP,
            None,
            "tracker's axes",
            "y of the tracker seems to point up; in frame `base`, z does",
            "turn the tracker's frame by `base_from_tracker` under [hands]",
        ),
        Incident(
            Condition.CALIBRATION_OFF,
            None,
            "calibration off",
            "a hand is measured where no hand can be, below the table top",
            "the tracker has moved, or its pose is wrong: `thirdhand calibrate --check` measures "
            "by how much, `thirdhand calibrate` finds the pose; check the height of `[table]` too",
        ),
        Incident(
            Condition.HANDS_EXCHANGED,
            None,
            "hands exchanged",
            "each hand is where the skill knows the other one",
            "left and right look swapped: publish each hand under the other's key",
        ),
        Incident(
            Condition.HAND_ELSEWHERE,
            None,
            "hand elsewhere",
            "a hand is far from where the task was demonstrated",
            "move the hand there, or demonstrate this too; check `[hands] unit` and "
            "`base_from_tracker`, by `thirdhand calibrate --check`",
        ),
    ),
    "A hand or the arm's joint states are rejected": (
        Incident(
            Cause.NOT_FINITE,
            None,
            "not finite",
            "a NaN or an infinity",
            "publish nothing while the tracker has lost the hand, or the driver a joint; only the "
            "velocity of a joint may be NaN, where it is not measured",
        ),
        Incident(
            Cause.NOT_A_ROTATION,
            None,
            "no rotation",
            "a quaternion whose norm is not 1",
            "send `0 0 0 1` for an orientation that is not measured",
        ),
        Incident(
            Cause.OUT_OF_RANGE,
            None,
            "out of range",
            "a position that no hand or arm can have",
            "set `[hands] unit` for a tracker in millimetres; publish joints in radians, from the "
            "URDF's zero",
        ),
        Incident(
            Cause.REPEATED,
            None,
            "stamp repeated",
            "the same stamp again",
            "stamp each sample when it was measured, and send it once",
        ),
        Incident(
            Cause.OLDER,
            None,
            "stamp older",
            "a stamp more than 0.1 s before the newest one; of the arm, any before it",
            "correct the publisher's clock, if it was set back; stop a second tracker or driver of "
            "this key; look for a network that reorders messages",
        ),
        Incident(
            Cause.INCOMPLETE,
            None,
            "joints incomplete",
            "joints that are missing, or named twice",
            "publish every joint once, under the names in `joints/command`, with one position each",
        ),
        Incident(
            Cause.AHEAD,
            None,
            "stamp ahead",
            "a stamp that advanced more than the time that has passed: the source's clock stepped, "
            "or samples were delayed",
            "correct the publisher's clock, or find what delays samples; the status says which of "
            "the two; samples are accepted again after the source was silent",
        ),
        Incident(
            Cause.JUMPED,
            None,
            "jumped",
            "a hand or a joint that is suddenly elsewhere; a hand is accepted there after three "
            "samples over 50 ms that agree",
            "look for reflections, and for a second tracker that does not name itself",
        ),
        Incident(
            Cause.WRONG_FRAME,
            None,
            "wrong frame",
            "a pose in a frame that is neither `base` nor one of `[hands] frame` and "
            "`[trackers.NAME]`",
            "find `[hands] frame` and `base_from_tracker` by `thirdhand calibrate`, also after the "
            "tracker was recentred, which changes its frame; or publish in `base`",
        ),
        Incident(
            Condition.MALFORMED,
            None,
            "malformed",
            "bytes that are not the message of their key; they are counted by key",
            "publish the type and encoding that docs/wire.md lists for the key",
        ),
        Incident(
            Condition.OTHER_PUBLISHER,
            None,
            "other publisher",
            "samples of a second publisher of this hand; those of the first one count, until it is "
            "silent for 0.5 s",
            "stop one of the two trackers: both publish under this key",
        ),
        Incident(
            Condition.FROZEN,
            None,
            "hand frozen",
            "the pose of a hand was the same, bit for bit, for 0.5 s while its stamps went on: its "
            "tracker has lost it",
            "bring the hand into the tracker's view; it is accepted again as soon as its pose "
            "changes",
        ),
        Incident(
            Condition.CLOCK_STEPPED,
            None,
            "clock stepped",
            "the source's clock was set, ahead or back",
            "correct the publisher's clock; samples are accepted again after the source was silent",
        ),
        Incident(
            Condition.DELAYED,
            None,
            "samples delayed",
            "samples were held up on their way; the source's clock is right",
            "if they arrive in batches, as over Wi-Fi that saves power, raise `[hands] "
            "stale_max_ms` above their interval; otherwise find what holds them up: the network, "
            "or a publisher or daemon that is too busy",
        ),
        Incident(
            Condition.WRONG_UNIT,
            None,
            "wrong unit",
            "positions look to be in another unit than `[hands] unit`",
            "write the tracker's unit under `[hands]` in the cell's settings, and restart the "
            "daemon",
        ),
        Incident(
            Condition.DEGREES,
            None,
            "joints in degrees",
            "joint positions look to be in degrees",
            "publish joints in radians",
        ),
    ),
    "The machine is late, or clocks differ": (
        Incident(
            Condition.RATE_LOW,
            None,
            "low rate",
            "a source publishes less often than its key requires",
            "publish as often as required, and without pauses",
        ),
        Incident(
            Condition.MACHINE_BUSY,
            None,
            "machine too busy",
            "the machine is too busy for real-time work",
            "see what else runs on this machine (`thirdhand bench` measures it), "
            "or lower `rate_hz`",
        ),
        Incident(
            Condition.NO_REAL_TIME,
            None,
            "no real time",
            "the daemon does not run at real-time priority",
            "raise its rtprio limit, as docs/hardware.md says",
        ),
        Incident(
            Condition.NOT_LOCKED,
            None,
            "memory not locked",
            "the daemon's memory may be paged out",
            "raise its memlock limit, as docs/hardware.md says",
        ),
        Incident(
            Condition.CLOCKS_DIFFER,
            None,
            "clocks differ",
            "a clock differs from the daemon's: no latency can be measured",
            "synchronise the clocks (chrony, PTP), or let the source stamp samples when it sends "
            "them",
        ),
        Incident(
            Condition.CLOCK_SET,
            None,
            "clock set",
            "the clock of the daemon's machine was set, or the machine was suspended; the loop is "
            "not affected",
            "let NTP slew the clock instead of setting it; if it was set back by more than an "
            "hour, start the daemon again, as the stamps of its commands hardly grow until the "
            "clock has passed them",
        ),
    ),
    "The recording lacks something": (
        Incident(
            Condition.NOT_RECORDED,
            None,
            "nothing is recorded",
            "the daemon was started without a recording",
            "`thirdhand serve --record DIR`",
        ),
        Incident(
            Condition.TICKS_LOST,
            None,
            "ticks lost",
            "ticks are missing in the recording, or it was interrupted",
            "check that the folder exists and its disk has room; `thirdhand replay` lists what is "
            "missing",
        ),
        Incident(
            Condition.DISK_SHORT,
            None,
            "disk almost full",
            "the disk has little room for recordings",
            "free space, or lower `keep_mb` under [files]",
        ),
    ),
    "A command reaches no daemon": (
        Incident(
            Condition.STARTING,
            None,
            "starting",
            "the daemon is starting, and has decided nothing yet",
            "wait: it begins once skill, arm and recorder are ready",
        ),
        Incident(
            Condition.VERSIONS_DIFFER,
            None,
            "versions differ",
            "the daemon has another version than this command",
            "update the older one",
        ),
        Incident(
            Condition.NO_DAEMON,
            None,
            "no daemon",
            "no daemon of the cell answers",
            "start `thirdhand serve`; with certificates, use an operator's or an observer's",
        ),
        Incident(
            Condition.NO_ANSWER,
            None,
            "no answer",
            "the cell's daemon is running, but does not answer",
            "ask again; if it still does not answer, read the log of `thirdhand serve`",
        ),
        Incident(
            Condition.OTHER_CELL,
            None,
            "another cell",
            "only daemons of other cells are running",
            "give the name of the cell by `--cell`",
        ),
        Incident(
            Condition.PORT_CLOSED,
            None,
            "port closed",
            "nothing listens on the port",
            "start `thirdhand serve`; its first line names the endpoint to give as `--connect`",
        ),
        Incident(
            Condition.NO_WAY,
            None,
            "host unreachable",
            "the host cannot be reached",
            "check the address, the network and its firewall",
        ),
        Incident(
            Condition.PORT_FOREIGN,
            None,
            "no Zenoh session",
            "something listens on the port, but opens no Zenoh session",
            "for an endpoint tls/..., give your certificate by $THIRDHAND_CERTIFICATE; or wait, if "
            "the daemon is overloaded; or choose another `--listen`, if another program has the "
            "port",
        ),
    ),
}


def word(member: Member) -> str:
    """The word for a member in statuses and recordings; empty for no reason."""
    return "" if member is Reason.NONE else str(member.name).lower()


MALFORMED = word(Condition.MALFORMED)
FROZEN = word(Condition.FROZEN)
OTHER_PUBLISHER = word(Condition.OTHER_PUBLISHER)
BY_WORD = {word(row.member): row for rows in INCIDENTS.values() for row in rows}
if missing := {
    word(member) for kind in (Mode, Reason, Flag, Cause, Condition) for member in kind
} - {"", *BY_WORD}:
    raise NotImplementedError(f"no incident is described for {', '.join(sorted(missing))}")


def input_name(key: str) -> str:
    """The name of a hand or of the arm for people; of any other input, its key."""
    return SOURCE_NAMES.get(key, key)


def title(named: str) -> str:
    """The title of what a word stands for; empty for any other word."""
    return BY_WORD[named].title if named in BY_WORD else ""


def filled(text: str, settings: Any = None) -> str:
    """A text of the table with the values of the cell's settings; without settings, with their
    names.
    """

    def value(found: re.Match[str]) -> str:
        section, name, unit = found.groups()
        if settings is None:
            return f"`[{section}] {name}`"
        return f"{getattr(getattr(settings, section), name):g} {unit} (`[{section}] {name}`)"

    return _SETTING.sub(value, text)


def what_happened(named: str, settings: Any = None) -> str:
    """What happened, as a word of a status says, for people; empty for any other word."""
    return plain(filled(BY_WORD[named].what_happened, settings)) if named in BY_WORD else ""


def what_to_do(named: str) -> str:
    """What to do about what a word stands for; empty for any other word."""
    return plain(BY_WORD[named].what_to_do) if named in BY_WORD else ""


def plain(text: str) -> str:
    """A text of the table without backticks."""
    return text.replace("`", "")


def in_brief(mode: str, reason: str) -> str:
    """Mode and reason as one term."""
    return f"{mode} ({reason})" if reason else mode


def in_full(why: str, remedy: str) -> str:
    """The text behind that term: why, and what to do; empty without them."""
    return (f": {why}" if why else "") + (f". What to do: {remedy}" if remedy else "")
