"""A skill's file: one .npz without pickle.

Weights, base and via-points apart, units, what it was learned from, and a checksum of all that.

What a file says is checked whole, and tried where it was learned: a skill that would harm the
motion is never handed out.
"""

from __future__ import annotations

import io
import pickle
import zipfile
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from kmp import KMP
from kmp.storage import checksum
from service.contract.explain import ExplainedError
from service.contract.requests import Name, ViaPoint
from service.core.skill.places import MOST_CORNERS, Places, Task
from service.core.skill.pose import LearnedGripper, LearnedOrientation
from service.core.skill.skill import LearnedBetween, Skill

# The second holds what was found in learning, the third is of a skill between places, the fourth
# has orientation or gripper, and may be one between places; a skill of the first stays one, to the
# byte.
PLAIN, JUDGED, BETWEEN, POSED = FORMATS = (1, 2, 3, 4)
INPUTS, OUTPUTS = 6, 3
MOST_PLACES = 100
TURN, GRIPPER = "turn.", "gripper."  # before the names of their primitives' arrays
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
RANGES_BETWEEN = {  # of those that a skill between places has besides
    "corners": (0, MOST_CORNERS - 1, ""),
    "shares": (-1, MOST_CORNERS * 2 - 1, ""),
    "follow": (-1, 1, ""),
    "nominal": (-FARTHEST_M, FARTHEST_M, "m"),
    "seen": (-0.001, 1.001, ""),
    "errors": (-FARTHEST_M, FARTHEST_M, "m"),
}
PRIMITIVE = {"ell", "lambda_mean", "lambda_covariance", "prior_mean", "base_weights", "weights", "replaced"} | {
    f"{part}_{what}" for part in ("base", "via") for what in ("inputs", "mean", "covariance")
}
KNOWN = {
    *RANGES,
    "format",
    "units",
    "name",
    "learned_from",
    "places",
    "replaced",
    "figures",
    "checksum",
    "names",
    *RANGES_BETWEEN,
    *(prefix + name for prefix in (TURN, GRIPPER) for name in PRIMITIVE),
    TURN + "auxiliary",
}
UNITS = "inputs: left x y z, right x y z [m]; outputs: tool x y z [m]; frame base"
UNITS_BETWEEN = (
    "inputs: shares of the left hand's places, of the right hand's; outputs: the tool's shares of all named places but "
    "the first, deviation x y z [m]; frame base"
)
MARGIN_M = 0.25  # by which a skill may leave its box where it was learned: targets are held in it
STEEPEST = 1000.0  # [m/m] of the tool's way to the hands'; also of its turn [rad/m], half the angle
FARTHEST_TURN = 2.0 * np.pi  # [rad, half the angle] of an orientation from the auxiliary one; also of a closure


class SkillError(ExplainedError, ValueError):
    """A skill that cannot be read, learned or adapted."""


def with_file(skill: Skill) -> Skill:
    """A copy of the skill that holds the bytes of its file, made anew."""
    out = io.BytesIO()
    arrays: dict[str, Any] = dict(
        format=np.array(
            POSED if skill.turn or skill.gripper else BETWEEN if skill.between else JUDGED if skill.figures else PLAIN
        ),
        units=np.array(UNITS_BETWEEN if skill.between else UNITS),
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
    if skill.between:
        task, nominal, seen, errors = skill.between
        arrays |= {
            "names": np.array(msgspec.json.encode(task.names).decode()),
            "corners": task.corners,
            "shares": task.inputs,
            "follow": task.follow,
            "nominal": nominal.at,
            "seen": seen,
            "errors": errors,
        }
    if skill.turn:
        arrays |= {TURN + name: array for name, array in skill.turn.primitive.to_arrays().items()}
        arrays[TURN + "auxiliary"] = skill.turn.auxiliary
    if skill.gripper:
        arrays |= {GRIPPER + name: array for name, array in skill.gripper.primitive.to_arrays().items()}
    np.savez(out, allow_pickle=False, **arrays, checksum=np.array(checksum(arrays)))
    return replace(skill, file=out.getvalue())


def decoded(data: bytes, *, origin: str, recorded: bool = False) -> Skill:
    """The skill in the bytes of an .npz file; `origin` names it in errors. Raises SkillError.

    One without a checksum, as earlier versions wrote, is taken where it was `recorded` only: a
    recording has checksums of its own.
    """
    if not data.startswith(b"PK"):  # as every .npz
        made = "; `thirdhand learn` makes one of demonstrations" * data.startswith(b"\x89MCAP")
        raise SkillError(f"{origin}: not a skill (no .npz archive){made}")
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
                f"{origin}: skill of format {kind}, {PLAIN} to {POSED} needed: written by a later version?"
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
            turn=_turn(_part(arrays, TURN)),
            gripper=_gripper(_part(arrays, GRIPPER)),
            between=_between(arrays) if _is_between(arrays) else None,
            figures=str(arrays["figures"]) if kind in {JUDGED, BETWEEN} or "figures" in arrays else "",
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


def _part(arrays: Mapping[str, NDArray[Any]], prefix: str) -> dict[str, NDArray[Any]]:
    """The arrays of the primitive with this prefix."""
    return {name.removeprefix(prefix): array for name, array in arrays.items() if name.startswith(prefix)}


def _is_between(arrays: Mapping[str, NDArray[Any]]) -> bool:
    """Whether it is a skill between places."""
    kind = arrays["format"].item()
    return bool(kind == BETWEEN or (kind == POSED and "corners" in arrays))


def _turn(arrays: Mapping[str, NDArray[Any]]) -> LearnedOrientation | None:
    return LearnedOrientation(KMP.from_arrays(arrays), arrays["auxiliary"]) if arrays else None


def _gripper(arrays: Mapping[str, NDArray[Any]]) -> LearnedGripper | None:
    return LearnedGripper(KMP.from_arrays(arrays)) if arrays else None


def _spoilt(arrays: Mapping[str, NDArray[Any]], *, recorded: bool) -> Iterator[str]:
    """What in the arrays is not what was written, or not what any skill has."""
    for name in sorted(set(arrays) - KNOWN):  # what kmp can hold besides, and the loop was never tried with
        yield f"an array {name!r}, which no skill has"
    yield from _beyond(arrays, RANGES | RANGES_BETWEEN if _is_between(arrays) else RANGES, "")
    for prefix in (TURN, GRIPPER):
        if part := _part(arrays, prefix):
            yield from _beyond(part, RANGES.keys() & part.keys(), prefix)
            if len(part["base_inputs"]) > MOST_POINTS:
                yield f"{len(part['base_inputs'])} points of {prefix}, at most {MOST_POINTS} accepted"
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


def _beyond(arrays: Mapping[str, NDArray[Any]], names: Iterable[str], prefix: str) -> Iterator[str]:
    """Which arrays hold what is in no range."""
    for name in names:
        array, (low, high, unit) = arrays[name], (RANGES | RANGES_BETWEEN)[name]
        if array.dtype.kind not in "iuf":
            yield f"{prefix}{name} has numbers of type {array.dtype}, real ones needed"
        elif array.size and not (low <= array.min() and array.max() <= high):  # NaN is in no range
            worst = array.flat[np.argmax(np.where(np.isfinite(array), np.abs(array), np.inf))]
            yield f"{prefix}{name} has {worst:g}, {low:g} to {high:g} {unit}".rstrip() + " accepted"


def _is_json(array: NDArray[Any]) -> bool:
    try:
        msgspec.json.decode(str(array))
    except msgspec.DecodeError:
        return False
    return array.dtype.kind == "U" and len(str(array)) <= LONGEST_FIGURES


def _between(arrays: Mapping[str, NDArray[Any]]) -> LearnedBetween:
    """What belongs to a skill between places. Raises ValueError where its arrays do not fit."""
    names = msgspec.json.decode(str(arrays["names"]), type=tuple[Name, ...])
    count, width = len(names), int(arrays["shares"].max()) + 1
    shapes = {
        "corners": (count, 2),
        "shares": (2, MOST_CORNERS),
        "follow": (count,),
        "nominal": (count, 9),
        "seen": (len(arrays["errors"]), width),
        "errors": (len(arrays["seen"]), 3),
    }
    for name, shape in shapes.items():
        if arrays[name].shape != shape or not shape[0]:
            raise ValueError(f"{name} has shape {arrays[name].shape}, {shape} needed")
    if not 2 <= count <= MOST_PLACES or len(set(names)) < count:
        raise ValueError(f"places {', '.join(names)}: 2 to {MOST_PLACES} different names needed")
    corners, shares = (np.ascontiguousarray(arrays[name], np.int64) for name in ("corners", "shares"))
    for side in (0, 1):
        has = int((shares[side] >= 0).sum())
        if not has or (shares[side, :has] < 0).any() or not np.array_equal(np.unique(corners[:, side]), np.arange(has)):
            raise ValueError(f"the hands' places {corners.tolist()} and inputs {shares.tolist()} do not fit each other")
    if not np.array_equal(np.unique(shares[shares >= 0]), np.arange(width)):
        raise ValueError(f"the inputs {shares.tolist()} are not numbered through")
    task = Task(names, corners, shares, np.ascontiguousarray(arrays["follow"], np.int64))
    return LearnedBetween(task, Places(names, arrays["nominal"]), arrays["seen"], arrays["errors"])


def _faults(skill: Skill) -> Iterator[str]:
    """What in the file would harm the motion."""
    inputs, outputs = skill.primitive.inputs.shape[1], skill.primitive.outputs
    needed = (INPUTS, OUTPUTS)
    if skill.between:
        needed = (skill.between.task.width, len(skill.between.task.names) + OUTPUTS - 1)
    if (inputs, outputs) != needed:
        yield f"{inputs} inputs and {outputs} outputs, {needed[0]} and {needed[1]} needed"
        return
    corners = skill.workspace
    if corners.shape != (2, 3) or not (corners[0] < corners[1]).all():
        yield f"box is {corners.tolist()}, lower and upper corner needed"
    if skill.orientation.shape != (4,) or not abs(np.linalg.norm(skill.orientation) - 1) < 1e-6:
        yield f"orientation is {skill.orientation.tolist()}, a quaternion x y z w of norm 1 needed"
    yield from _tried(skill)
    if skill.turn:
        if skill.turn.auxiliary.shape != (4,) or not abs(np.linalg.norm(skill.turn.auxiliary) - 1) < 1e-6:
            yield f"{TURN}auxiliary is {skill.turn.auxiliary.tolist()}, a quaternion x y z w of norm 1 needed"
        yield from _tried_beside(skill, skill.turn.primitive, TURN, outputs=3)
    if skill.gripper:
        yield from _tried_beside(skill, skill.gripper.primitive, GRIPPER, outputs=1)


def _tried_beside(skill: Skill, primitive: KMP, name: str, *, outputs: int) -> Iterator[str]:
    """What is wrong with a primitive beside the position's, where it was learned and taught."""
    wanted, given = (skill.primitive.inputs.shape[1], outputs), (primitive.inputs.shape[1], primitive.outputs)
    if given != wanted:
        yield f"{name} has {given[0]} inputs and {given[1]} outputs, {wanted[0]} and {wanted[1]} needed"
        return
    with np.errstate(all="ignore"):
        found = np.abs(primitive.mean(primitive.inputs))
        steep = np.linalg.norm(primitive.jacobians(primitive.inputs), axis=(1, 2)).max()
    if not found.max() <= FARTHEST_TURN:
        yield f"{name} says {found.max():g} where it was learned, up to {FARTHEST_TURN:.2g} accepted"
    if not steep <= STEEPEST:
        yield f"{name} changes by {steep:g} a metre where it was learned, up to {STEEPEST:g} accepted"


def _tried(skill: Skill) -> Iterator[str]:
    """What the skill does wrong where it was learned and taught: its weights are not its own."""
    both = dict.fromkeys((replace(skill, primitive=skill.primitive.base), skill)) if not skill.between else [skill]
    with np.errstate(all="ignore"):
        tried = [(one.hands, one.mean(one.hands)) for one in both]
    low, high = skill.workspace
    for where, found in tried:
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
