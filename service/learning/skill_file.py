"""A skill's file: one .npz without pickle.

Weights, base and via-points apart, units, what it was learned from, and a checksum of all that.

What a file says is checked whole, and tried where it was learned: a skill that would harm the
motion is never handed out.
"""

from __future__ import annotations

import io
import pickle
import zipfile
from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from kmp import KMP
from kmp.storage import checksum
from service.contract.explain import ExplainedError
from service.contract.requests import ViaPoint
from service.core.skill import Skill

# The second holds what was found in learning; a skill of the first stays one, to the byte.
PLAIN, JUDGED = FORMATS = (1, 2)
INPUTS, OUTPUTS = 6, 3
LARGEST_FILE = 100_000_000  # bytes, unpacked
MOST_POINTS = 2500  # of the reference: a tick takes as long
FARTHEST_M = 10.0  # of anything from the base plate
HIGHEST_GATE_M = 1.0  # a skill that is as unsure as that is not followed
LONGEST_TEXT = 200  # letters
LONGEST_FIGURES = 1_000_000
RANGES = {  # of the numbers in each array
    "threshold": (1e-6, HIGHEST_GATE_M, "m"),
    "tolerance": (0.0, FARTHEST_M, "m"),
    "ell": (1e-3, 1e4, "1/m²"),
    "lambda_mean": (1e-9, 1e9, ""),
    "lambda_covariance": (1e-9, 1e9, ""),
    "components": (0, 10_000, ""),
    "box": (-FARTHEST_M, FARTHEST_M, "m"),
    "orientation": (-1.001, 1.001, ""),
    **dict.fromkeys(
        ("base_inputs", "base_mean", "via_inputs", "via_mean", "prior_mean"), (-FARTHEST_M, FARTHEST_M, "m")
    ),
    **dict.fromkeys(("base_covariance", "via_covariance"), (-100.0, 100.0, "m²")),
    **dict.fromkeys(("base_weights", "weights"), (-1e12, 1e12, "")),
}
KNOWN = {*RANGES, "format", "units", "name", "learned_from", "places", "replaced", "figures", "checksum"}
MARGIN_M = 0.25  # by which a skill may leave its box where it was learned: targets are held in it
STEEPEST = 1000.0  # [m/m] of the tool's way to the hands'


class SkillError(ExplainedError, ValueError):
    """A skill that cannot be read, learned or adapted."""


def with_file(skill: Skill) -> Skill:
    """A copy of the skill that holds the bytes of its file, made anew."""
    out = io.BytesIO()
    arrays: dict[str, Any] = dict(
        format=np.array(JUDGED if skill.figures else PLAIN),
        units=np.array("inputs: left x y z, right x y z [m]; outputs: tool x y z [m]; frame base"),
        name=np.array(skill.name),
        orientation=skill.orientation,
        box=skill.workspace,
        threshold=np.array(skill.threshold),
        learned_from=np.array(skill.learned_from),
        components=np.array(skill.components),
        places=np.array(msgspec.json.encode(skill.via_points).decode()),
        tolerance=np.array(skill.tolerance),
        **skill.primitive.to_arrays(),
    )
    if skill.figures:
        arrays["figures"] = np.array(skill.figures)
    np.savez(out, allow_pickle=False, **arrays, checksum=np.array(checksum(arrays)))
    return replace(skill, file=out.getvalue())


def decoded(data: bytes, *, origin: str, recorded: bool = False) -> Skill:
    """The skill in the bytes of an .npz file; `origin` names it in errors. Raises SkillError.

    One without a checksum, as earlier versions wrote, is taken where it was `recorded` only: a
    recording has checksums of its own.
    """
    try:
        with np.load(io.BytesIO(data), allow_pickle=False) as archive:
            if not isinstance(archive, np.lib.npyio.NpzFile):
                raise SkillError(f"{origin}: not a skill (no .npz archive)")
            size = sum(item.file_size for item in archive.zip.infolist())  # type: ignore[misc, union-attr]
            if size > LARGEST_FILE:
                raise SkillError(f"{origin}: {size} bytes unpacked, at most {LARGEST_FILE} accepted")
            arrays = dict(archive)
        if (kind := arrays["format"].item()) not in FORMATS:
            raise SkillError(
                f"{origin}: skill of format {kind}, {PLAIN} or {JUDGED} needed: written by a later version?"
            )
        for fault in _spoilt(arrays, recorded=recorded):
            raise SkillError(f"{origin}: {fault}")
        skill = Skill(
            name=str(arrays["name"]),
            primitive=KMP.from_arrays(arrays),
            orientation=arrays["orientation"],
            workspace=arrays["box"],
            threshold=float(arrays["threshold"]),
            learned_from=str(arrays["learned_from"]),
            components=int(arrays["components"]),
            via_points=msgspec.json.decode(str(arrays["places"]), type=tuple[ViaPoint, ...]),
            tolerance=float(arrays["tolerance"]),
            figures=str(arrays["figures"]) if kind == JUDGED else "",
            file=bytes(data),
        )
        for fault in _faults(skill):
            raise SkillError(f"{origin}: {fault}")
    except SkillError:
        raise
    except KeyError as error:
        raise SkillError(f"{origin}: not a skill (the array {error} is missing)") from None
    except (pickle.UnpicklingError, zipfile.BadZipFile):
        raise SkillError(f"{origin}: not a skill (no .npz archive)") from None
    except Exception as error:  # what a damaged archive may raise is not documented by anyone
        raise SkillError(f"{origin}: not a skill ({error})") from None
    return skill


def _spoilt(arrays: Mapping[str, NDArray[Any]], *, recorded: bool) -> Iterator[str]:
    """What in the arrays is not what was written, or not what any skill has."""
    for name in sorted(set(arrays) - KNOWN):  # what kmp can hold besides, and the loop was never tried with
        yield f"an array {name!r}, which no skill has"
    for name, (low, high, unit) in RANGES.items():
        array = arrays[name]
        if array.dtype.kind not in "iuf":
            yield f"{name} has numbers of type {array.dtype}, real ones needed"
        elif array.size and not (low <= array.min() and array.max() <= high):  # NaN is in no range
            worst = array.flat[np.argmax(np.where(np.isfinite(array), np.abs(array), np.inf))]
            yield f"{name} has {worst:g}, {low:g} to {high:g} {unit}".rstrip() + " accepted"
    for name in ("name", "learned_from"):
        if arrays[name].dtype.kind != "U" or len(str(arrays[name])) > LONGEST_TEXT:
            yield f"{name} is no text of up to {LONGEST_TEXT} letters"
    if "figures" in arrays and not _is_json(arrays["figures"]):
        yield f"figures is no JSON of up to {LONGEST_FIGURES} letters"
    if len(arrays["base_inputs"]) > MOST_POINTS:
        yield f"{len(arrays['base_inputs'])} reference points, at most {MOST_POINTS} accepted"
    if "checksum" in arrays:
        if str(arrays["checksum"]) != checksum(arrays):
            yield "it was changed since it was written (the checksum is another); learn it anew, or fetch it again"
    elif not recorded:
        yield "no checksum: written by an earlier version, or changed; learn it anew"


def _is_json(array: NDArray[Any]) -> bool:
    try:
        msgspec.json.decode(str(array))
    except msgspec.DecodeError:
        return False
    return array.dtype.kind == "U" and len(str(array)) <= LONGEST_FIGURES


def _faults(skill: Skill) -> Iterator[str]:
    """What in the file would harm the motion."""
    inputs, outputs = skill.primitive.inputs.shape[1], skill.primitive.outputs
    if (inputs, outputs) != (INPUTS, OUTPUTS):
        yield f"{inputs} inputs and {outputs} outputs, {INPUTS} and {OUTPUTS} needed"
    corners = skill.workspace
    if corners.shape != (2, 3) or not (corners[0] < corners[1]).all():
        yield f"box is {corners.tolist()}, lower and upper corner needed"
    if skill.orientation.shape != (4,) or not abs(np.linalg.norm(skill.orientation) - 1) < 1e-6:
        yield f"orientation is {skill.orientation.tolist()}, a quaternion x y z w of norm 1 needed"
    yield from _tried(skill)


def _tried(skill: Skill) -> Iterator[str]:
    """What the skill does wrong where it was learned and taught: its weights are not its own."""
    for primitive in dict.fromkeys((skill.primitive.base, skill.primitive)):
        with np.errstate(all="ignore"):
            found, where = primitive.mean(primitive.inputs), primitive.inputs
        low, high = skill.workspace
        beyond = np.maximum(np.maximum(low - found, found - high), 0.0).max(axis=1)
        if not (np.isfinite(found).all() and beyond.max() <= MARGIN_M):
            worst = int(np.argmax(np.where(np.isfinite(beyond), beyond, np.inf)))
            yield (
                f"with the hands at {np.round(where[worst], 3).tolist()}, where it was learned, the tool is at "
                f"{found[worst].tolist()}; its box and {MARGIN_M} m around it accepted"
            )
    for place in skill.primitive.inputs[:: max(1, len(skill.primitive.inputs) // 5)]:
        steep = float(np.linalg.norm(skill.primitive.jacobian(place)))
        if not steep <= STEEPEST:
            yield f"with the hands at {np.round(place, 3).tolist()} the tool moves {steep:g} times as far as they do"
