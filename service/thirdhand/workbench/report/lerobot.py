"""Recordings as a data set of LeRobot, version 3.0: joints and hands seen, images, the segment of
the task, joints and gripper commanded.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple
from xml.etree import ElementTree

import msgspec
import numpy as np
import pyarrow as pa
from numpy.typing import NDArray
from pyarrow import parquet

from thirdhand.contract import cdr
from thirdhand.contract.explain import ExplainedError
from thirdhand.core.intake.arm_samples import in_turn
from thirdhand.workbench.report.camera_video import CameraRows, write_videos
from thirdhand.workbench.report.columns import Columns, runs

FEATURES = ("observation.state", "observation.environment_state", "action")
HAND_FEATURES = [f"{side}_{axis}" for side in ("left", "right") for axis in "xyz"]
FILE = "chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
VIDEO = "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4"
CLOSURE_COLUMN = "action.gripper"
QUANTILES = (0.01, 0.1, 0.5, 0.9, 0.99)
Episode = dict[str, NDArray[np.float32 | np.int64]]


def episodes(found: Columns, *, fps: int) -> Iterator[Episode]:
    """The parts of a recording without gaps in which commands were sent and both hands had been
    seen: the `FEATURES` by name, a row every 1/fps s, from the newest tick. With them `times_ns`
    (N,), `action.gripper` (N,), the predicted closure, -1 if the skill has no gripper, and
    `observation.segment` (N,), the number of the most probable segment, -1 without one.

    Joints are those of the newest joint state; before the first one, the previous command.
    """
    joint_settings = found.recording.settings.joints
    frames = found.frames
    names = joint_settings.names
    states = {-1: [np.nan] * len(names)}
    for step in found.recording.steps(outputs=False):
        for state in (
            cdr.decode_joints(payload) for kind, payload in step.events if kind == "joints/state"
        ):
            by_name = dict(zip(state.names, state.position, strict=False))
            states[step.tick] = [by_name.get(name, np.nan) for name in names]
    ticks = np.array([*states])
    joints = np.array([*states.values()])
    parts = np.repeat(np.arange(len(found.breaks) + 1), np.diff([0, *found.breaks, len(frames)]))
    ready = (frames["commanded"] != 0) & (frames["hand_ages"] >= 0).all(axis=1)
    for begin, end in runs(np.where(ready, parts, -1)):
        if ready[begin]:
            times = found.times[begin:end] - found.times[begin]
            rows = (
                begin
                - 1
                + times.searchsorted(np.arange(0.0, times[-1] + 1e-6, 1 / fps) + 1e-6, side="right")
            )
            measured_joints = joints[ticks.searchsorted(frames["tick"][rows], side="right") - 1]
            measured_joints = np.where(
                np.isnan(measured_joints),
                frames["joints"][np.maximum(rows - 1, begin)],
                measured_joints,
            )
            measured_joints = in_turn(joint_settings, measured_joints, frames["joints"][rows])
            values = (
                measured_joints,
                frames["hands"][rows].reshape(-1, len(HAND_FEATURES)),
                frames["joints"][rows],
            )
            part: Episode = {
                name: value.astype(np.float32) for name, value in zip(FEATURES, values, strict=True)
            }
            part[CLOSURE_COLUMN] = frames["closure"][rows].astype(np.float32)
            part["observation.segment"] = np.where(
                frames["segment_belief"][rows] > 0, frames["segment"][rows], -1
            )
            yield part | {
                "times_ns": found.times_ns[found.ticks.searchsorted(frames["tick"][rows])]
            }


class _DataSet(NamedTuple):
    """The episodes of one arm, the row at which each begins and the last ends, and the feature of
    each video with sampled pixels of each episode.
    """

    arm: str | None
    joints: tuple[str, ...]
    episodes: Sequence[Episode]
    ends: Sequence[int]
    videos: Mapping[str, tuple[dict[str, Any], list[Any]]]
    fps: int

    def info(self, columns: Episode) -> dict[str, Any]:
        """The description of the data set with these columns."""
        names = dict(zip(FEATURES, (self.joints, HAND_FEATURES, self.joints), strict=True))
        features = {
            name: {
                "dtype": str(column.dtype),
                "shape": column.shape[1:] or (1,),
                "names": names.get(name),
            }
            for name, column in columns.items()
        }
        return {
            "codebase_version": "v3.0",
            "robot_type": self.arm,
            "fps": self.fps,
            "splits": {"train": f"0:{len(self.episodes)}"},
            "total_episodes": len(self.episodes),
            "total_frames": self.ends[-1],
            "total_tasks": 1,
            "chunks_size": 1000,
            "data_files_size_in_mb": 100,
            "video_files_size_in_mb": 200,
            "data_path": f"data/{FILE}",
            "video_path": VIDEO if self.videos else None,
            "features": features | {name: feature for name, (feature, _) in self.videos.items()},
        }

    def about(self, i: int, task: str) -> dict[str, Any]:
        """The description of an episode: its rows, its files and its statistics."""
        begin, end = self.ends[i : i + 2]
        row = {
            "episode_index": i,
            "tasks": [task],
            "length": end - begin,
            "dataset_from_index": begin,
            "dataset_to_index": end,
        }
        files = ("data", "meta/episodes", *(f"videos/{name}" for name in self.videos))
        row |= {f"{file}/{number}_index": 0 for file in files for number in ("chunk", "file")}
        for name in self.videos:
            row[f"videos/{name}/from_timestamp"] = begin / self.fps
            row[f"videos/{name}/to_timestamp"] = end / self.fps
        statistics = self.statistics(self.episodes[i], slice(i, i + 1))
        return row | {
            f"stats/{name}/{kind}": value
            for name, kinds in statistics.items()
            for kind, value in kinds.items()
        }

    def statistics(self, columns: Episode, episodes: slice) -> dict[str, dict[str, Any]]:
        """The statistics of columns and of the videos of these episodes."""
        return _statistics(columns) | _video_statistics(self.videos, episodes)


class Written(NamedTuple):
    """The size of a data set."""

    episodes: int
    rows: int
    constant_closure: float | None  # value of `action.gripper`, which is left out; None: it is kept


def write(recordings: Sequence[Columns], folder: Path, *, fps: int, task: str) -> Written:
    """Write a data set of one task to a new folder; return its size. A closure that never changes
    is left out: policies divide by its deviation.

    Raises ExplainedError if arms differ, or if there is no episode.
    """
    parts: list[Episode] = []
    camera_rows: list[CameraRows] = []
    for columns in recordings:
        for part in episodes(columns, fps=fps):
            times_ns = part.pop("times_ns").astype(np.int64)
            camera_rows.append(CameraRows(columns.recording, times_ns))
            parts.append(part)
    arm, joints = _arm_of(recordings, parts)
    constant_closure = _take_constant_closure(parts)
    ends = [0, *itertools.accumulate(len(part["action"]) for part in parts)]
    for i, part in enumerate(parts):
        part.update(_indices(i, ends, fps))
    data_set = _DataSet(arm, joints, parts, ends, _videos(camera_rows, folder, fps), fps)
    _write_data_set(data_set, folder, task)
    return Written(len(parts), ends[-1], constant_closure)


def _take_constant_closure(parts: Sequence[Episode]) -> float | None:
    """Remove the closure from all episodes if it is one value; that value, None if it changes."""
    values = np.unique(np.concatenate([part[CLOSURE_COLUMN] for part in parts]))
    if len(values) > 1:
        return None
    for part in parts:
        del part[CLOSURE_COLUMN]
    return float(values[0])


def _arm_of(
    recordings: Sequence[Columns], parts: Sequence[Episode]
) -> tuple[str | None, tuple[str, ...]]:
    """The name of the arm and those of its joints. Raises ExplainedError if arms differ, or without
    an episode.
    """
    arms = {
        (
            ElementTree.fromstring(columns.recording.urdf).get("name"),
            columns.recording.settings.joints.names,
        )
        for columns in recordings
    }
    if len(arms) > 1 or not parts:
        why = (
            "one arm is needed" if parts else "nothing was commanded after both hands had been seen"
        )
        raise ExplainedError(f"no data set is written: {why}")
    return arms.pop()


def _indices(i: int, ends: Sequence[int], fps: int) -> Episode:
    """The columns of time and place of episode `i` in the data set."""
    row = np.arange(ends[i + 1] - ends[i])
    return {
        "timestamp": (row / fps).astype(np.float32),
        "frame_index": row,
        "episode_index": np.full_like(row, i),
        "index": row + ends[i],
        "task_index": np.zeros_like(row),
    }


def _videos(
    camera_rows: Sequence[CameraRows], folder: Path, fps: int
) -> dict[str, tuple[dict[str, Any], list[Any]]]:
    """Write the videos; the results of `write_videos`, by the names of the features."""

    def video_of(key: str) -> Path:
        return folder / VIDEO.format(video_key=_named(key), chunk_index=0, file_index=0)

    videos = write_videos(camera_rows, video_of, fps=fps)
    return {_named(key): video for key, video in videos.items()}


def _write_data_set(data_set: _DataSet, folder: Path, task: str) -> None:
    """Write all files but the videos."""
    parts = data_set.episodes
    columns = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    about = [data_set.about(i, task) for i in range(len(parts))]
    first = FILE.format(chunk_index=0, file_index=0)
    meta = folder / "meta"
    _write(folder / "data" / first, *(_table(part) for part in parts))
    _write(meta / "episodes" / first, pa.Table.from_pylist(about))
    _write(meta / "tasks.parquet", _tasks(task))
    (meta / "info.json").write_bytes(msgspec.json.encode(data_set.info(columns)))
    statistics = data_set.statistics(columns, slice(None))
    (meta / "stats.json").write_bytes(msgspec.json.encode(statistics))


def _tasks(task: str) -> pa.Table:
    """The table of the task, with the index that pandas reads."""
    text = {
        "name": "task",
        "field_name": "task",
        "pandas_type": "unicode",
        "numpy_type": "object",
        "metadata": None,
    }
    as_index = msgspec.json.encode(
        {"index_columns": ["task"], "columns": [text], "column_indexes": []}
    )
    tasks = pa.table({"task_index": [0], "task": [task]})
    return tasks.replace_schema_metadata({"pandas": as_index})


def _named(key: str) -> str:
    """The name of a camera's feature."""
    return f"observation.images.{key.replace('/', '_')}"


def _write(path: Path, *groups: pa.Table) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    with parquet.ParquetWriter(path, groups[0].schema) as writer:
        for group in groups:
            writer.write_table(group)


def _table(part: Episode) -> pa.Table:
    flat = {name: pa.array(column.ravel()) for name, column in part.items()}
    return pa.table(
        flat
        | {
            name: pa.FixedSizeListArray.from_arrays(flat[name], part[name].shape[1])
            for name in FEATURES
        }
    )


def _statistics(columns: Episode) -> dict[str, dict[str, list[float]]]:
    statistics: dict[str, dict[str, list[float]]] = {}
    for name, column in columns.items():
        rows = column.reshape(len(column), -1).astype(np.float64)
        statistics[name] = {
            kind: getattr(rows, kind)(axis=0).tolist() for kind in ("min", "max", "mean", "std")
        }
        statistics[name] |= {
            f"q{round(100 * q):02d}": np.quantile(rows, q, axis=0).tolist() for q in QUANTILES
        }
        statistics[name]["count"] = [len(rows)]
    return statistics


def _video_statistics(
    videos: Mapping[str, tuple[Any, list[Any]]], episodes: slice
) -> dict[str, dict[str, Any]]:
    """Statistics of the colours, 0 to 1, as (3, 1, 1) of sampled pictures."""
    statistics: dict[str, dict[str, Any]] = {}
    for name, (_, sampled) in videos.items():
        pictures = [picture for episode in sampled[episodes] for picture in episode]
        kinds = _statistics({name: np.concatenate(pictures)})[name]
        statistics[name] = {kind: [[[value]] for value in values] for kind, values in kinds.items()}
        statistics[name]["count"] = [len(pictures)]
    return statistics
