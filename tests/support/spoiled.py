"""Takes with a stretch in which the track of a hand or of the tool is wrong."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np

from thirdhand.contract import cdr
from thirdhand.contract.channels import POSE
from thirdhand.contract.messages import BASE, PoseStamped
from thirdhand.recordings.mcap_file import McapFile
from thirdhand.skills.demonstration import Demonstration

KEYS = {"left": "hands/left", "right": "hands/right", "tool": "tool/pose"}
START_NS = 10**18


class Stream(NamedTuple):
    """Poses (N, 7) of one stream, their stamps and times of recording (N,) [ns]."""

    stamps_ns: np.ndarray
    logged_ns: np.ndarray
    poses: np.ndarray


Streams = dict[str, Stream]
Spoil = Callable[[Streams, str, np.ndarray, np.random.Generator], None]
"""Spoils the stream of this name in place in the samples of a mask (N,)."""


def streams_of(take: Demonstration) -> Streams:
    """The streams of a take, each sample recorded a moment after its stamp."""
    stamps = START_NS + take.stamps_ns - take.stamps_ns[0]
    logged = stamps + 4_000_000
    return {
        name: Stream(stamps.copy(), logged.copy(), np.array(getattr(take, name))) for name in KEYS
    }


def write_streams(path: Path, streams: Mapping[str, Stream]) -> Path:
    """A file of these streams, in the order of recording."""
    rows = sorted(
        (int(stream.logged_ns[i]), name, i)
        for name, stream in streams.items()
        for i in range(len(stream.poses))
    )
    with McapFile(path, joints=0, attached=False) as file:
        for logged_ns, name, i in rows:
            row = streams[name].poses[i].tolist()
            pose = PoseStamped(
                int(streams[name].stamps_ns[i]), BASE, tuple(row[:3]), tuple(row[3:])
            )
            file.put(f"cell/{KEYS[name]}", POSE.type, cdr.encode_pose(pose), logged_ns, i)
    return path


def _moved(streams: Streams, name: str, mask: np.ndarray, by: np.ndarray) -> None:
    streams[name].poses[mask, :3] += by


def jump(streams: Streams, name: str, mask: np.ndarray, random: np.random.Generator) -> None:
    """The track has an offset of 25 to 80 cm."""
    direction = random.normal(size=3)
    _moved(streams, name, mask, random.uniform(0.25, 0.8) * direction / np.linalg.norm(direction))


def small_jump(streams: Streams, name: str, mask: np.ndarray, random: np.random.Generator) -> None:
    """The track has an offset as large as a fast hand's motion in a few samples."""
    direction = random.normal(size=3)
    _moved(streams, name, mask, random.uniform(0.06, 0.25) * direction / np.linalg.norm(direction))


def lasting_jump(
    streams: Streams, name: str, mask: np.ndarray, random: np.random.Generator
) -> None:
    """The track has such an offset up to the end of the take."""
    end = np.arange(len(mask)) >= len(mask) - int(mask.sum())
    small_jump(streams, name, end, random)


def slight_jump(streams: Streams, name: str, mask: np.ndarray, random: np.random.Generator) -> None:
    """The track has an offset that is too small for the daemon's jump gate."""
    direction = random.normal(size=3)
    _moved(streams, name, mask, random.uniform(0.02, 0.03) * direction / np.linalg.norm(direction))


def dropout(streams: Streams, name: str, mask: np.ndarray, random: np.random.Generator) -> None:
    """The track has an offset; a few samples are missing at its begin and end."""
    direction = random.normal(size=3)
    rows = np.flatnonzero(mask)
    seconds = streams[name].stamps_ns / 1e9
    _moved(streams, name, mask, random.uniform(0.1, 0.5) * direction / np.linalg.norm(direction))
    since = seconds[:, None] - seconds[rows[[0, -1]]]
    lacking = ((since >= 0.0) & (since < random.uniform(0.03, 0.09))).any(axis=1)
    streams[name] = Stream(*(part[~lacking] for part in streams[name]))


def spikes(streams: Streams, name: str, mask: np.ndarray, random: np.random.Generator) -> None:
    """Each third sample has another random offset."""
    rows = np.flatnonzero(mask)[::3]
    direction = random.normal(size=(len(rows), 3))
    streams[name].poses[rows, :3] += (
        0.5 * direction / np.linalg.norm(direction, axis=1, keepdims=True)
    )


def nans(streams: Streams, name: str, mask: np.ndarray, random: np.random.Generator) -> None:
    """The tracker publishes NaN."""
    streams[name].poses[mask, : random.integers(1, 8)] = np.nan


def far(streams: Streams, name: str, mask: np.ndarray, random: np.random.Generator) -> None:
    """The track is in millimetres."""
    streams[name].poses[mask, :3] *= 1000.0


def zeros(streams: Streams, name: str, mask: np.ndarray, random: np.random.Generator) -> None:
    """The tracker publishes poses of zeros."""
    streams[name].poses[mask] = 0.0


def origin(streams: Streams, name: str, mask: np.ndarray, random: np.random.Generator) -> None:
    """The tracker publishes the position of its origin."""
    streams[name].poses[mask] = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)


def freeze(streams: Streams, name: str, mask: np.ndarray, random: np.random.Generator) -> None:
    """The tracker repeats its last pose."""
    streams[name].poses[mask] = streams[name].poses[max(int(np.argmax(mask)) - 1, 0)]


def gap(streams: Streams, name: str, mask: np.ndarray, random: np.random.Generator) -> None:
    """The tracker publishes nothing."""
    streams[name] = Stream(*(part[~mask] for part in streams[name]))


def swap(streams: Streams, name: str, mask: np.ndarray, random: np.random.Generator) -> None:
    """The tracker exchanges the hands."""
    left, right = (streams[side].poses for side in ("left", "right"))
    left[mask], right[mask] = right[mask], left[mask].copy()


def two_sources(streams: Streams, name: str, mask: np.ndarray, random: np.random.Generator) -> None:
    """Every other sample is of a second tracker, which is 30 cm off."""
    rows = np.flatnonzero(mask)[::2]
    streams[name].poses[rows, :3] += [0.0, 0.0, 0.3]


SPOILS: tuple[Spoil, ...] = (jump, spikes, nans, far, zeros, origin, freeze, gap, swap, two_sources)
SUBTLE: tuple[Spoil, ...] = (small_jump, lasting_jump, slight_jump, dropout)
"""Kinds of which some cannot be told from what a hand does."""
