"""File of a skill: one .npz archive without pickle.

It holds the primitive's base, via-points and weights, units, the hash of the demonstrations, and a
checksum. All arrays are checked, and the skill is tried where it was learned, before it is used.
"""

from __future__ import annotations

import hashlib
import io
import pickle
import zipfile
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from kmp import KMP
from kmp.named_arrays import from_arrays, to_arrays
from kmp.storage import checksum
from thirdhand.contract.explain import ExplainedError, in_words, validated
from thirdhand.contract.printable import printable, printable_lines
from thirdhand.contract.requests import ViaPoint
from thirdhand.core.skill import MAX_SKILL_DISTANCE_M
from thirdhand.core.skill.hands_kmp import HandsKMP
from thirdhand.core.skill.model import LEVELS, NORMAL, NORMAL_WEIGHTS, REGION_95, Model, Regions
from thirdhand.core.skill.pose import LearnedGripper, LearnedOrientation
from thirdhand.core.skill.skill import MODELS, Skill
from thirdhand.core.skill.task_clock import LONGEST_CLOCK_S, MOST_CLOCK_WEIGHT
from thirdhand.settings.file_content import UnusableError, content
from thirdhand.skills.residual_risk import ResidualRisk

LONGEST_SKILL_NAME = 128  # [characters]
SKILL_FORMAT = 6
# prefixes of the arrays of their primitives
TURN_PREFIX = "turn."
GRIPPER_PREFIX = "gripper."
# [B] largest file, unpacked, and its number of arrays; a skill has fewer than a hundred
LARGEST_FILE = 100_000_000
MOST_ARRAYS = 500
MOST_POINTS = 2500  # reference points, which bound the duration of a tick
HIGHEST_GATE_M = 1.0  # a larger threshold would let everything pass
# characters
LONGEST_TEXT = 200
LONGEST_FIGURES = 1_000_000
RANGES = {  # minimum, maximum and unit of the numbers in each array
    "threshold": (1e-6, HIGHEST_GATE_M, "m"),
    "tolerance": (0.0, MAX_SKILL_DISTANCE_M, "m"),
    "ell": (1e-3, 1e4, "1/m²"),
    "lambda_mean": (1e-9, 1e9, ""),
    "lambda_covariance": (1e-9, 1e9, ""),
    "components": (0, 10_000, ""),
    "box": (-MAX_SKILL_DISTANCE_M, MAX_SKILL_DISTANCE_M, "m"),
    "orientation": (-1.001, 1.001, ""),
    **dict.fromkeys(
        ("base_inputs", "base_mean", "via_inputs", "via_mean", "prior_mean"),
        (-MAX_SKILL_DISTANCE_M, MAX_SKILL_DISTANCE_M, "m"),
    ),
    **dict.fromkeys(("base_covariance", "via_covariance"), (-100.0, 100.0, "m²")),
    **dict.fromkeys(("base_weights", "weights"), (-1e12, 1e12, "")),
}
# The arrays of `Regions`: a scale, a time [s] and squared distances; and, for a skill with an
# alarm, the weights and the alarm.
REGIONS = "regions"
DETECTOR = "detector"
FARTHEST_RADIUS = 1e6
LARGEST_WEIGHT = 1e3
ALL_RANGES = (
    RANGES
    | {REGIONS: (0.0, FARTHEST_RADIUS, ""), DETECTOR: (-LARGEST_WEIGHT, LARGEST_WEIGHT, "")}
    | {name: bounds for model in MODELS for name, bounds in model.ranges.items()}
)
INPUT_ARRAYS = ("base_inputs", "via_inputs", "error_inputs")
PRIMITIVE = {
    "ell",
    "lambda_mean",
    "lambda_covariance",
    "prior_mean",
    "base_weights",
    "weights",
    "replaced",
} | {
    f"{part}_{quantity}"
    for part in ("base", "via")
    for quantity in ("inputs", "mean", "covariance")
}
OTHERS = (
    "format",
    "units",
    "name",
    "learned_from",
    "via_points",
    "figures",
    "conductor",
    "turned",
    "checksum",
    "names",
)
DEMONSTRATIONS = "demonstrations"
KNOWN = {
    *ALL_RANGES,
    DEMONSTRATIONS,
    *OTHERS,
    "replaced",
    "task_clock",
    *(prefix + name for prefix in (TURN_PREFIX, GRIPPER_PREFIX) for name in PRIMITIVE),
    TURN_PREFIX + "auxiliary",
}
WORKSPACE_MARGIN_M = 0.25  # a prediction at a learned input may leave the box by this distance
# [m/m] largest derivative of the tool's position; also of zeta [rad/m] and of the closure [1/m]
STEEPEST = 1000.0
# [rad] largest zeta of an orientation, half its angle; also largest closure
FARTHEST_TURN = 2.0 * np.pi


class SkillError(ExplainedError, ValueError):
    """A skill that cannot be read, learned or adapted."""

    def __init__(self, text: str) -> None:
        super().__init__(printable_lines(text))  # the text may quote a file


@dataclass(frozen=True, eq=False)
class StoredSkill(Skill):
    """A skill with its figures and its file, which the loop does not need."""

    # JSON of `Figures`; empty if the skill was not judged
    figures: str = field(default="", repr=False)
    # see `stored_demonstrations`; empty: not in the file
    demonstrations: bytes = field(default=b"", repr=False)
    file: bytes = field(default=b"", repr=False)  # bytes as stored and recorded

    @cached_property
    def tool_positions(self) -> NDArray[np.float64]:
        """The tool's positions (M, 3) [m] at the skill's reference points or via-points."""
        return self.mean(self.hands, self.model.names)

    def check_accepted(self) -> None:
        """Raise SkillError if the skill has residual risks that nobody accepted."""
        if refusal := ResidualRisk.of(self.figures).refusal:
            raise SkillError(f"skill {self.name!r} is not served: {refusal}")

    def for_loop(self) -> Skill:
        """The skill without figures and file."""
        return Skill(**{part.name: getattr(self, part.name) for part in fields(Skill)})


def with_file(skill: StoredSkill) -> StoredSkill:
    """A copy of the skill with the bytes of its file."""
    out = io.BytesIO()
    arrays: dict[str, Any] = dict(
        format=np.array(SKILL_FORMAT),
        units=np.array(skill.model.units),
        name=np.array(skill.name),
        orientation=skill.orientation,
        box=skill.workspace,
        threshold=np.array(skill.threshold),
        learned_from=np.array(skill.learned_from),
        components=np.array(skill.components),
        via_points=np.array(msgspec.json.encode(skill.via_points).decode()),
        tolerance=np.array(skill.tolerance),
        **to_arrays(skill.model.primitive),
    )
    if skill.conductor is not None:
        arrays["conductor"] = np.array(skill.conductor)
    if skill.regions != NORMAL:
        scale, std_s, radii, weights, alarm = skill.regions
        arrays[REGIONS] = np.array([scale, std_s, *radii])
        if alarm:
            arrays[DETECTOR] = np.array([*weights, alarm])
    if skill.figures:
        arrays["figures"] = np.array(skill.figures)
    if skill.demonstrations:
        arrays[DEMONSTRATIONS] = np.frombuffer(skill.demonstrations, np.uint8)
    arrays |= skill.model.own_arrays()
    if skill.turn:
        arrays |= {
            TURN_PREFIX + name: array for name, array in to_arrays(skill.turn.primitive).items()
        }
        arrays[TURN_PREFIX + "auxiliary"] = skill.turn.auxiliary
    if skill.gripper:
        arrays |= {
            GRIPPER_PREFIX + name: array
            for name, array in to_arrays(skill.gripper.primitive).items()
        }
    np.savez(out, allow_pickle=False, **arrays, checksum=np.array(checksum(arrays)))
    return replace(skill, file=out.getvalue(), digest=_digest(out.getvalue()))


def _digest(file: bytes) -> bytes:
    return hashlib.blake2b(file, digest_size=16).digest()


def arrays_in(data: bytes) -> dict[str, Any]:
    """The arrays in the bytes of an .npz file.

    Raises ValueError if they are too many or too large, which is found before any is unpacked, and
    what NumPy raises for a damaged archive.
    """
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        items = archive.infolist()
    if len(items) > MOST_ARRAYS:
        raise ValueError(f"{len(items)} arrays in an archive, at most {MOST_ARRAYS} accepted")
    if (size := sum(item.file_size for item in items)) > LARGEST_FILE:
        raise ValueError(f"{size} bytes unpacked, at most {LARGEST_FILE} accepted")
    with np.load(io.BytesIO(data), allow_pickle=False) as arrays:
        return dict(arrays)


def decoded(data: bytes, *, origin: str) -> StoredSkill:
    """The skill in the bytes of an .npz file; `origin` names it in errors. Raises SkillError."""
    if not data.startswith((b"PK\x03\x04", b"PK\x05\x06")):  # as every .npz
        advice = "; `thirdhand learn` makes one of demonstrations" * data.startswith(b"\x89MCAP")
        raise SkillError(f"{origin}: not a skill (no .npz archive){advice}")
    try:
        arrays = arrays_in(data)
        if (number := arrays["format"].item()) != SKILL_FORMAT:
            raise SkillError(
                f"{origin}: skill of format {number}, of {SKILL_FORMAT} needed: learn it anew with "
                "this version"
            )
        for fault in _spoilt(arrays):
            raise SkillError(f"{origin}: {fault}")
        skill = _assembled(arrays, data)
        for fault in _faults(skill):
            raise SkillError(f"{origin}: {fault}")
    except SkillError:
        raise
    except KeyError as error:
        raise SkillError(f"{origin}: not a skill (the array {error} is missing)") from None
    except (pickle.UnpicklingError, zipfile.BadZipFile):
        raise SkillError(f"{origin}: not a skill (a damaged .npz archive)") from None
    except Exception as error:  # NumPy does not document what a damaged archive raises
        raise SkillError(f"{origin}: not a skill ({error})") from None
    return skill


def _assembled(arrays: Mapping[str, NDArray[Any]], data: bytes) -> StoredSkill:
    """The skill with these arrays, which are those of the file `data`."""
    via_points = validated(msgspec.json.decode(str(arrays["via_points"])), tuple[ViaPoint, ...])
    turn = _part(arrays, TURN_PREFIX)
    gripper = _part(arrays, GRIPPER_PREFIX)
    figures = str(arrays.get("figures", ""))
    return StoredSkill(
        name=printable(str(arrays["name"])),
        model=_model(arrays).from_arrays(arrays, via_points),
        orientation=arrays["orientation"],
        workspace=arrays["box"],
        threshold=float(arrays["threshold"]),
        learned_from=printable(str(arrays["learned_from"])),
        components=int(arrays["components"]),
        via_points=via_points,
        tolerance=float(arrays["tolerance"]),
        turn=LearnedOrientation(from_arrays(turn), turn["auxiliary"]) if turn else None,
        gripper=LearnedGripper(from_arrays(gripper)) if gripper else None,
        figures=figures,
        demonstrations=arrays[DEMONSTRATIONS].tobytes() if DEMONSTRATIONS in arrays else b"",
        file=bytes(data),
        digest=_digest(data),
        conductor=int(arrays["conductor"]) if "conductor" in arrays else None,
        regions=_regions(arrays) if REGIONS in arrays else NORMAL,
        residual_risk=ResidualRisk.of(figures).accepted,
    )


def skill_in(path: Path) -> StoredSkill:
    """The skill in a file. Raises SkillError."""
    try:
        return decoded(content(path, LARGEST_FILE), origin=str(path))
    except (OSError, UnusableError) as error:
        raise SkillError(f"cannot read skill {path}: {in_words(error, named=False)}") from None


def _regions(arrays: Mapping[str, NDArray[Any]]) -> Regions:
    scale, std_s, *radii = arrays[REGIONS].tolist()
    regions = Regions(scale, std_s, tuple(radii))
    if DETECTOR not in arrays:
        return regions
    *weights, alarm = arrays[DETECTOR].tolist()
    return regions._replace(weights=tuple(weights), alarm=alarm)


def _part(arrays: Mapping[str, NDArray[Any]], prefix: str) -> dict[str, NDArray[Any]]:
    """The arrays of the primitive with this prefix."""
    return {
        name.removeprefix(prefix): array
        for name, array in arrays.items()
        if name.startswith(prefix)
    }


def _model(arrays: Mapping[str, NDArray[Any]]) -> type[Model]:
    """The kind of the skill's model: the one that has an array of its own in the file."""
    return next((model for model in MODELS if model.ranges.keys() & arrays.keys()), MODELS[0])


def _spoilt(arrays: Mapping[str, NDArray[Any]]) -> Iterator[str]:
    """Faults of the arrays: changes since they were written, and values that no skill has."""
    for name in sorted(set(arrays) - KNOWN):  # kmp supports more than the loop was tested with
        yield f"an array {name!r}, which no skill has"
    # A model's array that is missing raises KeyError later.
    model_arrays = [name for name in _model(arrays).ranges if name in arrays]
    yield from _beyond(arrays, [*RANGES, *model_arrays], "")
    for prefix in (TURN_PREFIX, GRIPPER_PREFIX):
        yield from _spoilt_part(arrays, prefix)
    yield from _varying_priors(arrays)

    if (side := arrays.get("conductor", np.array(0)).tolist()) not in (0, 1):
        yield f"conductor is {side!r}: 0 for the left hand or 1 for the right one accepted"
    if REGIONS in arrays:
        yield from _beyond(arrays, [name for name in (REGIONS, DETECTOR) if name in arrays], "")
        yield from _no_regions(arrays[REGIONS])
    if DETECTOR in arrays:
        yield from _no_detector(arrays[DETECTOR])
    yield from _spoilt_texts(arrays)

    if len(arrays["base_inputs"]) > MOST_POINTS:
        yield f"{len(arrays['base_inputs'])} reference points, at most {MOST_POINTS} accepted"
    if str(arrays["checksum"]) != checksum(arrays):
        yield (
            "it was changed since it was written (the checksum is another); learn it anew, or "
            "fetch it again"
        )


def _spoilt_part(arrays: Mapping[str, NDArray[Any]], prefix: str) -> Iterator[str]:
    """Faults of the arrays of the orientation or the gripper, if the skill has such."""
    part = _part(arrays, prefix)
    if not part:
        return
    clock = {"task_clock": arrays["task_clock"]} if "task_clock" in arrays else {}
    yield from _beyond(part | clock, RANGES.keys() & part.keys(), prefix)
    points = len(part["base_inputs"])
    if points > MOST_POINTS:
        yield f"{points} points of {prefix}, at most {MOST_POINTS} accepted"


def _varying_priors(arrays: Mapping[str, NDArray[Any]]) -> Iterator[str]:
    """Prior means that vary with the inputs where they must not."""
    for prefix in ("", TURN_PREFIX, GRIPPER_PREFIX):
        may_vary = not prefix and _model(arrays) is HandsKMP
        if np.ndim(arrays.get(prefix + "prior_mean", 0.0)) > 1 and not may_vary:
            yield f"{prefix}prior_mean goes with the inputs, and a constant one is needed there"


def _spoilt_texts(arrays: Mapping[str, NDArray[Any]]) -> Iterator[str]:
    """Faults of names, demonstrations and figures."""
    for name in ("name", "learned_from"):
        if arrays[name].dtype.kind != "U" or len(str(arrays[name])) > LONGEST_TEXT:
            yield f"{name} is no text of up to {LONGEST_TEXT} letters"
    if DEMONSTRATIONS in arrays and arrays[DEMONSTRATIONS].dtype != np.uint8:
        yield f"{DEMONSTRATIONS} has numbers of type {arrays[DEMONSTRATIONS].dtype}, bytes needed"
    if "figures" in arrays and not _is_json(arrays["figures"]):
        yield f"figures is no JSON of up to {LONGEST_FIGURES} letters"


def _beyond(arrays: Mapping[str, NDArray[Any]], names: Iterable[str], prefix: str) -> Iterator[str]:
    """Faults of arrays with numbers out of their ranges. The last input may be a clock's."""
    # the clock has a weight
    is_timed = bool((arrays.get("task_clock", np.zeros(2))[1:2] > 0.0).any())
    for name in names:
        array = arrays[name]
        low, high, unit = ALL_RANGES[name]
        if array.dtype.kind not in "iuf":
            yield f"{prefix}{name} has numbers of type {array.dtype}, real ones needed"
            continue
        if is_timed and name in INPUT_ARRAYS and array.ndim == 2:
            times = array[:, -1]
            array = array[:, :-1]
            if not (np.abs(times) <= LONGEST_CLOCK_S * MOST_CLOCK_WEIGHT).all():
                yield f"{prefix}{name} has a clock that is no number, or too late"
        if array.size and not (low <= array.min() and array.max() <= high):  # NaN is in no range
            worst = array.flat[np.argmax(np.where(np.isfinite(array), np.abs(array), np.inf))]
            yield f"{prefix}{name} has {worst:g}, {low:g} to {high:g} {unit}".rstrip() + " accepted"


def _no_regions(array: NDArray[Any]) -> Iterator[str]:
    """Faults of the array of regions."""
    count = len(LEVELS)
    if array.shape != (2 + count,):
        yield f"regions of shape {array.shape}, ({2 + count},) needed"
    elif not (array[0] > 0 and (np.diff(array[2:]) >= 0).all()):
        yield f"regions are {array.tolist()}: a scale above 0, a time, and growing radii needed"
    elif abs(array[2 + LEVELS.index(0.95)] - REGION_95) > 0.01:
        region = array[2 + LEVELS.index(0.95)]
        yield f"a 95 % region of {region:g}: the scale makes it {REGION_95:g}"


def _no_detector(array: NDArray[Any]) -> Iterator[str]:
    """Faults of the array of weights and alarm."""
    count = len(NORMAL_WEIGHTS) + 1
    if array.shape != (count,):
        yield f"detector of shape {array.shape}, ({count},) needed"
    elif not 0 < array[-1] <= 1:
        yield f"an alarm at the error probability {array[-1]:g}: above 0, and up to 1, accepted"


def _is_json(array: NDArray[Any]) -> bool:
    try:
        msgspec.json.decode(str(array))
    except msgspec.DecodeError:
        return False
    return array.dtype.kind == "U" and len(str(array)) <= LONGEST_FIGURES


def unusable_name(name: str) -> str:
    """The reason why a text cannot be the name of a skill; empty if it can."""
    if name.strip() and len(name) <= LONGEST_SKILL_NAME and "/" not in name:
        return ""
    return f"name: {name[:60]!r} given; 1 to {LONGEST_SKILL_NAME} characters without / accepted"


def _faults(skill: Skill) -> Iterator[str]:
    """Faults of a skill that would harm the motion or mislead a reader."""
    if lacking := unusable_name(skill.name):
        yield lacking
    primitive = skill.model.primitive
    needed = skill.model.shape
    inputs = primitive.inputs.shape[1]
    outputs = primitive.outputs
    if (inputs, outputs) != needed:
        yield f"{inputs} inputs and {outputs} outputs, {needed[0]} and {needed[1]} needed"
        return
    corners = skill.workspace
    if corners.shape != (2, 3) or not (corners[0] < corners[1]).all():
        yield f"box is {corners.tolist()}, lower and upper corner needed"
    auxiliary = {TURN_PREFIX + "auxiliary": skill.turn.auxiliary} if skill.turn else {}
    for name, quaternion in ({"orientation": skill.orientation} | auxiliary).items():
        if quaternion.shape != (4,) or not abs(np.linalg.norm(quaternion) - 1) < 1e-6:
            yield f"{name} is {quaternion.tolist()}, a quaternion x y z w of norm 1 needed"
    yield from _tried(skill)
    if skill.turn:
        yield from _tried_beside(skill, skill.turn.primitive, TURN_PREFIX, outputs=3)
    if skill.gripper:
        yield from _tried_beside(skill, skill.gripper.primitive, GRIPPER_PREFIX, outputs=1)


def _tried_beside(skill: Skill, primitive: KMP, name: str, *, outputs: int) -> Iterator[str]:
    """Faults of the predictions of the orientation's or the gripper's primitive at its inputs."""
    needed_shape = (skill.model.shape[0], outputs)
    shape = (primitive.inputs.shape[1], primitive.outputs)
    if shape != needed_shape:
        yield (
            f"{name} has {shape[0]} inputs and {shape[1]} outputs, {needed_shape[0]} and "
            f"{needed_shape[1]} needed"
        )
        return
    with np.errstate(all="ignore"):
        magnitudes = np.abs(primitive.mean(primitive.inputs))
        steep = np.linalg.norm(primitive.jacobians(primitive.inputs), axis=(1, 2)).max()
    if not magnitudes.max() <= FARTHEST_TURN:
        yield (
            f"{name} says {magnitudes.max():g} where it was learned, up to {FARTHEST_TURN:.2g} "
            "accepted"
        )
    if not steep <= STEEPEST:
        change = f"changes by {steep:g} a metre where it was learned"
        yield f"{name} {change}, up to {STEEPEST:g} accepted"


def _tried(skill: Skill) -> Iterator[str]:
    """Faults of the skill's predictions at its own inputs, as with weights of another skill."""
    with np.errstate(all="ignore"):
        tried = [
            (model.hands, model.mean(model.hands))
            for model in (skill.model.unadapted(), skill.model)
        ]
    low, high = skill.workspace
    for where, positions in tried:
        beyond = np.maximum(np.maximum(low - positions, positions - high), 0.0).max(axis=1)
        if not (np.isfinite(positions).all() and beyond.max() <= WORKSPACE_MARGIN_M):
            worst = int(np.argmax(np.where(np.isfinite(beyond), beyond, np.inf)))
            yield (
                f"with the hands at {np.round(where[worst], 3).tolist()}, where it was learned, "
                f"the tool is at {positions[worst].tolist()}; its box and {WORKSPACE_MARGIN_M} m "
                "around it "
                "accepted"
            )
    primitive = skill.model.primitive
    for hands in primitive.inputs[:: max(1, len(primitive.inputs) // 5)]:
        steep = float(np.linalg.norm(primitive.jacobian(hands)))
        if not steep <= STEEPEST:
            yield (
                f"with the hands at {np.round(hands, 3).tolist()} the tool moves {steep:g} times "
                "as far as they do"
            )
