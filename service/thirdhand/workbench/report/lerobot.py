"""Recordings as a data set of LeRobot, version 3.0: joints and hands seen, images, the segment of
the task, joints and gripper commanded.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any
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
HANDS = [f"{side}_{axis}" for side in ("left", "right") for axis in "xyz"]
FILE = "chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
VIDEO = "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4"
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
                frames["hands"][rows].reshape(-1, len(HANDS)),
                frames["joints"][rows],
            )
            part: Episode = {
                name: value.astype(np.float32) for name, value in zip(FEATURES, values, strict=True)
            }
            part["action.gripper"] = frames["closure"][rows].astype(np.float32)
            part["observation.segment"] = np.where(
                frames["segment_belief"][rows] > 0, frames["segment"][rows], -1
            )
            yield part | {
                "times_ns": found.times_ns[found.ticks.searchsorted(frames["tick"][rows])]
            }


def write(recordings: Sequence[Columns], folder: Path, *, fps: int, task: str) -> tuple[int, int]:
    """Write a data set of one task to a new folder; return the numbers of episodes and rows.

    Raises ExplainedError if arms differ, or if there is no episode.
    """
    pairs = [
        (columns.recording, part) for columns in recordings for part in episodes(columns, fps=fps)
    ]
    parts = [part for _, part in pairs]
    camera_rows = [
        CameraRows(recording, part.pop("times_ns").astype(np.int64)) for recording, part in pairs
    ]
    arm_specs = [
        (columns.recording.urdf, columns.recording.settings.joints.names) for columns in recordings
    ]
    arms = {(ElementTree.fromstring(urdf).get("name"), names) for urdf, names in arm_specs}
    if len(arms) > 1 or not parts:
        why = (
            "one arm is needed" if parts else "nothing was commanded after both hands had been seen"
        )
        raise ExplainedError(f"no data set is written: {why}")
    ends = [0, *itertools.accumulate(len(part["action"]) for part in parts)]
    for i, part in enumerate(parts):
        row = np.arange(ends[i + 1] - ends[i])
        part |= {
            "timestamp": (row / fps).astype(np.float32),
            "frame_index": row,
            "episode_index": np.full_like(row, i),
        }
        part |= {"index": row + ends[i], "task_index": np.zeros_like(row)}
    whole = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    ((arm, joints),) = arms
    names = dict(zip(FEATURES, (joints, HANDS, joints), strict=True))
    first = FILE.format(chunk_index=0, file_index=0)

    def video_of(key: str) -> Path:
        return folder / VIDEO.format(video_key=_named(key), chunk_index=0, file_index=0)

    videos = {
        _named(key): video for key, video in write_videos(camera_rows, video_of, fps=fps).items()
    }
    info = {
        "codebase_version": "v3.0",
        "robot_type": arm,
        "fps": fps,
        "splits": {"train": f"0:{len(parts)}"},
        "total_episodes": len(parts),
        "total_frames": ends[-1],
        "total_tasks": 1,
        "chunks_size": 1000,
        "data_files_size_in_mb": 100,
        "video_files_size_in_mb": 200,
        "data_path": f"data/{FILE}",
        "video_path": VIDEO if videos else None,
        "features": {
            name: {
                "dtype": str(column.dtype),
                "shape": column.shape[1:] or (1,),
                "names": names.get(name),
            }
            for name, column in whole.items()
        }
        | {name: feature for name, (feature, _) in videos.items()},
    }
    about = [
        {"episode_index": i, "tasks": [task], "length": len(part["action"])}
        | {"dataset_from_index": ends[i], "dataset_to_index": ends[i + 1]}
        | {
            f"{of}/{number}_index": 0
            for of in ("data", "meta/episodes")
            for number in ("chunk", "file")
        }
        | {f"videos/{name}/{number}_index": 0 for name in videos for number in ("chunk", "file")}
        | {
            f"videos/{name}/{side}_timestamp": ends[i + k] / fps
            for name in videos
            for k, side in enumerate(("from", "to"))
        }
        | {
            f"stats/{name}/{kind}": value
            for name, kinds in (
                _statistics(part) | _video_statistics(videos, slice(i, i + 1))
            ).items()
            for kind, value in kinds.items()
        }
        for i, part in enumerate(parts)
    ]
    text = {
        "name": "task",
        "field_name": "task",
        "pandas_type": "unicode",
        "numpy_type": "object",
        "metadata": None,
    }
    as_index = msgspec.json.encode(
        {"index_columns": ["task"], "columns": [text], "column_indexes": []}
    )  # for pandas
    tasks = pa.table({"task_index": [0], "task": [task]}).replace_schema_metadata(
        {"pandas": as_index}
    )
    meta = folder / "meta"
    _write(folder / "data" / first, *(_table(part) for part in parts))
    _write(meta / "episodes" / first, pa.Table.from_pylist(about))
    _write(meta / "tasks.parquet", tasks)
    (meta / "info.json").write_bytes(msgspec.json.encode(info))
    statistics = _statistics(whole) | _video_statistics(videos, slice(None))
    (meta / "stats.json").write_bytes(msgspec.json.encode(statistics))
    return len(parts), ends[-1]


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
