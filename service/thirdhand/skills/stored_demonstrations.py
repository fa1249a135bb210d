"""Demonstrations in a skill's file, from which the skill can be refined: a compressed .npz archive
within the skill's.

They are kept at up to KEPT_HZ, or less often if they are more than MOST_KEPT samples in all, as
each recording holds the skill; in single precision, 0.3 µm at 5 m. The motion of hands has no more
than about 10 Hz. The archive holds a JSON text about each demonstration, and for all of them
the stamps (T,) [ns], poses (T, 21) of left hand, right hand and tool, and closures (T,).
"""

from __future__ import annotations

import io
import zipfile
from collections.abc import Sequence

import msgspec
import numpy as np

from thirdhand.contract.explain import in_words, validated
from thirdhand.contract.printable import printable
from thirdhand.contract.requests import Hands, ViaPoint
from thirdhand.skills.demonstration import Demonstration, NamedDemonstration, check
from thirdhand.skills.skill_file import SkillError, StoredSkill, arrays_in

KEPT_HZ = 50.0
MOST_KEPT = 50_000  # 5 MB
REMEDY = (
    "learn it anew from its demonstrations with this version, or learn from all demonstrations "
    "without --from"
)


class _About(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True):
    """A demonstration but for its samples."""

    name: str
    samples: int
    frame: str
    via_points: tuple[ViaPoint, ...]
    conducts: Hands
    person: str
    begins: tuple[int, ...]
    has_gripper: bool
    begun_s: float | None = None


def packed(demonstrations: Sequence[NamedDemonstration]) -> bytes:
    """The demonstrations as bytes."""
    kept_hz = min(
        KEPT_HZ, MOST_KEPT / sum(demo.period_s * len(demo.stamps_ns) for _, demo in demonstrations)
    )
    thin = [
        (name, demo.every(max(1, int(1.0 / (kept_hz * demo.period_s) + 1e-6))))
        for name, demo in demonstrations
    ]
    about = [
        _About(
            name=name,
            samples=len(demonstration.stamps_ns),
            frame=demonstration.frame,
            via_points=demonstration.via_points,
            conducts=demonstration.conducts,
            person=demonstration.person,
            begins=demonstration.begins,
            has_gripper=demonstration.gripper is not None,
            begun_s=demonstration.begun_s,
        )
        for name, demonstration in thin
    ]
    out = io.BytesIO()
    np.savez_compressed(
        out,
        about=np.frombuffer(msgspec.json.encode(about), np.uint8),
        stamps=np.concatenate([demo.stamps_ns for _, demo in thin]),
        poses=np.concatenate(
            [np.hstack([demo.left, demo.right, demo.tool]) for _, demo in thin]
        ).astype(np.float32),
        closures=np.concatenate(
            [
                np.zeros(len(demo.stamps_ns)) if demo.gripper is None else demo.gripper
                for _, demo in thin
            ]
        ).astype(np.float32),
    )
    return out.getvalue()


def stored_demonstrations(skill: StoredSkill) -> list[NamedDemonstration]:
    """The demonstrations that a skill was learned from.

    Raises SkillError if its file lacks them.
    """
    if not skill.demonstrations:
        raise SkillError(
            f"skill {skill.name!r} cannot be refined: its file does not hold the demonstrations "
            f"that it was learned from; {REMEDY}"
        )
    try:
        arrays = arrays_in(skill.demonstrations)
        about = validated(msgspec.json.decode(arrays["about"].tobytes()), tuple[_About, ...])
        ends = np.cumsum([entry.samples for entry in about])
        columns = [np.split(arrays[name], ends) for name in ("stamps", "poses", "closures")]
        out = [
            _demonstration(entry, *parts)
            for entry, *parts in zip(about, *(part[:-1] for part in columns), strict=True)
        ]
        for _, demonstration in out:
            check(demonstration)
    except (ValueError, KeyError, IndexError, zipfile.BadZipFile, msgspec.MsgspecError) as error:
        raise SkillError(
            f"skill {skill.name!r} cannot be refined: its demonstrations are damaged "
            f"({in_words(error, named=False)}); {REMEDY}"
        ) from None
    return out


def _demonstration(
    about: _About, stamps: np.ndarray, poses: np.ndarray, closures: np.ndarray
) -> NamedDemonstration:
    left, right, tool = (poses[:, first : first + 7].astype(np.float64) for first in (0, 7, 14))
    return NamedDemonstration(
        printable(about.name),
        Demonstration(
            stamps.astype(np.int64),
            left,
            right,
            tool,
            about.frame,
            about.via_points,
            closures.astype(np.float64) if about.has_gripper else None,
            about.conducts,
            about.person,
            about.begins,
            about.begun_s,
        ),
    )
