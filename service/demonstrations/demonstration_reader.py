"""Reads and writes demonstrations; they are brought to frame `base` and to common stamps."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np
from mcap.reader import make_reader
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from service.config import HandSettings, Settings
from service.contract import cdr
from service.contract.channels import JOINTS, POSE, STRING, topic
from service.contract.messages import BASE, GRIPPER, JointState, PoseStamped
from service.contract.requests import encode_json
from service.core.frame import Vector
from service.core.geometry import rotation
from service.core.intake.far_away import too_far
from service.core.intake.intake import FARTHEST_M, UNIT_M
from service.demonstrations.pose_streams import ENDINGS, GRIPPER_STATE, PLACES, PoseTopic, Recorded, Track, chosen
from service.learning.demonstration import Demonstration
from service.recording.mcap_file import McapFile, RecordingError, ends_early, existing
from service.recording.mcap_reader import Messages, full_name, next_whole

_STREAMS = tuple(ENDINGS.values())
LARGEST_DELAY_S = 0.2  # by which the delays from stamp to recording may differ between streams of one clock


def write_demonstration(path: str | Path, demonstration: Demonstration, *, cell: str = "thirdhand") -> None:
    """Writes a demonstration in frame `base`.

    The same arrays give the same bytes. Raises ValueError.
    """
    stamps_ns, left, right, tool = demonstration[:4]
    poses = [np.asarray(stream, np.float64) for stream in (left, right, tool)]
    gripper, count = demonstration.gripper, len(stamps_ns)
    given: list[tuple[str, Vector, tuple[int, ...]]]
    given = [(name, stream, (count, 7)) for name, stream in zip(_STREAMS, poses, strict=True)]
    if demonstration.conducts != "both":
        given = [one for one in given if one[0] in (ENDINGS[demonstration.conducts], ENDINGS["tool"])]
    given += [] if gripper is None else [(GRIPPER_STATE, gripper, (count,))]
    for name, stream, shape in given:
        if stream.shape != shape or not np.isfinite(stream).all():
            raise ValueError(f"{name}: shape {stream.shape} given, finite numbers of shape {shape} needed")
    with McapFile(Path(path), joints=0, attached=False) as file:
        told = {"hands": demonstration.conducts, "person": demonstration.person}
        if told := {name: word for name, word in told.items() if word not in ("both", "")}:
            file.writer.add_metadata("thirdhand", told)
        streams = [(name, stream) for name, stream, shape in given if shape == (count, 7)]
        for i, (stamp, *rows) in enumerate(
            zip(np.asarray(stamps_ns).tolist(), *(stream.tolist() for _, stream in streams), strict=True)
        ):
            for (name, _), row in zip(streams, rows, strict=True):
                data = cdr.encode_pose(PoseStamped(stamp, BASE, tuple(row[:3]), tuple(row[3:])))
                file.put(topic(cell, name), POSE.type, data, stamp, i)
            if gripper is not None:
                data = cdr.encode_joints(JointState(stamp, (GRIPPER,), (float(gripper[i]),), ()))
                file.put(topic(cell, GRIPPER_STATE), JOINTS.type, data, stamp, i)
        if demonstration.places:
            text = encode_json(demonstration.places).decode()
            file.put(topic(cell, PLACES), STRING.type, cdr.encode_string(text), int(stamps_ns[0]), 0)


def read_demonstration(
    path: str | Path,
    *,
    topics: Mapping[str, PoseTopic] | None = None,
    settings: Settings | None = None,
    say: Callable[[str], None] = lambda line: None,
) -> Demonstration:
    """The demonstration in a recording: hands and tool in frame `base` at the tool's stamps, over
    the time that all three cover.

    Reads MCAP files, ours and others', and bags. Topics are those in `topics` (by left, right,
    tool). Without these they are found by the ends of their names, in any cell, or where only one
    fits. Hands are brought to `base` as in the daemon, by `settings` or else those in the file.
    Hands stamped at other times than the tool are interpolated linearly. Where the stamps are of
    different clocks, the times of recording are used instead.

    Raises RecordingError, also for a damaged file: the missing part may lie within a motion. A file
    that was cut ends early. `say` is called with that, and with what was found or assumed.
    """
    recorded = Recorded(path)
    settings = settings or recorded.settings or Settings()
    if any(not fault.cut for fault in recorded.faults):
        readable = ", ".join(f"{count} poses on {source}" for source, count in recorded.streams()) or "no poses"
        faults = "; ".join(map(str, recorded.faults))
        raise RecordingError(f"{path}: {faults}; {readable} can be read; nothing is learned from it")
    tracks, remarks = chosen(recorded, topics or {}, settings)
    for fault in recorded.faults:
        say(f"{path}: {fault}; {', '.join(f'{len(track.poses)} poses on {track.name}' for track in tracks)} are there")
    count = sum(len(track.poses) for track in tracks)
    if recorded.is_ours:  # what the daemon rejects, too
        tracks = [_masked(track, _is_pose(track.poses)) for track in tracks]
    unmapped = tracks
    tracks, mapped = in_base(path, tracks, settings.hands)
    if recorded.is_ours:
        tracks = [_masked(track, np.linalg.norm(track.poses[:, :3], axis=1) <= FARTHEST_M) for track in tracks]
        for track, before in zip(tracks, unmapped, strict=True):
            if len(before.poses) and not len(track.poses):
                why = far_away(before.name, before.frame, before.poses[0, :3].tolist(), settings.hands)
                raise RecordingError(
                    f"{path}: all {len(before.poses)} poses on {before.name} are too far, the first {why}"
                )
        if left_out := count - sum(len(track.poses) for track in tracks):
            remarks.append(f"{left_out} of {count} poses are none, or farther than {FARTHEST_M:g} m, and left out")
    if remarks or mapped:
        say(f"{path}: {'; '.join([*remarks, *mapped])}")
    tracks, clocks = _by_one_clock(tracks)
    if clocks:
        say(f"{path}: {clocks}")
    rows = []
    for track in tracks:
        stamps, first = np.unique(track.stamps_ns, return_index=True)
        if len(stamps) < 2:
            raise RecordingError(
                f"{path}: {len(track.poses)} poses on {track.name} with {len(stamps)} different stamps, 2 needed"
            )
        rows.append((stamps, track.poses[first]))
    stamps = rows[2][0]
    start, end = max(row[0][0] for row in rows), min(row[0][-1] for row in rows)
    stamps = stamps[(stamps >= start) & (stamps <= end)]
    if len(stamps) < 2:
        raise RecordingError(
            f"{path}: hands and tool have less than two stamps of the tool in common: "
            "by which clocks were they stamped?"
        )
    left, right, tool = (_resampled(stamps, *row) for row in rows)
    stamps.setflags(write=False)
    return Demonstration(
        stamps,
        left,
        right,
        tool,
        BASE,
        recorded.places,
        recorded.closures(stamps, logged=bool(clocks)),
        recorded.conducts,
        recorded.person,
    )


def _is_pose(poses: Vector) -> NDArray[np.bool_]:
    """A mask (N,) of the poses (N, 7) that are finite, with a quaternion of norm 1."""
    with np.errstate(all="ignore"):
        return np.asarray(np.isfinite(poses).all(axis=1) & (np.abs(np.linalg.norm(poses[:, 3:], axis=1) - 1) <= 0.01))


def _masked(track: Track, mask: NDArray[np.bool_]) -> Track:
    """The track with those of its poses that the mask selects."""
    return track._replace(stamps_ns=track.stamps_ns[mask], logged_ns=track.logged_ns[mask], poses=track.poses[mask])


def is_by_tracker(name: str, frame: str, hands: HandSettings) -> bool:
    """Whether the poses of a stream, like `hands/left`, are in the tracker's axes and unit."""
    tracker_frames = ("", *([BASE] if hands.frame in ("", BASE) else []))  # as in the daemon
    return frame not in ("", BASE) or (name != ENDINGS["tool"] and frame in tracker_frames)


def from_tracker(positions: Vector, hands: HandSettings) -> Vector:
    """Positions (N, 3) in frame `base` [m], given those in the tracker's frame and unit."""
    axes, origin = rotation(hands.base_from_tracker[3:]), np.array(hands.base_from_tracker[:3])
    return np.asarray(UNIT_M[hands.unit] * positions @ axes.T + origin)


def far_away(name: str, frame: str, position: Sequence[float], hands: HandSettings) -> str:
    """Words and remedy for a stream's position, as published, that is too far away."""
    if is_by_tracker(name, frame, hands):
        return f"{too_far(position, hands.unit)}: set [hands] unit in the cell's settings (--config)"
    rule = f"{name} in frame {BASE!r} is in metres, whatever [hands] unit says"
    also = ", or name the tracker's frame in it and in [hands] frame: what it names is in [hands] unit"
    return f"{too_far(position, 'm', rule)}: publish it in metres{also}"


def unknown_frame(name: str, frame: str, hands: HandSettings) -> str:
    """Words and remedy for a stream in a frame of which nothing is known; empty for others."""
    if frame in ("", BASE, hands.frame):
        return ""
    known = "" if hands.frame == BASE else f", or {hands.frame!r} as [hands] frame says,"
    return (
        f"{name} is in frame {frame!r}: {BASE!r}{known} needed, or a configuration (--config) whose [hands] frame "
        "names it and says by base_from_tracker where it is"
    )


def in_base(path: str | Path, tracks: Sequence[Track], hands: HandSettings) -> tuple[list[Track], list[str]]:
    """Tracks of left hand, right hand and tool in frame `base`, and in words which of them were
    transformed.

    As in the daemon the hands are, except those in `base` where the tracker has a frame of its own.
    The tool is only where it names that frame. Raises RecordingError for other frames.
    """
    for track in tracks:
        if problem := unknown_frame(track.name, track.frame, hands):
            raise RecordingError(f"{path}: {problem}")
    axes, origin = rotation(hands.base_from_tracker[3:]), np.array(hands.base_from_tracker[:3])
    if hands.unit == "m" and not origin.any() and np.array_equal(axes, np.eye(3)):
        return list(tracks), []
    turn, out, mapped = Rotation.from_matrix(axes), list(tracks), []
    for i, track in enumerate(tracks):
        if is_by_tracker(track.name, track.frame, hands):
            at = from_tracker(track.poses[:, :3], hands)
            turns = (turn * Rotation.from_quat(track.poses[:, 3:])).as_quat()
            out[i] = track._replace(poses=np.hstack([at, turns]), frame=BASE)
            mapped.append(track.name)
    remark = f"{', '.join(mapped)} brought to frame {BASE} by [hands] unit and base_from_tracker"
    return out, [remark] if mapped else []


def _by_one_clock(tracks: Sequence[Track]) -> tuple[list[Track], str]:
    """Tracks with stamps of one clock, and in words why their own are not used; empty: they are."""
    if not all(len(track.poses) for track in tracks):
        return list(tracks), ""
    ahead_s = [float(np.median(track.stamps_ns - track.logged_ns)) / 1e9 for track in tracks]
    if max(ahead_s) - min(ahead_s) <= LARGEST_DELAY_S or any(not np.ptp(track.logged_ns) for track in tracks):
        return list(tracks), ""
    clocks = ", ".join(f"{track.name} by {ahead:+.3f} s" for track, ahead in zip(tracks, ahead_s, strict=True))
    return [track._replace(stamps_ns=track.logged_ns) for track in tracks], (
        f"stamps are of different clocks (against the recorder's {clocks}): the times of recording count instead"
    )


def _resampled(stamps: NDArray[np.int64], at: NDArray[np.int64], poses: NDArray[np.float64]) -> NDArray[np.float64]:
    """Poses (T, 7) at `stamps` by linear interpolation of those at `at` (N,); quaternions are
    interpolated the short way and normalised.
    """
    if np.isin(stamps, at).all():
        out = poses[np.searchsorted(at, stamps)]
    else:
        signs = np.cumprod(np.where(np.sum(poses[1:, 3:] * poses[:-1, 3:], axis=1) < 0, -1.0, 1.0), axis=0)
        smooth = np.concatenate([poses[:, :3], poses[:, 3:] * np.concatenate([[1.0], signs])[:, None]], axis=1)
        times, knots = (stamps - at[0]).astype(np.float64), (at - at[0]).astype(np.float64)
        out = np.stack([np.interp(times, knots, column) for column in smooth.T], axis=1)
        out[:, 3:] /= np.linalg.norm(out[:, 3:], axis=1, keepdims=True)
    out.setflags(write=False)
    return out


def iter_hands(path: str | Path) -> Iterator[tuple[int, str, bytes]]:
    """Log time [ns], side and CDR bytes of every hand sample, in order of time.

    Reads demonstrations, recordings and other ROS 2 recordings; a file that was cut up to its cut,
    in the order of writing. Raises RecordingError.
    """
    path = existing(path)
    found: dict[str, str] = {}  # topics by stream, one each
    seen: set[str] = set()
    with path.open("rb") as stream:
        messages = iter(Messages(path)) if ends_early(path) else make_reader(stream, validate_crcs=True).iter_messages()
        while one := next_whole(messages, path):
            schema, channel, message = one
            seen.add(topic := channel.topic)
            name = next((name for name in _STREAMS[:2] if f"/{topic}".endswith(f"/{name}")), "")
            if not name or full_name(schema) != POSE.type or channel.message_encoding != "cdr":
                continue
            if found.setdefault(name, topic) != topic:
                raise RecordingError(f"{path} has two streams of {name}: {found[name]} and {topic}")
            yield message.log_time, name.removeprefix("hands/"), message.data
    if not found:
        lacks = f"no topic ending in hands/left or hands/right with {POSE.type}"
        raise RecordingError(f"{path} has {lacks}; its topics: {', '.join(sorted(seen)) or 'none'}")
