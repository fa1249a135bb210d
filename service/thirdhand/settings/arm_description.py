"""Complete an arm's settings from its URDF, and reject settings that contradict it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Protocol

from thirdhand.contract.explain import in_words
from thirdhand.settings.file_content import SettingsError, UnreadableError, UnusableError, content
from thirdhand.settings.robot_xml import readable
from thirdhand.settings.urdf import Shape, Urdf, UrdfError, UrdfJoint

LIMITS = ("lower", "upper", "velocity", "acceleration", "jerk")
ANY_REACH = {"inner": 1e-6, "outer": 3.0}  # [m] assumed before the kinematics are known
MAX_URDF_BYTES = 20_000_000  # a humanoid's URDF has 0.1 MB


def description(path: Path, packages: tuple[str, ...] = (), *, cover: bool = True) -> str:
    """An arm's URDF, with a capsule around each collision mesh if `cover`. Meshes are found in
    `packages`, or in folders above the URDF. Raises SettingsError, UnreadableError.
    """
    try:
        text = _text(path)
        if not cover or "<mesh" not in text:
            return text
        # its import is slow, and few arms need it
        from thirdhand.settings.mesh_cover import covered

        return covered(text, path, packages)
    except OSError as error:
        raise UnreadableError(
            f"[arm] urdf: cannot read {path}: {in_words(error, named=False)}"
        ) from None
    except UrdfError as error:
        raise SettingsError(f"[arm] urdf: {error}") from None


def _text(path: Path) -> str:
    """The text of a URDF. Raises OSError, UrdfError."""
    try:
        return readable(content(path, MAX_URDF_BYTES))
    except UnusableError as error:
        raise UrdfError(f"{path}: {error}; a URDF needed") from None
    except ValueError as error:
        raise UrdfError(f"{path}: not a robot description: {error}") from None


class Limits(Protocol):
    """The joints' settings that a URDF can contradict."""

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the joints in chain order."""

    @property
    def every_kind(self) -> tuple[str, ...]:
        """The kind of each joint."""


def extent(shape: Shape) -> float:
    """The length [m] of a shape; 0 for a mesh without a capsule."""
    match shape.kind, shape.size:
        case "box", size:
            return math.hypot(*size)
        case "sphere", (radius,):
            return 2.0 * radius
        case "cylinder", (radius, length):
            return math.hypot(2.0 * radius, length)
        case "capsule", (radius, length):
            return length + 2.0 * radius
        case "mesh", (*ends, radius):
            return math.dist(ends[:3], ends[3:]) + 2.0 * radius
    return 0.0


def completed(given: dict[str, Any], urdf: Urdf) -> dict[str, Any]:
    """The settings of an arm with its own URDF; values that are not given come from the URDF.

    Raises SettingsError.
    """
    arm, joints, reach = (
        {**part} if isinstance(part := given.get(name, {}), dict) else {}
        for name in ("arm", "joints", "reach")
    )
    if "plate" not in arm:
        raise SettingsError(
            "[arm] plate: missing; the link that carries the tool needed, the last ones are "
            f"{', '.join(urdf.leaves)}"
        )
    moving = urdf.movable(str(arm["plate"]))
    for name, values in _of_urdf(moving).items():
        joints.setdefault(name, values)
    required = {
        "[joints] velocity": "velocity" in joints,
        "[joints] acceleration": "acceleration" in joints,
        "[joints] jerk": "jerk" in joints,
        "[arm] posture": "posture" in arm,
    }
    if not all(required.values()):
        needed = (
            f"missing; the URDF does not define it, {len(moving)} numbers needed, one for each "
            "joint"
        )
        missing = [path for path, is_given in required.items() if not is_given]
        raise SettingsError("\n".join(f"{path}: {needed}" for path in missing))
    return {**given, "arm": arm, "joints": joints, "reach": {**ANY_REACH, **reach}}


def _of_urdf(moving: Sequence[UrdfJoint]) -> dict[str, list[Any]]:
    """The settings of joints that a URDF defines: names, kinds, and the limits of all or none."""
    joints: dict[str, list[Any]] = {
        "names": [joint.name for joint in moving],
        "kinds": [joint.kind for joint in moving],
    }
    for name in LIMITS:
        limits = [getattr(joint, name) for joint in moving]
        if all(map(math.isfinite, limits)):
            joints[name] = limits
    return joints


def check(joints: Limits, urdf: Urdf, plate: str) -> None:
    """Reject joints that the arm does not have, limits wider than the URDF's, and shapes longer
    than the arm. Raises SettingsError.
    """
    moving = urdf.movable(plate)
    _check_shapes(urdf, plate)
    names = tuple(joint.name for joint in moving)
    if joints.names != names:
        raise SettingsError(
            f"[joints] names: {list(joints.names)} given; the chain's {list(names)} in this order "
            "needed"
        )
    kinds = tuple(joint.kind for joint in moving)
    if joints.every_kind != kinds:
        raise SettingsError(
            f"[joints] kinds: {list(joints.every_kind)} given; the URDF's {list(kinds)} needed"
        )
    wide = []
    for i, joint in enumerate(moving):
        for name in LIMITS:
            if problem := _excess(joint, name, getattr(joints, name)[i]):
                wide.append(f"[joints] {name}, entry {i + 1}: {problem}")
    if wide:
        raise SettingsError("\n".join(wide))


def _check_shapes(urdf: Urdf, plate: str) -> None:
    """Reject shapes longer than the arm. Raises SettingsError."""
    reach_m = sum(math.hypot(*joint.translation) for joint in urdf.chain(plate))
    reach_m += sum(
        max(abs(joint.lower), abs(joint.upper))
        for joint in urdf.movable(plate)
        if joint.kind == "prismatic"
    )
    for shape in urdf.shapes:
        if (size_m := extent(shape)) > reach_m:
            raise SettingsError(
                f"[arm] urdf: the {shape.kind} of link {shape.link!r} is {size_m:.3g} m long, and "
                f"the arm {reach_m:.3g} m; "
                'no shape longer than the arm accepted. A mesh in millimetres needs scale="0.001 '
                '0.001 0.001"; '
                "tables and walls belong into [table] and [obstacles]"
            )


def _excess(joint: UrdfJoint, name: str, value: float) -> str:
    """The message about a limit that is wider than the URDF's; empty if it is not."""
    bound = getattr(joint, name)
    low = {"lower": bound, "upper": -math.inf}.get(name, 0.0)
    high = math.inf if name == "lower" else bound
    if low <= value <= high:
        return ""
    accepted = f"{low} or more" if name == "lower" else f"up to {high}"
    return f"{value} given; {accepted} accepted by the URDF of {joint.name}"
