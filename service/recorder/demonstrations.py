"""Demonstrations and hands in MCAP files, ours and others': which topics they are, and how they
come to common stamps.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from mcap.reader import make_reader
from numpy.typing import NDArray

from service.contract import cdr
from service.contract.channels import POSE, STRING, topic
from service.contract.messages import BASE, PoseStamped, WireError, finite
from service.contract.requests import RequestError, ViaPoint, decode_request, encode_json
from service.learning.demonstration import Demonstration
from service.recorder.mcap_file import McapFile, RecordingError, ends_early, existing
from service.recorder.mcap_reader import Messages, next_whole

_STREAMS = ("hands/left", "hands/right", "tool/pose")
_PLACES = "places"


def write_demonstration(path: str | Path, demonstration: Demonstration, *, cell: str = "thirdhand") -> None:
    """Writes a demonstration in frame `base`.

    The same arrays give the same bytes. Raises ValueError.
    """
    stamps_ns, left, right, tool = demonstration[:4]
    poses = [np.asarray(stream, np.float64) for stream in (left, right, tool)]
    for name, stream in zip(_STREAMS, poses, strict=True):
        if stream.shape != (len(stamps_ns), 7) or not np.isfinite(stream).all():
            raise ValueError(
                f"{name}: shape {stream.shape} given, finite numbers of shape ({len(stamps_ns)}, 7) needed"
            )
    file = McapFile(Path(path), joints=0, attached=False)
    try:
        for i, (stamp, *rows) in enumerate(
            zip(np.asarray(stamps_ns).tolist(), *(stream.tolist() for stream in poses), strict=True)
        ):
            for name, row in zip(_STREAMS, rows, strict=True):
                data = cdr.encode_pose(PoseStamped(stamp, BASE, tuple(row[:3]), tuple(row[3:])))
                file.put(topic(cell, name), POSE.type, data, stamp, i)
        if demonstration.places:
            text = encode_json(demonstration.places).decode()
            file.put(topic(cell, _PLACES), STRING.type, cdr.encode_string(text), int(stamps_ns[0]), 0)
    finally:
        file.close()


def read_demonstration(path: str | Path, *, say: Callable[[str], None] = lambda line: None) -> Demonstration:
    """The demonstration in an MCAP file: the hands and the tool at the tool's stamps, as far as all
    three reach. Raises RecordingError, also where there is damage: what it took may lie amid a
    motion. A file that was cut ends early, and that is told to `say`.

    Topics are found by their ends, whatever the cell. Where the streams have stamps of their own,
    the hands are interpolated linearly.
    """
    path = existing(path)
    streams = PoseStreams(path, _STREAMS)
    rows: dict[str, list[PoseStamped]] = {name: [] for name in _STREAMS}
    messages = Messages(path)
    places: tuple[ViaPoint, ...] = ()
    for schema, channel, message in messages:
        name = streams.name(schema, channel)
        if f"/{channel.topic}".endswith(f"/{_PLACES}") and schema is not None and schema.name == STRING.type:
            places = _places(path, message.data)
        elif name:
            try:
                pose = cdr.decode_pose(message.data)
            except WireError as error:
                raise RecordingError(f"{path}: {channel.topic}: {error}") from None
            if not finite(pose.position + pose.orientation):
                raise RecordingError(f"{path}: {channel.topic}: a pose that is not finite, at stamp {pose.stamp_ns} ns")
            rows[name].append(pose)
    there = ", ".join(f"{len(poses)} poses on {name}" for name, poses in rows.items())
    faults = "; ".join(map(str, messages.faults))
    if any(not fault.cut for fault in messages.faults):
        raise RecordingError(f"{path}: {faults}; {there} can be read; nothing is learned from it")
    if faults:
        say(f"{path}: {faults}; {there} are there")
    tracks = []
    for name, poses in rows.items():
        if not poses:
            raise streams.missing(name)
        stamps, first = np.unique(np.array([pose.stamp_ns for pose in poses], np.int64), return_index=True)
        if len(stamps) < 2:
            raise RecordingError(f"{path}: {len(poses)} poses on {name} with {len(stamps)} different stamps, 2 needed")
        tracks.append((stamps, np.array([poses[i].position + poses[i].orientation for i in first])))
    frames = {name: poses[0].frame_id for name, poses in rows.items()}
    if len(set(frames.values())) > 1:
        raise RecordingError(
            f"{path}: poses in different frames: {', '.join(f'{name} in {frame!r}' for name, frame in frames.items())}"
        )
    stamps = tracks[2][0]
    start, end = max(track[0][0] for track in tracks), min(track[0][-1] for track in tracks)
    stamps = stamps[(stamps >= start) & (stamps <= end)]
    if len(stamps) < 2:
        raise RecordingError(
            f"{path}: hands and tool have less than two stamps of the tool in common: "
            "by which clocks were they stamped?"
        )
    left, right, tool = (_resampled(stamps, *track) for track in tracks)
    stamps.setflags(write=False)
    return Demonstration(stamps, left, right, tool, next(iter(frames.values())), places)


def _places(path: Path, data: bytes) -> tuple[ViaPoint, ...]:
    try:
        found: tuple[ViaPoint, ...] = decode_request(cdr.decode_string(data).encode(), tuple[ViaPoint, ...])
    except (WireError, RequestError) as error:
        raise RecordingError(f"{path}: {_PLACES}: {error}") from None
    return found


def _resampled(stamps: NDArray[np.int64], at: NDArray[np.int64], poses: NDArray[np.float64]) -> NDArray[np.float64]:
    """Poses (T, 7) at `stamps`, between those at `at` (N,) by linear interpolation, quaternions the
    short way and of norm 1.
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
    """Log time [ns], side and CDR bytes of every hand sample in order of time, one after the other.

    Raises RecordingError.

    Reads demonstrations, recordings and other ROS 2 recordings; of a file that was cut, what is
    there, in the order of writing.
    """
    path = existing(path)
    streams = PoseStreams(path, _STREAMS[:2])
    empty = True
    with path.open("rb") as stream:
        messages = iter(Messages(path)) if ends_early(path) else make_reader(stream, validate_crcs=True).iter_messages()
        while found := next_whole(messages, path):
            name = streams.name(found[0], found[1])
            if name:
                empty = False
                yield found[2].log_time, name.removeprefix("hands/"), found[2].data
    if empty:
        raise streams.missing("hands/left or hands/right")


class PoseStreams:
    """Which topics of a file are the wanted streams of poses; one topic each, whatever the cell."""

    def __init__(self, path: Path, names: tuple[str, ...]) -> None:
        self._path, self._names = path, names
        self._found: dict[str, str] = {}
        self._seen: set[str] = set()

    def name(self, schema: Any, channel: Any) -> str:
        """The stream that a message belongs to; empty: none of them."""
        topic = channel.topic
        self._seen.add(topic)
        name = next((name for name in self._names if f"/{topic}".endswith(f"/{name}")), "")
        if (
            not name
            or schema is None
            or schema.name.replace("/msg/", "/") != POSE.type.replace("/msg/", "/")
            or channel.message_encoding != "cdr"
        ):
            return ""
        if self._found.setdefault(name, topic) != topic:
            raise RecordingError(f"{self._path} has two streams of {name}: {self._found[name]} and {topic}")
        return name

    def missing(self, name: str) -> RecordingError:
        """The error that says that a stream is not there, and what is."""
        topics = ", ".join(sorted(self._seen)) or "none"
        return RecordingError(f"{self._path} has no topic ending in {name} with {POSE.type}; its topics: {topics}")
