"""Takes, which are files with one demonstration each: summaries, pictures, and trimming."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from thirdhand.contract.channels import JOINTS, POSE
from thirdhand.core.frame import Vector
from thirdhand.recordings.mcap_file import McapFile, RecordingError, whole_file
from thirdhand.recordings.mcap_reader import Found, Messages
from thirdhand.settings import palette
from thirdhand.settings.config import Settings
from thirdhand.skills.demonstration import LEAST_M, Demonstration
from thirdhand.workbench.takes.demonstration_reader import read_demonstration
from thirdhand.workbench.takes.dwells import remarks_on_via_points
from thirdhand.workbench.takes.hands_and_tool import chosen
from thirdhand.workbench.takes.pose_streams import TRACK_NAMES, PoseRecording
from thirdhand.workbench.takes.track import Track

SAMPLE_TYPES = (POSE.type, JOINTS.type)  # messages of these types are trimmed
NAME = r"\w[\w .-]{0,63}"
GAP_S = 0.1  # after this time without a sample the daemon holds for a stale hand
GAP_RATIO = 5.0  # nothing was seen in a gap longer than GAP_S and 5 usual gaps
# a take begins or ends in motion if this first or last time is faster than EDGE_SPEED_MPS
EDGE_S = 0.3
EDGE_SPEED_MPS = 0.1
BLOCKS = "▁▂▃▄▅▆▇█"
PLOT_COLUMNS = 60  # characters in a line of the speed plot
TRACK_COLOURS = {name: palette.written(colour) for name, colour in palette.BY_TRACK.items()}


class DemonstrationNameError(RecordingError):
    """A take does not exist, exists already, or has an invalid name."""


class StreamSummary(NamedTuple):
    """One stream of a take: number of poses, rate while seen [Hz], duration of the longest gap [s],
    begin of that gap [s after the first sample], and the poses' frame.
    """

    name: str
    poses: int
    rate_hz: float
    gap_s: float
    gap_at_s: float
    frame: str


class Summary(NamedTuple):
    """The content of a take: the demonstration as learning reads it, its streams, and remarks."""

    path: Path
    demonstration: Demonstration
    streams: tuple[StreamSummary, ...]
    remarks: tuple[str, ...]

    @property
    def lasts_s(self) -> float:
        """Duration that hands and tool have in common [s]."""
        return float(np.ptp(self.demonstration.stamps_ns)) / 1e9


def path_of(folder: Path, name: str) -> Path:
    """The path of a take of this name. Raises DemonstrationNameError."""
    name = name.removesuffix(".mcap")
    if not re.fullmatch(NAME, name):
        raise DemonstrationNameError(
            f"{name!r}: 1 to 64 letters, digits, spaces and . _ - accepted as a take's name"
        )
    return folder / f"{name}.mcap"


def existing_path(folder: Path, name: str) -> Path:
    """The path of a take that exists. Raises DemonstrationNameError."""
    path = path_of(folder, name)
    if not path.is_file():
        paths = demonstration_paths(folder) if folder.is_dir() else []
        names = ", ".join(take_path.stem for take_path in paths) or "none"
        raise DemonstrationNameError(f"no take {path.stem!r} in {folder}; its takes: {names}")
    return path


def demonstration_paths(folder: Path) -> list[Path]:
    """The files of the takes in a folder, sorted by number: `take-2` before `take-10`. Raises
    OSError.
    """
    # glob finds nothing where it may not read
    paths = [path for path in folder.iterdir() if path.suffix == ".mcap"]
    return sorted(
        paths,
        key=lambda path: [int(x) if x.isdigit() else 0 for x in re.split(r"(\d+)", path.stem)],
    )


def summary(path: Path, *, settings: Settings | None = None) -> Summary:
    """The content of a take, read with `settings` or those in the file. Raises RecordingError."""
    remarks: list[str] = []
    demonstration = read_demonstration(path, settings=settings, say=remarks.append)
    remarks = [line.removeprefix(f"{path}: ") for line in remarks]
    recorded = PoseRecording(path)
    tracks = chosen(recorded, {}, settings or recorded.settings or Settings()).tracks
    sides = [
        side for side in TRACK_NAMES if side == "tool" or demonstration.conducts in ("both", side)
    ]
    streams = tuple(
        _stream(side, track)
        for side, track in zip(TRACK_NAMES, tracks, strict=True)
        if side in sides
    )
    remarks += [
        *_still(demonstration),
        *_in_motion(demonstration, sides),
        *remarks_on_via_points(demonstration),
    ]
    return Summary(path, demonstration, streams, tuple(remarks))


def _still(demonstration: Demonstration) -> list[str]:
    """Remarks on hands or a tool that do not move."""
    motions = (("hands", demonstration.hands), ("tool", demonstration.tool[:, :3]))
    moved = [(name, float(np.ptp(positions_m, axis=0).max())) for name, positions_m in motions]
    return [
        f"{name}: only {1000 * m:.1f} mm of motion; nothing can be learned if all takes have less "
        f"than {1000 * LEAST_M:g} mm"
        for name, m in moved
        if m < LEAST_M
    ]


def _in_motion(demonstration: Demonstration, shown: Sequence[str]) -> list[str]:
    """Remarks on hands or a tool that are in motion when a take begins or ends."""
    out = []
    seconds = demonstration.seconds
    for when, span in (("begins", seconds <= EDGE_S), ("ends", seconds >= seconds[-1] - EDGE_S)):
        speeds = {
            side: _mean_speed(seconds[span], getattr(demonstration, side)[span, :3])
            for side in shown
        }
        if moving := [
            f"{side} {speed:.2f} m/s" for side, speed in speeds.items() if speed > EDGE_SPEED_MPS
        ]:
            out.append(
                f"it {when} in motion: {', '.join(moving)}; let hands and tool rest before and "
                "after the task"
            )
    return out


def _mean_speed(seconds: Vector, at: Vector) -> float:
    """Speed [m/s] of the line that fits positions (N, 3) [m] best."""
    if len(seconds) < 2:
        return 0.0
    return float(np.linalg.norm(np.polyfit(seconds - seconds[0], at, 1)[0]))


def _stream(side: str, track: Track) -> StreamSummary:
    logged = np.sort(track.logged_ns) / 1e9
    gaps = np.diff(logged, prepend=logged[:1])
    worst = int(np.argmax(gaps))
    usual_gaps = (
        gaps[1:][gaps[1:] <= max(GAP_S, GAP_RATIO * float(np.median(gaps[1:])))]
        if len(gaps) > 1
        else gaps[1:]
    )
    rate = len(usual_gaps) / float(usual_gaps.sum()) if usual_gaps.any() else 0.0
    began = float(logged[max(0, worst - 1)] - logged[0])
    return StreamSummary(side, len(logged), rate, float(gaps[worst]), began, track.frame)


def table(found: Summary) -> str:
    """The content of a take as lines of text, with a plot of speeds."""
    lines = [f"{found.path}: {found.lasts_s:.1f} s"]
    lines += [
        f"  {stream.name:<6}{stream.poses:>7} poses  {stream.rate_hz:6.1f} Hz  longest gap "
        f"{1e3 * stream.gap_s:.0f} ms at {stream.gap_at_s:.1f} s  frame "
        f"{stream.frame or 'not named'}"
        for stream in found.streams
    ]
    if found.demonstration.person:
        lines.append(f"  by {found.demonstration.person}")
    if found.demonstration.via_points:
        lines.append(
            f"  via-points {', '.join(point.name for point in found.demonstration.via_points)}"
        )
    lines += [f"  {remark}" for remark in found.remarks]
    speeds = {stream.name: _speed(found.demonstration, stream.name) for stream in found.streams}
    lines += [
        f"  {side:<6}{_blocks(speed)}  up to {np.max(speed, initial=0.0):.2f} m/s"
        for side, speed in speeds.items()
    ]
    end = f"{found.lasts_s:.1f} s"
    lines.append(f"  speed {'0 s':<{PLOT_COLUMNS - len(end)}}{end}")
    return "\n".join(lines)


def _speed(demonstration: Demonstration, side: str) -> Vector:
    """Speeds (PLOT_COLUMNS,) [m/s] of equal parts of a take, each averaged over 0.1 s."""
    positions_m: Vector = getattr(demonstration, side)[:, :3]
    seconds = (demonstration.stamps_ns - demonstration.stamps_ns[0]) / 1e9
    edges = np.linspace(0.0, seconds[-1], PLOT_COLUMNS + 1)
    window = min(0.1, float(seconds[-1]))
    grid = np.arange(0.0, max(seconds[-1] - window, window), window / 2)
    begin, end = (
        np.stack([np.interp(grid + late, seconds, column) for column in positions_m.T], axis=1)
        for late in (0.0, window)
    )
    speeds = np.linalg.norm(end - begin, axis=1) / window
    return np.asarray(np.interp((edges[:-1] + edges[1:]) / 2, grid + window / 2, speeds))


def _blocks(speed: Vector) -> str:
    greatest = max(float(np.max(speed)), 0.05)  # noise at rest is drawn flat
    return "".join(
        BLOCKS[min(int(len(BLOCKS) * value / greatest), len(BLOCKS) - 1)] for value in speed
    )


def draw(found: Summary, path: Path) -> None:
    """Write a picture of a take as PNG: positions over time with shaded gaps, and from above."""
    from matplotlib.figure import Figure  # its import is slow, and most commands draw nothing

    figure = Figure(figsize=(11, 6.5), layout="constrained", dpi=110)
    grid = figure.add_gridspec(3, 2, width_ratios=(3, 2))
    demonstration = found.demonstration
    seconds = (demonstration.stamps_ns - demonstration.stamps_ns[0]) / 1e9
    first = figure.add_subplot(grid[0, 0])
    axes = [first, *(figure.add_subplot(grid[i, 0], sharex=first) for i in (1, 2))]
    above = figure.add_subplot(grid[:, 1])
    begins = list(demonstration.begins)
    for side in (stream.name for stream in found.streams):
        # breaks the line where a part is left out
        positions_m = np.insert(getattr(demonstration, side), begins, np.nan, axis=0)
        for i, axis in enumerate(axes):
            axis.plot(
                np.insert(seconds, begins, np.nan),
                positions_m[:, i],
                color=TRACK_COLOURS[side],
                lw=1.2,
                label=side,
            )
        above.plot(
            positions_m[:, 0], positions_m[:, 1], color=TRACK_COLOURS[side], lw=1.2, label=side
        )
        above.plot(positions_m[0, 0], positions_m[0, 1], "o", color=TRACK_COLOURS[side], ms=5)
    for i, axis in enumerate(axes):
        axis.set_ylabel(f"{'xyz'[i]} [m]")
        axis.label_outer()
        for stream in found.streams:
            if stream.gap_s > GAP_S:
                axis.axvspan(
                    stream.gap_at_s,
                    stream.gap_at_s + stream.gap_s,
                    color=TRACK_COLOURS[stream.name],
                    alpha=0.15,
                    lw=0,
                )
    axes[0].set_title(f"{found.path.stem}: {found.lasts_s:.1f} s, frame base", parse_math=False)
    axes[-1].set_xlabel("time [s]")
    above.set(title="from above; dots mark the start", xlabel="x [m]", ylabel="y [m]")
    above.set_aspect("equal", adjustable="datalim")
    above.legend(frameon=False)
    figure.savefig(path)


def uncut(path: Path) -> Path:
    """The path of a take's original before trimming; `learn *.mcap` does not match it."""
    return path.with_name(f"{path.name}.uncut")


def trim(path: Path, start_s: float, end_s: float) -> str:
    """Trim a take to the time from `start_s` to `end_s` [s] after its first sample, all or nothing,
    and return a message on the result.

    Messages other than poses and joints are kept. The original is kept at the path that `uncut`
    returns, unless that exists already. Raises RecordingError if too little to learn from would be
    left.
    """
    messages = Messages(path)
    rows = list(messages)
    if messages.faults:
        raise RecordingError(f"{path}: {'; '.join(map(str, messages.faults))}; it was not trimmed")
    samples = [row for row in rows if row[0] and row[0].name in SAMPLE_TYPES]
    times_ns = [message.log_time for _, _, message in samples] or [0]
    begin_ns = min(times_ns)
    lasts_s = (max(times_ns) - begin_ns) / 1e9
    kept_s = [t for t in ((ns - begin_ns) / 1e9 for ns in times_ns) if start_s <= t <= end_s]
    if len(kept_s) == len(times_ns):
        return f"nothing was cut: {path} lasts {lasts_s:.1f} s"

    joints = _count_joints(samples)
    original = uncut(path)
    existed = original.exists()
    with whole_file(path, joints=joints) as file:
        _copy(messages, rows, file, begin_ns, (start_s, end_s))
        file.close()
        _check_trimmed(path, file, lasts_s, (start_s, end_s))
        if not existed:
            path.replace(original)
    cut = f"{lasts_s:.1f} s cut to {max(kept_s) - min(kept_s):.1f} s"
    return f"{cut}; the uncut take is {'still' if existed else 'kept as'} {original}"


def _count_joints(samples: Sequence[Found]) -> int:
    """The number of joints in a take's first joint state; 0 without any."""
    for schema, _, message in samples:
        if schema and schema.name == JOINTS.type:
            return len(JOINTS.decode(message.data).names)
    return 0


def _copy(
    messages: Messages,
    rows: Sequence[Found],
    file: McapFile,
    begin_ns: int,
    span_s: tuple[float, float],
) -> None:
    """Copy metadata, attachments and messages of a take, see `_put_trimmed`."""
    for name, content in messages.metadata.items():
        file.writer.add_metadata(name, content)
    for name, data in messages.attachments.items():
        file.attach(name, data, begin_ns)
    for row in rows:
        _put_trimmed(messages.path, file, row, begin_ns, span_s)


def _put_trimmed(
    path: Path, file: McapFile, row: Found, begin_ns: int, span_s: tuple[float, float]
) -> None:
    """Write a message of a take, unless it is a sample outside a span of time [s] from its begin.
    Raises RecordingError for one that a take does not have.
    """
    schema, channel, message = row
    if schema is None or channel.message_encoding != "cdr":
        raise RecordingError(f"{path}: {channel.topic} is no stream of a take; it was not trimmed")
    start_s, end_s = span_s
    at_s = (message.log_time - begin_ns) / 1e9
    if schema.name in SAMPLE_TYPES and not start_s <= at_s <= end_s:
        return
    try:
        file.put(channel.topic, schema.name, message.data, message.log_time, message.sequence)
    except KeyError as error:
        raise RecordingError(
            f"{path}: a take has no messages of type {error}; it was not trimmed"
        ) from None


def _check_trimmed(path: Path, file: McapFile, lasts_s: float, span_s: tuple[float, float]) -> None:
    """Raise RecordingError if too little to learn from is left of a take of `lasts_s` [s]."""
    try:
        summary(file.path)
    except RecordingError:
        raise RecordingError(
            f"{path} lasts {lasts_s:.1f} s: from {span_s[0]:g} to {span_s[1]:g} s too little is "
            "left to learn from, so it was not trimmed"
        ) from None
