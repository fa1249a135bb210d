"""A skill's file: one .npz without pickle.

Weights, base and via-points apart, units, and what it was learned from.

What a file says is checked whole: a skill that would harm the motion is never handed out.
"""

from __future__ import annotations

import io
import math
import pickle
import zipfile
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import msgspec
import numpy as np

from kmp import KMP
from service.contract.explain import ExplainedError
from service.contract.requests import ViaPoint
from service.core.skill import Skill

FORMAT = 1
INPUTS, OUTPUTS = 6, 3


class SkillError(ExplainedError, ValueError):
    """A skill that cannot be read, learned or adapted."""


def with_file(skill: Skill) -> Skill:
    """A copy of the skill that holds the bytes of its file, made anew."""
    out = io.BytesIO()
    arrays: dict[str, Any] = dict(
        format=np.array(FORMAT),
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
    np.savez(out, allow_pickle=False, **arrays)
    return replace(skill, file=out.getvalue())


def decoded(data: bytes, *, origin: str) -> Skill:
    """The skill in the bytes of an .npz file; `origin` names it in errors. Raises SkillError."""
    try:
        with np.load(io.BytesIO(data), allow_pickle=False) as archive:
            if not isinstance(archive, np.lib.npyio.NpzFile):
                raise SkillError(f"{origin}: not a skill (no .npz archive)")
            arrays = dict(archive)
        if (kind := arrays["format"].item()) != FORMAT:
            raise SkillError(f"{origin}: skill of format {kind}, {FORMAT} needed")
        if not all(np.isfinite(arrays[name]).all() for name in ("weights", "base_weights")):
            raise SkillError(f"{origin}: weights that are not all finite")
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
            file=bytes(data),
        )
    except SkillError:
        raise
    except KeyError as error:
        raise SkillError(f"{origin}: not a skill (the array {error} is missing)") from None
    except (pickle.UnpicklingError, zipfile.BadZipFile):
        raise SkillError(f"{origin}: not a skill (no .npz archive)") from None
    except Exception as error:  # what a damaged archive may raise is not documented by anyone
        raise SkillError(f"{origin}: not a skill ({error})") from None
    for fault in _faults(skill):
        raise SkillError(f"{origin}: {fault}")
    return skill


def _faults(skill: Skill) -> Iterator[str]:
    """What in the file would harm the motion."""
    inputs, outputs = skill.primitive.inputs.shape[1], skill.primitive.outputs
    if (inputs, outputs) != (INPUTS, OUTPUTS):
        yield f"{inputs} inputs and {outputs} outputs, {INPUTS} and {OUTPUTS} needed"
    if not (math.isfinite(skill.threshold) and skill.threshold > 0):
        yield f"threshold is {skill.threshold}, a number above 0 needed"
    corners = skill.workspace
    if corners.shape != (2, 3) or not (corners[0] < corners[1]).all() or not np.isfinite(corners).all():
        yield f"box is {corners.tolist()}, lower and upper corner needed"
    if skill.orientation.shape != (4,) or not abs(np.linalg.norm(skill.orientation) - 1) < 1e-6:
        yield f"orientation is {skill.orientation.tolist()}, a quaternion x y z w of norm 1 needed"
