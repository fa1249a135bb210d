"""What each word of a status means and what to do about it: the one table of modes, reasons, flags
and causes of rejection.

`status`, `doctor`, the daemon's log and docs/incidents.md all take their words from here.
"""

from __future__ import annotations

from typing import NamedTuple

SOURCE_NAMES = {"left": "left hand", "right": "right hand", "arm": "arm"}


class Incident(NamedTuple):
    """One word of a status: what happened, and what to do."""

    about: str
    remedy: str


MODES = {
    "follow": Incident("follows the hands", "with any reason below"),
    "hold": Incident(
        "has come to rest, or is on its way there, within its limits",
        "by itself once the reason is gone; after `hold` by `thirdhand resume`",
    ),
    "fault": Incident(
        "has come to rest; commands are no longer sent", "by `thirdhand reset`, once the cause is mended"
    ),
}  # what the arm does; and how the mode ends

HOLDS = {
    "no_hands": Incident(
        "a hand has not been seen since the start",
        "start the tracker; `hand_age_ms` in the status names the hands that are there",
    ),
    "stale_hand": Incident(
        "no accepted sample of a hand for 100 ms",
        "look at the tracker; growing counters under `rejected` mean that samples come and are refused",
    ),
    "far_from_demonstrations": Incident(
        "the skill is not sure where the tool belongs with the hands as they are",
        "bring the hands back to where it was demonstrated, or demonstrate this too",
    ),
    "two_sources": Incident(
        "a quarter of what came in the last second says that a hand, or the arm, is somewhere else; or a hand's "
        "samples scatter by more than 12 mm",
        "two trackers or drivers publish under one key: stop one; `rejected` counts `older` and `jumped` meanwhile",
    ),
    "operator": Incident("somebody asked for it", "`thirdhand resume`"),
    "arm_not_ready": Incident(
        "the arm has not told where it is",
        "start the arm's driver; `joints/state` must name the joints as `joints/command` does",
    ),
}
FAULTS = {
    "arm_error": Incident(
        "the arm was measured farther from where it was told to be than `[arm] fault_error_rad`",
        "see what blocked or pushed it, then `thirdhand reset`",
    ),
    "arm_silent": Incident(
        "the arm told nothing for 100 ms while it was to move",
        "look at its driver and the network, then `thirdhand reset`",
    ),
    "tool_speed": Incident(
        "the tool was measured faster than `[tool] fault_speed` for 30 ms",
        "the arm does not do what it is told: check the driver before `thirdhand reset`",
    ),
    "setpoint": Incident("a bound of the setpoint was passed, which cannot happen", "keep the recording and report it"),
    "service": Incident(
        "a thread or the loop of the service failed; it is begun anew, and the log says which and why",
        "keep log and recording, report it, then `thirdhand reset`",
    ),
}
REASONS = HOLDS | FAULTS

FLAGS = {
    "target_clamped": Incident(
        "the target lies outside the workspace or the arm's reach; the nearest point inside is taken",
        "come nearer, or move the place",
    ),
    "speed_limited": Incident(
        "the hands ask for more than the tool's or a joint's limits", "nothing: the tool arrives later"
    ),
    "near_joint_limit": Incident(
        "a joint is close to its position limit; the tool's direction may give way",
        "work from where the arm is less bent",
    ),
    "separation": Incident(
        "a hand, the table, a configured box or the arm itself is near; the arm goes slower toward it, or stops",
        "give it room; `hand_distance_m` and `hand_limit_m_s` in the status say how near and how fast",
    ),
}

MALFORMED = "malformed"
REJECTIONS = {
    "not_finite": Incident(
        "a NaN, an infinity", "publish nothing while the tracker has lost the hand, or the driver a joint"
    ),
    "not_a_rotation": Incident(
        "a quaternion that is not of norm 1", "send `0 0 0 1` for an orientation that is not measured"
    ),
    "out_of_range": Incident(
        "a position no hand or arm can have",
        "for a tracker in millimetres set `[hands] unit`; joints are in radians, from the URDF's zero",
    ),
    "repeated": Incident("the same stamp again", "stamp each sample when it was measured, and send it once"),
    "older": Incident(
        "a stamp before the newest", "stop the second tracker or driver of this key; look for a network that reorders"
    ),
    "ahead": Incident(
        "a stamp farther ahead than the time that has passed",
        "mend the publisher's clock; it is believed once the source was silent",
    ),
    "jumped": Incident(
        "a hand or a joint that leapt; a hand is believed after three samples over 20 ms that agree",
        "look for reflections and for a second source",
    ),
    "swapped": Incident(
        "a hand where the other one was, and the other where it was; believed after 2 s",
        "the tracker takes left for right: let it see both hands apart for a moment",
    ),
    "wrong_frame": Incident(
        "a pose in a frame that is neither `base` nor the configured one",
        "set `[hands] frame` and `base_from_tracker`, or publish in `base`",
    ),
    "incomplete": Incident(
        "joints that are not all there",
        "publish all joints under the names that `joints/command` has, one position each",
    ),
    MALFORMED: Incident("bytes that are no such message", "publish the type and encoding of the wire's table"),
}  # what came; under `malformed KEY` the last one in the status

EVERY = MODES | REASONS | FLAGS | REJECTIONS


def in_brief(mode: str, reason: str) -> str:
    """Mode and reason as one term."""
    return f"{mode} ({reason})" if reason else mode


def in_full(because: str, remedy: str) -> str:
    """What follows that term: the reason in words, and what to do; empty where there is none."""
    return (f": {because}" if because else "") + (f". What to do: {remedy}" if remedy else "")


def remedy(word: str) -> str:
    """What to do about a word of a status, for people; empty where nothing needs to be done."""
    return EVERY[word].remedy.replace("`", "") if word in EVERY and word not in MODES else ""
