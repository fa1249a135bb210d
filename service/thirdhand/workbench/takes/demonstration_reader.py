"""Reading and writing of demonstrations, with all poses in frame `base` and at common stamps."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from thirdhand.contract import cdr
from thirdhand.contract.channels import JOINTS, POSE, STRING, TAKE_KEYS, topic
from thirdhand.contract.messages import BASE, GRIPPER, JointState, PoseStamped, WireError
from thirdhand.contract.other_types import Refusal
from thirdhand.contract.requests import Hands, encode_json
from thirdhand.core.frame import Vector
from thirdhand.core.geometry import rotation
from thirdhand.core.intake.stage import UNIT_M, base_from
from thirdhand.core.tuning import TUNING
from thirdhand.daemon.far_away import too_far
from thirdhand.recordings.mcap_file import McapFile, RecordingError, ends_early, existing
from thirdhand.recordings.mcap_reader import Messages
from thirdhand.settings.config import HandSettings, Settings
from thirdhand.skills.demonstration import Demonstration
from thirdhand.workbench.takes.hands_and_tool import chosen
from thirdhand.workbench.takes.pose_streams import (
    BEGIN_TOPIC,
    GRIPPER_STATE,
    VIA_POINTS_TOPIC,
    PoseRecording,
    PoseTopic,
    other_type,
    type_of,
    with_types,
)
from thirdhand.workbench.takes.track import Track
from thirdhand.workbench.takes.track_check import LEAST_PIECE_S, Checked, checked, sound
from thirdhand.workbench.takes.track_clocks import by_one_clock

_STREAMS = tuple(TAKE_KEYS.values())
MIN_USABLE_SHARE = 0.5  # takes with a smaller usable share are refused
REQUEST_TOLERANCE_S = 0.1  # a take begins with the samples just before the request
MIN_SEEN_SHARE = 0.1  # a hand that is seen for a smaller share of the time does not lead the tool
MAX_NAMED_STRETCHES = 10  # a message names at most this many bad stretches
# a tool with a low rate is out of sight after this many of its usual intervals
UNSEEN_INTERVALS = 5.0


def write_demonstration(
    path: str | Path, demonstration: Demonstration, *, cell: str = "thirdhand"
) -> None:
    """Write a demonstration in frame `base`.

    Equal arrays give equal bytes. Raises ValueError for arrays of a wrong shape, or that are not
    finite, and for stamps that are not integers from 0 on, also that of a request.
    """
    stamps_ns = np.asarray(demonstration.stamps_ns)
    begun_ns = stamps_ns[:1] - round(1e9 * (demonstration.begun_s or 0.0))
    _check_stamps(np.append(stamps_ns, begun_ns))
    count = len(stamps_ns)
    poses = _poses_of(demonstration)
    for name, stream in poses.items():
        _check_array(name, stream, (count, 7))
    gripper = demonstration.gripper
    if gripper is not None:
        _check_array(GRIPPER_STATE, gripper, (count,))

    with McapFile(Path(path), joints=0, attached=False) as file:
        about = {"hands": demonstration.conducts, "person": demonstration.person}
        if about := {name: word for name, word in about.items() if word not in ("both", "")}:
            file.writer.add_metadata("thirdhand", about)
        for i, stamp in enumerate(stamps_ns.tolist()):
            for name, stream in poses.items():
                x, y, z, *quaternion = stream[i].tolist()
                data = cdr.encode_pose(PoseStamped(stamp, BASE, (x, y, z), tuple(quaternion)))
                file.put(topic(cell, name), POSE.type, data, stamp, i)
            if gripper is not None:
                data = cdr.encode_joints(JointState(stamp, (GRIPPER,), (float(gripper[i]),), ()))
                file.put(topic(cell, GRIPPER_STATE), JOINTS.type, data, stamp, i)
        texts = {}
        if demonstration.via_points:
            texts[VIA_POINTS_TOPIC] = encode_json(demonstration.via_points).decode(), stamps_ns[0]
        if demonstration.begun_s is not None:
            texts[BEGIN_TOPIC] = "{}", begun_ns[0]
        for name, (text, at_ns) in texts.items():
            file.put(topic(cell, name), STRING.type, cdr.encode_string(text), int(at_ns), 0)


def _check_stamps(stamps_ns: NDArray[Any]) -> None:
    """Raise ValueError for stamps that are not integers from 0 on."""
    if stamps_ns.dtype.kind not in "iu" or np.any(stamps_ns < 0):
        lowest = f" from {stamps_ns.min():g} on" if stamps_ns.size else ""
        raise ValueError(
            f"stamps_ns: {stamps_ns.dtype}{lowest} given, integers [ns] from 0 on needed: "
            "np.round(1e9 * seconds).astype(np.int64)"
        )


def _poses_of(demonstration: Demonstration) -> dict[str, Vector]:
    """The poses (T, 7) of the tool and of the hands that conduct it, by their keys."""
    streams = dict(zip(TAKE_KEYS, demonstration[1:4], strict=True))
    conducts = demonstration.conducts
    return {
        TAKE_KEYS[name]: np.asarray(stream, np.float64)
        for name, stream in streams.items()
        if conducts == "both" or name in (conducts, "tool")
    }


def _check_array(name: str, array: Vector, shape: tuple[int, ...]) -> None:
    """Raise ValueError for an array of another shape, or that is not finite."""
    if array.shape != shape or not np.isfinite(array).all():
        raise ValueError(
            f"{name}: shape {array.shape} given, finite numbers of shape {shape} needed"
        )


def read_demonstration(
    path: str | Path,
    *,
    topics: Mapping[str, PoseTopic] | None = None,
    settings: Settings | None = None,
    say: Callable[[str], None] = lambda line: None,
) -> Demonstration:
    """The demonstration in a recording: hands and tool in frame `base` at the tool's stamps, over
    the time that all three cover.

    Reads MCAP files and bags of this and other systems. `topics` has the topics of `left`, `right`
    and `tool`; those not given are found by the ends of their names, in any cell, or by words in
    their names. Hands are transformed to `base` as in the daemon, by `settings` or else those in
    the file, and interpolated linearly at the tool's stamps. If the stamps come from different
    clocks, the times of recording are used instead.

    Raises RecordingError, also for a damaged file, because the missing part may lie within a
    motion. A file that was cut ends early. `say` is called with remarks on what was found, assumed
    or left out.
    """
    recorded = PoseRecording(path)
    settings = _settings_of(recorded, settings)
    _check_faults(recorded)

    def report(*lines: str) -> None:
        for line in filter(None, lines):
            say(f"{path}: {line}")

    selection = chosen(recorded, topics or {}, settings)
    read = ", ".join(f"{len(track.poses)} poses on {track.name}" for track in selection.tracks)
    report(*(f"{fault}; {read} were read" for fault in recorded.faults))
    one_clock = by_one_clock(selection.tracks)
    mapped_tracks, mapped = in_base(path, [sound(track) for track in one_clock.tracks], settings)
    tracks = [
        _near(recorded, *pair, settings)
        for pair in zip(mapped_tracks, one_clock.tracks, strict=True)
    ]
    report("; ".join([*selection.guessed, *_invalid_in(tracks), *mapped]), one_clock.remark)

    in_order = [_in_order(path, track) for track in tracks]
    common = CommonPart.of(path, in_order, selection.conducts, settings)
    report(*common.remarks)
    left, right, tool = (
        _resampled(common.stamps_ns, track.stamps_ns, track.poses) for track in common.tracks
    )
    closure = recorded.closures(common.stamps_ns, logged=one_clock.logged, part=one_clock.part)
    report(*recorded.unused)
    common.stamps_ns.setflags(write=False)
    return Demonstration(
        common.stamps_ns,
        left,
        right,
        tool,
        BASE,
        recorded.via_points,
        closure,
        common.conducts,
        recorded.person,
        common.begins,
        _begun_s(recorded, one_clock.tracks, int(common.stamps_ns[0])),
    )


def _begun_s(recorded: PoseRecording, tracks: Sequence[Track], first_ns: int) -> float | None:
    """The time [s] from the request that began the task to the stamp `first_ns`; None without one.
    A request has a time of recording only, from which stamps may differ by a constant.
    """
    ahead_ns = np.median([np.median(track.stamps_ns - track.logged_ns) for track in tracks])
    since_s = [(first_ns - begun_ns - float(ahead_ns)) / 1e9 for begun_ns in recorded.begun_ns]
    before_s = [lasts_s for lasts_s in since_s if lasts_s > -REQUEST_TOLERANCE_S]
    return max(0.0, min(before_s)) if before_s else None


def _settings_of(recorded: PoseRecording, cell: Settings | None) -> Settings:
    """The settings of a cell, or else those in its recording, or else the defaults. Raises
    RecordingError if those in the recording are not valid.
    """
    settings = cell or recorded.settings
    if settings is None and recorded.is_ours:
        raise RecordingError(f"{'; '.join(recorded.unused)}; --config gives others")
    return settings or Settings()


def _check_faults(recorded: PoseRecording) -> None:
    """Raise RecordingError for a damaged file, unless it was cut."""
    if any(not fault.cut for fault in recorded.faults):
        readable = (
            ", ".join(f"{count} poses on {source}" for source, count in recorded.streams())
            or "no poses"
        )
        faults = "; ".join(map(str, recorded.faults))
        raise RecordingError(
            f"{recorded.path}: {faults}; {readable} can be read; nothing is learned from it"
        )


class CommonPart(NamedTuple):
    """The part of a take in which hands and tool are all seen.

    It has the tracks of left hand, right hand and tool with their trusted samples, the hands that
    lead the tool, the tool's stamps [ns], the indices of the first stamps after stretches that are
    left out, and remarks.
    """

    tracks: list[Track]
    conducts: Hands
    stamps_ns: NDArray[np.int64]
    begins: tuple[int, ...]
    remarks: list[str]

    @staticmethod
    def of(
        path: str | Path, tracks: Sequence[Track], conducts: Hands, settings: Settings
    ) -> CommonPart:
        """The common part of the tracks of left hand, right hand and tool.

        Raises RecordingError if too little is left.
        """
        unseen_s = settings.hands.unseen_ms / 1000
        tool_s = max(
            unseen_s, UNSEEN_INTERVALS * float(np.median(np.diff(tracks[2].stamps_ns))) / 1e9
        )
        hands = checked(
            tracks[:2] if conducts == "both" else tracks[:1], settings, longest_s=unseen_s
        )
        (tool,) = checked(tracks[2:], settings, longest_s=tool_s)
        leading, conducts, remarks = _leading(hands, conducts)
        rows = [*leading, tool]
        start_ns = max(row.start_ns for row in rows)
        end_ns = min(row.end_ns for row in rows)
        if start_ns >= end_ns:
            raise RecordingError(
                f"{path}: hands and tool have fewer than two stamps of the tool in common: "
                "were they stamped by different clocks?"
            )
        remarks += [row.remark for row in rows if row.remark]
        stamps, begins = _left_in(tool.track.stamps_ns, rows)
        kept_s = sum(float(np.ptp(part)) for part in np.split(stamps, begins) if len(part)) / 1e9
        span_s = (end_ns - start_ns) / 1e9
        origin_ns = min(int(track.stamps_ns[0]) for track in tracks)
        bad = _stretches_in(rows, start_ns, end_ns, origin_ns)
        if kept_s < MIN_USABLE_SHARE * span_s:
            raise RecordingError(
                f"{path}: {kept_s:.1f} of {span_s:.1f} s are usable, {MIN_USABLE_SHARE:.0%} needed"
                f"{f': {bad}' if bad else ''}. Record it again, or cut it with thirdhand record "
                "--trim"
            )
        if bad:
            remarks.append(f"left out, {span_s - kept_s:.1f} of {span_s:.1f} s: {bad}")
        common_tracks = [leading[0].track, leading[-1].track, tool.track]
        return CommonPart(common_tracks, conducts, stamps, tuple(begins), remarks)


def _leading(
    hands: Sequence[Checked], conducts: Hands
) -> tuple[Sequence[Checked], Hands, list[str]]:
    """The hands that lead the tool, without a hand that is hardly seen while the other one is; with
    a remark.
    """
    shares = [hand.seen_share for hand in hands]
    if not min(shares) < MIN_SEEN_SHARE <= max(shares):
        return hands, conducts, []
    side: Literal["left", "right"] = "left" if shares[0] > shares[1] else "right"
    remark = f"the {side} hand leads alone: the other is seen for {min(shares):.0%} of the time"
    return [max(hands, key=lambda hand: hand.seen_share)], side, [remark]


def _stretches_in(rows: Sequence[Checked], start_ns: int, end_ns: int, origin_ns: int) -> str:
    """The bad stretches of tracks between two times, in words, by their begin after an origin."""
    stretches = sorted(
        (stretch for row in rows for stretch in row.stretches),
        key=lambda stretch: stretch.begin_ns,
    )
    stretches = [part for part in stretches if part.begin_ns < end_ns and part.end_ns > start_ns]
    more = len(stretches) - MAX_NAMED_STRETCHES
    named = "; ".join(stretch.text(origin_ns) for stretch in stretches[:MAX_NAMED_STRETCHES])
    return named + f"; and {more} more" * (more > 0)


def _left_in(
    stamps: NDArray[np.int64], rows: Sequence[Checked]
) -> tuple[NDArray[np.int64], list[int]]:
    """The tool's stamps [ns] at which all tracks are seen, without pieces that are too short, and
    the indices of the first stamps after the stretches that are left out.
    """
    begins_ns, ends_ns = zip(*(_span_ns(row.track) for row in rows), strict=True)
    stamps = stamps[(stamps >= max(begins_ns)) & (stamps <= min(ends_ns))]
    holes = [hole for row in rows for hole in row.stretches]
    for hole in holes:
        stamps = stamps[(stamps <= hole.begin_ns) | (stamps >= hole.end_ns)]
    cuts = sorted({int(np.searchsorted(stamps, hole.end_ns)) for hole in holes} - {0, len(stamps)})
    pieces = np.split(stamps, cuts)
    if cuts:
        least_ns = round(1e9 * LEAST_PIECE_S)
        pieces = [piece for piece in pieces if len(piece) and np.ptp(piece) >= least_ns]
    begins = np.cumsum([len(piece) for piece in pieces])[:-1].tolist()
    return np.concatenate(pieces) if pieces else stamps[:0], begins


def _span_ns(track: Track) -> tuple[int, int]:
    """The first and the last stamp [ns] of a track; without stamps, an end far before the begin."""
    stamps_ns = track.stamps_ns
    return (int(stamps_ns[0]), int(stamps_ns[-1])) if len(stamps_ns) else (2**62, -(2**62))


def _near(recorded: PoseRecording, track: Track, before: Track, settings: Settings) -> Track:
    """The track with NaN for poses that are too far away; `before` is the published track.

    Raises RecordingError if all poses are too far away.
    """
    with np.errstate(all="ignore"):
        is_far = np.linalg.norm(track.poses[:, :3], axis=1) > TUNING.intake.max_hand_distance_m
    if len(is_far) and is_far.all():
        why = far_away(before.name, before.frame, before.poses[0, :3].tolist(), settings)
        if recorded.is_captured:
            rule = "the unit in the file is used, and [hands] unit is ignored"
            why = (
                f"{too_far(track.poses[0, :3].tolist(), 'm', rule)}: export it again in the unit "
                "that the file names"
            )
        raise RecordingError(
            f"{recorded.path}: all {len(is_far)} poses on {before.name} are too far away; the "
            f"first is {why}"
        )
    poses = track.poses.copy()
    poses[is_far] = np.nan
    return track._replace(poses=poses)


def _invalid_in(tracks: Sequence[Track]) -> list[str]:
    """A remark on the number of poses that are NaN; empty if none is."""
    most_m = TUNING.intake.max_hand_distance_m
    none = sum(int(np.isnan(track.poses[:, 0]).sum()) for track in tracks)
    count = sum(len(track.poses) for track in tracks)
    return (
        [f"{none} of {count} poses are invalid or farther than {most_m:g} m, and are left out"]
        if none
        else []
    )


def _in_order(path: str | Path, track: Track) -> Track:
    """The track sorted by its stamps, without repeated stamps. Raises RecordingError."""
    stamps, first = np.unique(track.stamps_ns, return_index=True)
    if len(stamps) < 2:
        raise RecordingError(
            f"{path}: {len(track.poses)} poses on {track.name} with {len(stamps)} different "
            "stamps, 2 needed"
        )
    return Track(
        track.name, track.source, stamps, track.logged_ns[first], track.poses[first], track.frame
    )


def is_by_tracker(name: str, frame: str, hands: HandSettings) -> bool:
    """True if the poses of a stream, like `hands/left`, are in the tracker's axes and unit."""
    # the daemon has the same rule
    tracker_frames = ("", *([BASE] if hands.frame in ("", BASE) else []))
    return frame not in ("", BASE) or (name != TAKE_KEYS["tool"] and frame in tracker_frames)


def in_metres(positions: Vector, hands: HandSettings) -> Vector:
    """Positions (N, 3) [m] in the tracker's frame, right-handed, from positions in its axes and
    unit.
    """
    if hands.axes == "left-handed":
        positions = positions * (1.0, 1.0, -1.0)
    return np.asarray(UNIT_M[hands.unit] * positions)


def from_tracker(positions: Vector, hands: HandSettings) -> Vector:
    """Positions (N, 3) in frame `base` [m], from positions in the tracker's axes and unit."""
    axes = rotation(hands.base_from_tracker[3:])
    origin = np.array(hands.base_from_tracker[:3])
    return np.asarray(in_metres(positions, hands) @ axes.T + origin)


def far_away(name: str, frame: str, position: Sequence[float], settings: Settings) -> str:
    """Message and remedy for a stream's position, as published, that is too far away."""
    hands = settings.hands_in(frame)
    section = settings.tracker_section(frame)
    if is_by_tracker(name, frame, hands):
        rule = f"{section} unit is {hands.unit!r}"
        return (
            f"{too_far(position, hands.unit, rule)}: set {section} unit in the cell's settings "
            "(--config)"
        )
    rule = f"{name} in frame {BASE!r} is always in metres, and [hands] unit is ignored"
    also = ", or with the tracker's frame of [hands] frame, in which positions are in [hands] unit"
    return f"{too_far(position, 'm', rule)}: publish it in metres{also}"


def unknown_frame(name: str, frame: str, hands: HandSettings) -> str:
    """Message and remedy for a stream in an unknown frame; empty for known frames."""
    if frame in ("", BASE, hands.frame):
        return ""
    frame_text = "" if hands.frame == BASE else f", or {hands.frame!r} of [hands] frame,"
    return (
        f"{name} is in frame {frame!r}: {BASE!r}{frame_text} needed, or a configuration (--config) "
        "with this [hands] frame and its pose, [hands] base_from_tracker, or with a table "
        f"[trackers.{frame}]"
    )


def in_base(
    path: str | Path, tracks: Sequence[Track], settings: Settings
) -> tuple[list[Track], list[str]]:
    """Tracks of left hand, right hand and tool in frame `base`, and a remark on which of them were
    transformed.

    As in the daemon, hands are transformed, except for hands in `base` of a tracker whose own frame
    has another name. The tool is transformed only if it names the tracker's frame. Raises
    RecordingError for other frames.
    """
    for track in tracks:
        if problem := unknown_frame(track.name, track.frame, settings.hands_in(track.frame)):
            raise RecordingError(f"{path}: {problem}")
    out = list(tracks)
    mapped = []
    sections = dict[str, None]()
    for i, track in enumerate(tracks):
        hands = settings.hands_in(track.frame)
        is_left_handed = hands.axes == "left-handed"
        is_changed = is_left_handed or not np.array_equal(base_from(hands), np.eye(3, 4))
        if is_by_tracker(track.name, track.frame, hands) and is_changed:
            turn = Rotation.from_matrix(rotation(hands.base_from_tracker[3:]))
            poses = np.full_like(track.poses, np.nan)
            is_finite = np.isfinite(track.poses[:, 0])
            if is_finite.any():
                poses[is_finite, :3] = from_tracker(track.poses[is_finite, :3], hands)
                quaternions = track.poses[is_finite, 3:] * (
                    (-1.0, -1.0, 1.0, 1.0) if is_left_handed else 1.0
                )
                poses[is_finite, 3:] = (turn * Rotation.from_quat(quaternions)).as_quat()
            out[i] = track._replace(poses=poses, frame=BASE)
            mapped.append(track.name)
            sections[settings.tracker_section(track.frame)] = None
    remark = (
        f"{', '.join(mapped)} transformed to frame {BASE} by {' and '.join(sections)} unit and "
        "base_from_tracker"
    )
    return out, [remark] if mapped else []


def _resampled(
    stamps: NDArray[np.int64], at: NDArray[np.int64], poses: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Poses (T, 7) at `stamps` by linear interpolation of those at `at` (N,); quaternions are
    interpolated the short way and normalised.
    """
    if np.isin(stamps, at).all():
        out = poses[np.searchsorted(at, stamps)]
    else:
        signs = np.cumprod(
            np.where(np.sum(poses[1:, 3:] * poses[:-1, 3:], axis=1) < 0, -1.0, 1.0), axis=0
        )
        smooth = np.concatenate(
            [poses[:, :3], poses[:, 3:] * np.concatenate([[1.0], signs])[:, None]], axis=1
        )
        times = (stamps - at[0]).astype(np.float64)
        knots = (at - at[0]).astype(np.float64)
        out = np.stack([np.interp(times, knots, column) for column in smooth.T], axis=1)
        out[:, 3:] /= np.linalg.norm(out[:, 3:], axis=1, keepdims=True)
    out.setflags(write=False)
    return out


def _hand_key(topic: str) -> str:
    """The key of the hand with which a topic ends; empty for another topic."""
    return next((key for key in _STREAMS[:2] if f"/{topic}".endswith(f"/{key}")), "")


def _other_hand_types(types: Mapping[str, str]) -> str:
    """A remark on the topics of hands that have another type, given the type of each topic."""
    remarks = (other_type(types, key, (POSE.type,)) for key in _STREAMS[:2])
    return "; ".join(filter(None, remarks))


def hand_samples(
    path: str | Path, *, say: Callable[[str], None] = lambda line: None
) -> list[tuple[int, str, PoseStamped]]:
    """Log time [ns], side and pose of every hand sample, in order of time.

    Reads demonstrations, recordings and other ROS 2 recordings. A file that was cut is read up to
    its cut. Samples that are not readable are left out, and `say` is called with their number.
    Raises RecordingError.
    """
    path = existing(path)
    messages = Messages(path)
    topics: dict[str, str] = {}  # by stream
    types: dict[str, str] = {}  # by topic
    samples: list[tuple[int, str, PoseStamped]] = []
    causes: list[str] = []
    for schema, channel, message in messages:
        topic = channel.topic
        kind = type_of(schema, channel)
        types.setdefault(topic, kind)
        name = _hand_key(topic)
        if not name or kind != POSE.type:
            continue
        if topics.setdefault(name, topic) != topic:
            raise RecordingError(f"{path} has two streams of {name}: {topics[name]} and {topic}")
        try:
            samples.append(
                (message.log_time, name.removeprefix("hands/"), cdr.decode_pose(message.data))
            )
        except WireError as error:
            causes.append(f"{topic}: {Refusal(str(error), POSE.type, message.data)}")
    if messages.faults and not ends_early(path):
        raise RecordingError(f"{path} is damaged: {messages.faults[0]}")
    if not topics:
        lacks = f"no topic ending in hands/left or hands/right with {POSE.type}"
        raise RecordingError(f"{path} has {lacks}; its topics: {with_types(types)}")
    if remark := _other_hand_types(types):
        say(f"{path}: {remark}")
    if causes:
        remark = (
            f"{path}: {len(causes)} of {len(causes) + len(samples)} poses are not readable: "
            f"{causes[0]}"
        )
        if not samples:
            raise RecordingError(remark)
        say(remark)
    return sorted(samples, key=lambda sample: sample[0])
