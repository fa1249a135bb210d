"""Reading of motion capture files: CSV as Motive exports it, and C3D.

Poses are in metres in the axes of the capture system; markers have no rotation.
"""

from __future__ import annotations

import csv
import itertools
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple, Self

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


class _Motive(NamedTuple):
    """A take of Motive as text: its rows, its header, the number of the row with the columns' axes,
    below which the frames begin, and whether decimals have a comma.
    """

    path: Path
    rows: list[list[str]]
    about: Mapping[str, str]
    axes_row: int
    has_decimal_commas: bool

    @classmethod
    def of(cls, path: Path) -> Self:
        """The rows of a file that are not empty. Raises RecordingError."""
        try:
            with path.open(newline="", encoding="utf-8-sig") as stream:
                begin = stream.readline()
                separator = next(
                    (mark for mark in ";\t" if begin.startswith(f"Format Version{mark}")), ","
                )
                table = csv.reader(itertools.chain([begin], stream), delimiter=separator)
                rows = [*filter(any, table)]
        except (OSError, UnicodeDecodeError, csv.Error) as error:
            raise RecordingError(
                f"{path} is not a CSV file that can be read: {in_words(error, named=False)}"
            ) from None
        about = dict(zip(rows[0][::2], rows[0][1::2], strict=False)) if rows else {}
        axes_row = next((i for i, row in enumerate(rows) if row[0] == "Frame"), 0)
        return cls(path, rows, about, axes_row, separator != ",")

    def unit_m(self) -> float:
        """The unit of positions [m]. Raises RecordingError if this is no export of Motive, or with
        an unknown unit or rotations that are no quaternions.
        """
        if "Format Version" not in self.about or self.axes_row < 4:
            raise RecordingError(
                f"{self.path} is not a CSV file as Motive exports it (Format Version in its first "
                "row, Frame in the row above the numbers). Other tables become takes from arrays: "
                "docs/arrays.md"
            )
        unit = self.about.get("Length Units", "").lower()
        if unit not in UNITS_M or self.about.get("Rotation Type", "Quaternion") != "Quaternion":
            raise RecordingError(
                f"{self.path}: Length Units {self.about.get('Length Units')!r}, Rotation Type "
                f"{self.about.get('Rotation Type')!r}; export it in Meters, Centimeters or "
                "Millimeters, with Rotation Type Quaternion"
            )
        return UNITS_M[unit]

    def columns(self) -> dict[str, dict[tuple[str, str], int]]:
        """The numbers of the columns that are read, by body or marker, kind and axis."""
        labelled = {
            row[1]: row
            for row in self.rows[1 : self.axes_row]
            if len(row) > 1 and row[1] in ("Type", "Name")
        }
        heads = zip(
            labelled.get("Type", self.rows[1]),
            labelled.get("Name", self.rows[2]),
            self.rows[self.axes_row - 1],
            self.rows[self.axes_row],
            strict=False,
        )
        columns: dict[str, dict[tuple[str, str], int]] = {}
        for i, (kind, name, *axis) in enumerate(heads):
            if kind in POSED_TYPES and tuple(axis) in POSE_COLUMNS:
                columns.setdefault(name, {})[axis[0], axis[1]] = i
        return columns

    def numbers(self, columns: Sequence[int]) -> Vector:
        """The table with the numbers of these columns; NaN elsewhere, where there may be text.
        Raises RecordingError.
        """
        frames = self.rows[self.axes_row + 1 :]
        table = np.full((len(frames), len(self.rows[self.axes_row])), np.nan)
        for values, row in zip(table, frames, strict=True):
            filled = [i for i in columns if i < len(row) and row[i]]
            try:
                values[filled] = [self.number(row[i]) for i in filled]
            except ValueError as error:
                raise RecordingError(
                    f"{self.path}: frame {row[0]}: {error}; numbers and empty cells needed"
                ) from None
        return table

    def number(self, cell: str) -> float:
        """The number in a cell. Raises ValueError."""
        return float(cell.replace(",", ".") if self.has_decimal_commas else cell)


def read_motive(path: Path) -> Captured:
    """The rigid bodies, bones and single markers of a take exported by Motive. Raises
    RecordingError.
    """
    take = _Motive.of(path)
    unit_m = take.unit_m()
    columns = take.columns()
    table = take.numbers([1, *itertools.chain(*map(dict.values, columns.values()))])
    stamps = _stamps(path, table[:, 1])
    return {
        name: (stamps, _poses(table, body_columns, unit_m))
        for name, body_columns in columns.items()
        if all(position in body_columns for position in POSE_COLUMNS[:3])
    }


def _poses(table: Vector, columns: Mapping[tuple[str, str], int], unit_m: float) -> Vector:
    """The poses (N, 7) [m] in the columns of a table; without rotations for a marker."""
    poses = np.tile([np.nan] * 3 + list(NO_ROTATION), (len(table), 1))
    for k, axis in enumerate(POSE_COLUMNS):
        if axis in columns:
            poses[:, k] = table[:, columns[axis]] * (unit_m if k < 3 else 1.0)
    return poses


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
