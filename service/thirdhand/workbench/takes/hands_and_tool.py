"""The choice of the streams of hands and tool among the topics of a recording."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import NamedTuple, get_args

from thirdhand.contract.channels import JOINTS, POSE, TAKE_KEYS
from thirdhand.contract.requests import Hands
from thirdhand.recordings.mcap_file import RecordingError
from thirdhand.settings.config import Settings, robot_description
from thirdhand.workbench.takes.pose_streams import (
    JOINT_STATES,
    POSE_ARRAY,
    POSE_TYPES,
    TRACK_NAMES,
    PoseRecording,
    PoseTopic,
    other_type,
    with_types,
)
from thirdhand.workbench.takes.track import Track

HAND_WORDS = {"hand", "hands", "wrist", "palm", "glove"}
TRACK_WORDS = {
    "left": {"left"},
    "right": {"right"},
    "tool": {"tool", "tcp", "gripper", "effector", "flange"},
}


class HandsAndTool(NamedTuple):
    """The tracks of left hand, right hand and tool, the hands that lead the tool, and remarks on
    guesses. The track of a hand that leads alone stands in `tracks` twice, for both hands.
    """

    tracks: list[Track]
    conducts: Hands
    guessed: list[str]


def chosen(
    recorded: PoseRecording, given: Mapping[str, PoseTopic], settings: Settings
) -> HandsAndTool:
    """The tracks of hands and tool in a recording.

    A topic is `given`, or found by the end of its name, or by a word in its name; the tool may also
    be computed from joint states. If only one hand is found, it leads alone. Raises RecordingError.
    """
    guessed: list[str] = []
    sources = _hands(recorded, given, guessed)
    conducts = recorded.conducts
    if len(sources) == 1:
        (conducts,) = (name for name in get_args(Hands) if name in sources)
        other = TRACK_NAMES[1 - TRACK_NAMES.index(conducts)]
        if remark := other_type(recorded.topics, TAKE_KEYS[other], POSE_TYPES):
            raise RecordingError(f"{recorded.path}: the {other} hand is {remark}")
        hint = (
            ""
            if conducts == recorded.conducts
            else f": there is no other (--{other} TOPIC names one)"
        )
        guessed.append(f"the {conducts} hand leads alone{hint}")
    hands = [recorded.track(TAKE_KEYS[name], source, settings) for name, source in sources.items()]
    tool = _tool(recorded, given, settings, guessed)
    return HandsAndTool([hands[0], hands[-1], tool], conducts, guessed)


def _hands(
    recorded: PoseRecording, given: Mapping[str, PoseTopic], guessed: list[str]
) -> dict[str, PoseTopic]:
    """The streams of the hands that lead the tool, by side; remarks on guesses are appended to
    `guessed`. Raises RecordingError without any.
    """
    conducts = recorded.conducts
    sources: dict[str, PoseTopic] = {}
    for name in TRACK_NAMES[:2] if conducts == "both" else (conducts,):
        source = _named(recorded, name, given)
        if source is None and (source := _by_words(recorded, name)):
            guessed.append(f"{name} is {source}")
        if source is not None:
            sources[name] = source
    if not sources:
        raise _not_found(recorded, conducts.replace("both", "left"), [])
    if len(set(sources.values())) < len(sources):
        return _side_of_the_one(recorded, sources["left"])
    return sources


def _named(recorded: PoseRecording, name: str, given: Mapping[str, PoseTopic]) -> PoseTopic | None:
    """The stream that is `given`, or else the one whose name ends like the service's own topic."""
    return _given(recorded, name, given[name]) if name in given else by_ending(recorded, name)


def _side_of_the_one(recorded: PoseRecording, source: PoseTopic) -> dict[str, PoseTopic]:
    """The stream that was found for both hands, under the side in its name. Raises
    RecordingError.
    """
    sides = [side for side in TRACK_NAMES[:2] if _words(str(source)) & TRACK_WORDS[side]]
    if len(sides) != 1:
        raise RecordingError(
            f"{recorded.path}: {source} is given as left and as right; another topic needed for "
            "one of them, or for a task of one hand, the option of this hand only"
        )
    return {sides[0]: source}


def _tool(
    recorded: PoseRecording, given: Mapping[str, PoseTopic], settings: Settings, guessed: list[str]
) -> Track:
    """The tool's track; a remark on a guess is appended to `guessed`. Raises RecordingError."""
    source = _named(recorded, "tool", given)
    joints = source.topic if source and recorded.topics[source.topic] == JOINTS.type else ""
    joints = recorded.joint_topic(settings) if source is None else joints
    if joints:
        guessed.append(f"tool is computed from {joints} by the arm's URDF")
        return recorded.tool_by_joints(
            joints, settings, recorded.urdf or robot_description(settings)
        )
    if source is None:
        source = _by_words(recorded, "tool")
        if source is None:
            raise _not_found(recorded, "tool", [])
        guessed.append(f"tool is {source}")
    return recorded.track(TAKE_KEYS["tool"], source, settings)


def _given(recorded: PoseRecording, name: str, wanted: PoseTopic) -> PoseTopic:
    """The stream that an option names. Raises RecordingError."""
    topic = next(
        (topic for topic in recorded.topics if topic.strip("/") == wanted.topic.strip("/")), ""
    )
    kind = recorded.topics[topic] if topic else ""
    if kind == JOINTS.type and name == "tool":
        return PoseTopic(topic)
    if kind not in POSE_TYPES:
        problem = f"a topic of type {kind}" if topic else "no topic there"
        raise RecordingError(
            f"{recorded.path}: --{name} {wanted}: {problem}; {_poses_in(recorded)}"
        )
    parts = list(recorded.tracks(topic))
    if wanted.part in parts:
        return PoseTopic(topic, wanted.part)
    if len(parts) == 1 and not wanted.part:
        return PoseTopic(topic, parts[0])
    raise RecordingError(f"{recorded.path}: --{name} {wanted}: {_needed(kind, parts)}")


def _needed(kind: str, parts: Sequence[str]) -> str:
    """The parts that a topic of this type has, in words."""
    if not any(parts):
        return "it has no parts"
    part_kind = "an index" if kind == POSE_ARRAY else "a child frame"
    return f"{part_kind} needed, one of {', '.join(parts)}"


def by_ending(recorded: PoseRecording, name: str) -> PoseTopic | None:
    """The stream of PoseStamped with the name of the service's own topic, in any cell. Raises
    RecordingError.
    """
    topics = [
        topic
        for topic, kind in recorded.topics.items()
        if kind == POSE.type
        and f"/{topic}".endswith(f"/{TAKE_KEYS[name]}")
        and "" in recorded.tracks(topic)
    ]
    if len(topics) > 1:
        raise RecordingError(
            f"{recorded.path} has two streams of {TAKE_KEYS[name]}: {topics[0]} and {topics[1]}; "
            f"one needed, as --{name} of `thirdhand learn` names it"
        )
    return PoseTopic(topics[0]) if topics else None


def _by_words(recorded: PoseRecording, name: str) -> PoseTopic | None:
    """The stream with a word of TRACK_WORDS in its name; None if there is none. Raises
    RecordingError if there are several.
    """
    if recorded.is_ours:
        return None
    fitting = [source for source, _ in recorded.streams() if _has_words(source, name)]
    if len(fitting) > 1 and name != "tool":
        fitting = [source for source in fitting if _words(str(source)) & HAND_WORDS] or fitting
    if len(fitting) > 1:
        raise _not_found(recorded, name, fitting)
    return fitting[0] if fitting else None


def _has_words(source: PoseTopic, name: str) -> bool:
    """True if a stream has a word of this track in its name, and none of another hand."""
    words = _words(str(source))
    others = [hand for hand in TRACK_NAMES[:2] if hand != name]
    has_other = any(words & TRACK_WORDS[hand] for hand in others)
    return bool(words & TRACK_WORDS[name]) and not has_other


def _not_found(recorded: PoseRecording, name: str, fitting: Sequence[PoseTopic]) -> RecordingError:
    also = f" or {JOINT_STATES} of the arm's joints" if name == "tool" else ""
    several = f"; {', '.join(map(str, fitting))} could be it" if fitting else ""
    return RecordingError(
        f"{recorded.path} has no topic ending in {TAKE_KEYS[name]} with "
        f"{POSE.type}{also}{several}; {_poses_in(recorded)}; --{name} TOPIC[:PART] of `thirdhand "
        "learn` names another"
    )


def _words(text: str) -> set[str]:
    """The words of a name: `/vrpn/LeftHand_1` has vrpn, left, hand, 1."""
    return {word.lower() for word in re.findall(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+|\d+", text)}


def _poses_in(recorded: PoseRecording) -> str:
    poses = ", ".join(f"{source} ({count})" for source, count in recorded.streams())
    return (
        f"its topics: {with_types(recorded.topics)}; topics with poses: {poses or 'none'}; types "
        f"with poses that are read: {', '.join(POSE_TYPES)}"
    )
