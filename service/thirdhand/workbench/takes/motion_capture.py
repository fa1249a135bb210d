"""Reading of motion capture files: CSV as Motive exports it, and C3D.

Poses are in metres in the axes of the capture system; markers have no rotation.
"""

from __future__ import annotations

import csv
import itertools
from pathlib import Path

import numpy as np

from thirdhand.contract.explain import in_words
from thirdhand.core.frame import Vector
from thirdhand.recordings.mcap_file import RecordingError

CAPTURE_FRAME = "motion capture"
UNITS_M = {
    "meters": 1.0,
    "centimeters": 0.01,
    "millimeters": 0.001,
    "m": 1.0,
    "cm": 0.01,
    "mm": 0.001,
}
# columns of these types are read; markers of a body are ignored
POSED_TYPES = ("Rigid Body", "Bone", "Marker")
POSE_COLUMNS = tuple(("Position", axis) for axis in "XYZ") + tuple(
    ("Rotation", axis) for axis in "XYZW"
)
NO_ROTATION = (0.0, 0.0, 0.0, 1.0)
BIG_ENDIAN = 86  # number of the processor type in a C3D file with this byte order
MAX_FRAME_TIME_S = 1e9  # 30 years: a later frame is a mistake in the file

Captured = dict[str, tuple[list[int], Vector]]
"""Stamps (N,) [ns] and poses (N, 7) [m] by the name of a body or marker; NaN if it is not seen."""


def read_motive(path: Path) -> Captured:
    """The rigid bodies, bones and single markers of a take exported by Motive. Raises
    RecordingError.
    """
    try:
        with path.open(newline="", encoding="utf-8-sig") as stream:
            begin = stream.readline()
            separator = next(
                (mark for mark in ";\t" if begin.startswith(f"Format Version{mark}")), ","
            )
            rows = [
                row
                for row in csv.reader(itertools.chain([begin], stream), delimiter=separator)
                if any(row)
            ]
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise RecordingError(
            f"{path} is not a CSV file that can be read: {in_words(error, named=False)}"
        ) from None
    about = dict(zip(rows[0][::2], rows[0][1::2], strict=False)) if rows else {}
    axes_at = next((i for i, row in enumerate(rows) if row[0] == "Frame"), 0)
    if "Format Version" not in about or axes_at < 4:
        raise RecordingError(
            f"{path} is not a CSV file as Motive exports it (Format Version in its first row, "
            "Frame in the row above the numbers). Other tables become takes from arrays: "
            "docs/arrays.md"
        )
    unit = about.get("Length Units", "").lower()
    if unit not in UNITS_M or about.get("Rotation Type", "Quaternion") != "Quaternion":
        raise RecordingError(
            f"{path}: Length Units {about.get('Length Units')!r}, Rotation Type "
            f"{about.get('Rotation Type')!r}; export it in Meters, Centimeters or Millimeters, "
            "with Rotation Type Quaternion"
        )
    labelled = {
        row[1]: row for row in rows[1:axes_at] if len(row) > 1 and row[1] in ("Type", "Name")
    }
    types = labelled.get("Type", rows[1])
    names = labelled.get("Name", rows[2])
    columns: dict[str, dict[tuple[str, str], int]] = {}
    for i, head in enumerate(zip(types, names, rows[axes_at - 1], rows[axes_at], strict=False)):
        if head[0] in POSED_TYPES and head[2:] in POSE_COLUMNS:
            columns.setdefault(head[1], {})[head[2:]] = i
    table = np.full((len(rows) - axes_at - 1, len(rows[axes_at])), np.nan)
    # others may hold text, as a time code
    numeric = [1, *(i for body_columns in columns.values() for i in body_columns.values())]
    for values, row in zip(table, rows[axes_at + 1 :], strict=True):
        try:
            for i in numeric:
                if i < len(row) and row[i]:
                    values[i] = float(row[i] if separator == "," else row[i].replace(",", "."))
        except ValueError as error:
            raise RecordingError(
                f"{path}: frame {row[0]}: {error}; numbers and empty cells needed"
            ) from None
    stamps = _stamps(path, table[:, 1])
    out = Captured()
    for name, body_columns in columns.items():
        if all(column in body_columns for column in POSE_COLUMNS[:3]):
            poses = np.tile([np.nan] * 3 + list(NO_ROTATION), (len(table), 1))
            for k, column in enumerate(POSE_COLUMNS):
                if column in body_columns:
                    poses[:, k] = table[:, body_columns[column]] * (UNITS_M[unit] if k < 3 else 1.0)
            out[name] = stamps, poses
    return out


def read_c3d(path: Path) -> Captured:
    """The markers of a C3D file. Raises RecordingError."""
    import ezc3d  # its import is slow, and few recordings need it

    try:
        content = ezc3d.c3d(str(path))
        about = content["parameters"]["POINT"]
        labels = about["LABELS"]["value"]
        units = about["UNITS"]["value"]
        rate_hz = float(about["RATE"]["value"][0])
        points = np.asarray(content["data"]["points"], np.float64)
    except Exception as error:  # the library raises many kinds of exceptions
        raise RecordingError(
            f"{path} is not a C3D file that can be read: {in_words(error, named=False)}"
        ) from None
    unit = str(units[0]).strip().lower() if units else ""
    if unit not in UNITS_M or not rate_hz > 0:
        raise RecordingError(
            f"{path}: unit {unit!r}, {rate_hz:g} Hz; m, cm or mm needed, and a rate above 0"
        )
    raw = path.read_bytes()
    order = ">u2" if raw[512 * (raw[0] - 1) + 3] == BIG_ENDIAN else "<u2"
    # words 4 and 5 are the numbers of the first and last frame
    head = np.frombuffer(raw[:10], order)
    announced = int(head[4]) - int(head[3]) + 1
    if announced > points.shape[2]:
        raise RecordingError(
            f"{path} was cut: it holds {points.shape[2]} of {announced} frames; copy or export it "
            "again"
        )
    stamps = _stamps(path, np.arange(points.shape[2]) / rate_hz)
    turned = np.tile(NO_ROTATION, (points.shape[2], 1))
    names = [str(label).strip() for label in labels[: points.shape[1]]]
    return {
        # Names that occur several times are numbered, so that none of them is found by its bare
        # name.
        f"{name} {names[:i].count(name) + 1}" if names.count(name) > 1 else name: (
            stamps,
            np.hstack([UNITS_M[unit] * points[:3, i].T, turned]),
        )
        for i, name in enumerate(names)
    }


def _stamps(path: Path, seconds: Vector) -> list[int]:
    """Stamps [ns] of the times (N,) [s] of a take's frames. Raises RecordingError."""
    if not len(seconds):
        raise RecordingError(
            f"{path} holds no frame, 2 needed: export the take again, over all its frames"
        )
    for i in np.flatnonzero(~(np.abs(seconds) <= MAX_FRAME_TIME_S))[:1]:
        raise RecordingError(
            f"{path}: frame {i + 1} of {len(seconds)} is at {seconds[i]:g} s, up to "
            f"{MAX_FRAME_TIME_S:g} s needed: export the take again"
        )
    for i in np.flatnonzero(np.diff(seconds) < 0)[:1]:
        raise RecordingError(
            f"{path}: frame {i + 2} of {len(seconds)} is at {seconds[i + 1]:g} s, and the one "
            f"before at {seconds[i]:g} s; times that grow needed: export the take again"
        )
    stamps: list[int] = np.round(1e9 * seconds).astype(np.int64).tolist()
    return stamps
