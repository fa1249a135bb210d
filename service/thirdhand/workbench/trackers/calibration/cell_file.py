"""A calibration in a cell's files: the settings, whose other lines remain as they are, and a record
of the calibration beside them.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Literal
from urllib.parse import quote

import msgspec
import tomlkit
import tomlkit.exceptions

from thirdhand.contract.explain import InvalidError, in_words, validated
from thirdhand.settings.config import Settings, load, parse
from thirdhand.settings.file_content import LARGEST_CONFIGURATION, UnusableError, content, text_in
from thirdhand.settings.whole_file import whole
from thirdhand.workbench.trackers.calibration.solver import Calibration, CalibrationError


class CalibrationRecord(msgspec.Struct, frozen=True, kw_only=True):
    """A calibration with its origin; `--check` compares with it."""

    date: str
    method: Literal["held", "points"]
    hand: str
    frame: str
    calibration: Calibration


def hand_settings(calibration: Calibration, frame: str) -> dict[str, Any]:
    """The values of a tracker's table that a calibration gives. A frame without a name is not
    written, nor that of `[trackers.NAME]`, which is NAME.
    """
    x, y, z, *quaternion = calibration.base_from_tracker
    pose = [round(value, 4) for value in (x, y, z)] + [round(value, 6) for value in quaternion]
    return ({"frame": frame} if frame else {}) | {"base_from_tracker": pose}


def lines(values: Mapping[str, Any], tracker: str = "") -> str:
    """The values of [trackers.NAME], or without a tracker of [hands], as lines of a TOML file."""
    table = f"[trackers.{tomlkit.key(tracker).as_string()}]" if tracker else "[hands]"
    return f"{table}\n" + "".join(
        f"{name} = {tomlkit.item(value).as_string()}\n" for name, value in values.items()
    )


def record_path(path: Path, tracker: str = "") -> Path:
    """The path of the record beside a cell's settings."""
    return path.with_suffix(
        f".{quote(tracker, safe='')}.calibration.json" if tracker else ".calibration.json"
    )


def write(
    path: Path, values: Mapping[str, Any], record: CalibrationRecord, tracker: str = ""
) -> Path:
    """Write values of [trackers.NAME], or without a tracker of [hands], into a cell's settings, and
    the record beside them. Returns the path of the earlier file, which is kept.

    Comments and all other lines remain, with their ends. The new text is validated before anything
    is written, and replaces the file at once, unless somebody else has changed it meanwhile. Raises
    CalibrationError, SettingsError.
    """
    by_hand = f"Write into it:\n{lines(values, tracker)}"
    try:
        path = real_path(path)
    except CalibrationError as error:
        raise CalibrationError(f"{error}. {by_hand}") from None
    before = load(path)
    text = text_in(path)
    try:
        changed = _changed(text, values, tracker)
    except (tomlkit.exceptions.TOMLKitError, TypeError) as error:
        raise CalibrationError(f"{path} cannot be changed: {error}. {by_hand}") from None
    after = parse(changed, origin=str(path), folder=path.parent)
    if after != _expected(before, values, tracker):
        raise CalibrationError(f"{path} cannot be changed without other settings. {by_hand}")
    backup = path.with_name(f"{path.name}.before-{datetime.now(UTC):%Y%m%d-%H%M%S-%f}")
    try:
        shutil.copy2(path, backup)
        if backup.read_bytes() != text.encode():
            backup.unlink()
            raise CalibrationError(f"{path} was changed by another program meanwhile. {by_hand}")
        _replace(path, changed.encode())
        _replace(
            record_path(path, tracker), msgspec.json.format(msgspec.json.encode(record)) + b"\n"
        )
    except OSError as error:
        raise CalibrationError(f"{in_words(error)}. {by_hand}") from None
    return backup


def _changed(text: str, values: Mapping[str, Any], tracker: str) -> str:
    """The text of a cell's settings with values of a tracker, and its ends of lines. Raises
    TOMLKitError, TypeError.
    """
    document = tomlkit.parse(text)
    section: Any = (
        document["trackers"][tracker] if tracker else document.setdefault("hands", tomlkit.table())
    )
    for name, value in values.items():
        section[name] = value
    changed = tomlkit.dumps(document)
    if "\r\n" in text and text.count("\r\n") == text.count("\n"):
        return changed.replace("\r\n", "\n").replace("\n", "\r\n")
    return changed


def _expected(before: Settings, values: Mapping[str, Any], tracker: str) -> Settings:
    """The settings with these values of a tracker, and all others as before."""
    fields = {
        name: tuple(value) if isinstance(value, list) else value for name, value in values.items()
    }
    if not tracker:
        hands = msgspec.structs.replace(before.hands, **fields)
        return msgspec.structs.replace(before, hands=hands)
    section = msgspec.structs.replace(before.trackers[tracker], **fields)
    return msgspec.structs.replace(before, trackers=before.trackers | {tracker: section})


def real_path(path: Path) -> Path:
    """The path of the file that a link leads to, so that the link remains. Raises CalibrationError
    for a file that cannot be written.
    """
    try:
        target = path.resolve(strict=True)
    except (OSError, RuntimeError) as error:  # a RuntimeError for links in a circle
        raise CalibrationError(
            f"cannot read configuration {path}: {in_words(error, named=False)}"
        ) from None
    is_writable = (
        target.is_file() and target.stat().st_mode & 0o222 and os.access(target.parent, os.W_OK)
    )
    if not (is_writable and os.access(target, os.W_OK)):
        raise CalibrationError(
            f"{path} cannot be written: a file that this user may change, in such a folder, needed"
        )
    return target


def _replace(path: Path, data: bytes) -> None:
    """Replace a file at once, or leave it as it is; its new content is on the disk before."""
    with whole(path) as part, part.open("wb") as file:
        file.write(data)
        file.flush()
        os.fsync(file.fileno())


def recorded(path: Path, settings: Settings, tracker: str = "") -> CalibrationRecord:
    """The record of a tracker's calibration, with the pose in the settings. Raises
    CalibrationError.
    """
    record_file = record_path(path.resolve(), tracker)
    try:
        raw = msgspec.json.decode(content(record_file, LARGEST_CONFIGURATION))
        record = validated(raw, CalibrationRecord)
    except FileNotFoundError:
        raise CalibrationError(
            f"{record_file} does not exist, so that the hand's place in the tool is unknown: "
            "`thirdhand calibrate --held` writes it"
        ) from None
    except (OSError, UnusableError, msgspec.DecodeError, UnicodeDecodeError, InvalidError) as error:
        raise CalibrationError(
            f"{record_file} cannot be read: {in_words(error, named=False)}"
        ) from None
    pose = settings.hands_in(tracker).base_from_tracker
    return msgspec.structs.replace(
        record, calibration=msgspec.structs.replace(record.calibration, base_from_tracker=pose)
    )
