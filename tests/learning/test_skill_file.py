"""A skill's file: it restores the same bits, and is refused if it was changed."""

from __future__ import annotations

import io
import pickle
import zipfile
from dataclasses import replace
from random import Random
from typing import Any

import numpy as np
import pytest

from support.skills import figures_of, file_with
from support.taught_scene import VIA_POINTS
from thirdhand.contract.requests import ViaPoint
from thirdhand.core.frame import Vector
from thirdhand.core.skill.skill import Skill
from thirdhand.skills.demonstration import Demonstration
from thirdhand.skills.skill_file import SkillError, decoded, with_file
from thirdhand.skills.via_points import adapted


def predicted(skill: Skill, hands: Vector) -> tuple[Vector, ...]:
    primitive = skill.model.primitive
    return skill.mean(hands), skill.model.covariances(hands), primitive.jacobian(hands[3])


@pytest.mark.parametrize("via_points", [(), VIA_POINTS])
def test_file_returns_same_bits(
    learned: Skill, via_points: tuple[ViaPoint, ...], taught: list[Demonstration]
) -> None:
    sent = adapted(learned, via_points, tolerance=0.04)
    back = with_file(replace(decoded(sent.file, origin="a file"), file=b""))
    assert back.file == sent.file
    assert back.digest == sent.digest
    assert (back.name, back.via_points, back.tolerance, back.threshold) == (
        sent.name,
        sent.via_points,
        0.04,
        sent.threshold,
    )
    queries = taught[5].hands[::50]
    for array, other in zip(*(predicted(skill, queries) for skill in (sent, back)), strict=True):
        assert array.tobytes() == other.tobytes()
    assert (
        adapted(back, VIA_POINTS[:2], tolerance=0.05).file
        == adapted(learned, VIA_POINTS[:2], tolerance=0.05).file
    )


def test_figures_of_a_file(skill: Skill, learned: Skill) -> None:
    assert figures_of(decoded(learned.file, origin="a file")) == figures_of(learned)
    assert decoded(skill.file, origin="a file").figures == ""


def array_file() -> bytes:
    out = io.BytesIO()
    np.save(out, np.zeros(3))
    return out.getvalue()


def empty_archive() -> bytes:
    out = io.BytesIO()
    zipfile.ZipFile(out, "w").close()
    return out.getvalue()


@pytest.mark.parametrize(
    "garbage",
    [
        b"",
        b"nonsense",
        b"PK\x03\x04 nonsense",
        pickle.dumps({"a": 1}),
        empty_archive(),
        array_file(),
    ],
)
def test_foreign_file_is_refused(garbage: bytes) -> None:
    """The error names the file."""
    with pytest.raises(SkillError, match=r"nonsense\.npz: not a skill"):
        decoded(garbage, origin="nonsense.npz")


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        (
            {"format": np.array(5)},
            "skill of format 5, of 6 needed: learn it anew with this version",
        ),
        ({"corners": np.zeros(1)}, "is missing"),
        ({"via_directions": np.zeros((0, 6))}, "an array 'via_directions', which no skill has"),
        ({"figures": np.array("{")}, "figures is no JSON"),
        ({"format": np.array([1, 2])}, "x.npz"),
        (
            {"conductor": np.array(-1)},
            "conductor is -1: 0 for the left hand or 1 for the right one accepted",
        ),
        (
            {"base_inputs": np.zeros((200, 2)), "via_inputs": np.zeros((0, 2))},
            "2 inputs and 3 outputs, 6 and 3 needed",
        ),
        ({"name": np.array([{}], dtype=object)}, "x.npz"),
        ({"task_clock": np.full(13, np.inf)}, "task_clock is [inf"),
        ({"threshold": np.array(np.nan)}, "threshold"),
        ({"box": np.full((2, 3), np.nan)}, "box"),
        ({"box": np.array([[1.0, 1.0, 1.0], [0.0, 0.0, 0.0]])}, "box"),
        ({"orientation": np.zeros(4)}, "orientation"),
        ({"weights": np.full((200, 3), 1e300)}, "weights has 1e+300, -1e+12 to 1e+12 accepted"),
        (
            {"base_weights": np.full((200, 3), 5e3), "weights": np.full((200, 3), 5e3)},
            "where it was learned, the tool",
        ),
        (
            {"weights": np.zeros((200, 3), complex)},
            "weights has numbers of type complex128, real ones needed",
        ),
        ({"ell": np.array(1e300)}, "ell has 1e+300, 0.001 to 10000 1/m² accepted"),
        ({"prior_mean": np.array([0.0, 1e5, 0.0])}, "prior_mean has 100000, -10 to 10 m accepted"),
        ({"base_inputs": np.zeros((2501, 6))}, "2501 reference points, at most 2500 accepted"),
        ({"box": np.array([[-1e9] * 3, [1e9] * 3])}, "box has -1e+09"),
        ({"threshold": np.array(12.9)}, "threshold has 12.9, 1e-06 to 1 m accepted"),
        ({"name": np.array("x" * 201)}, "name is no text of up to 200 letters"),
        ({"checksum": None}, "not a skill (the array 'checksum' is missing)"),
        ({"checksum": np.array("0" * 32)}, "the checksum is another"),
    ],
    ids=lambda value: value[:40] if isinstance(value, str) else "",
)
def test_wrong_arrays_are_refused(skill: Skill, arrays: dict[str, Any], message: str) -> None:
    """The error names the accepted values."""
    with pytest.raises(SkillError, match=r"^x\.npz: ") as caught:
        decoded(file_with(skill, **arrays), origin="x.npz")
    assert message in str(caught.value)


@pytest.mark.parametrize("begin", [b"", b"PK\x01\x02"], ids=["anywhere", "in the directory"])
def test_flipped_bit_changes_nothing_or_is_refused(aimed: Skill, begin: bytes) -> None:
    random = np.random.default_rng(8)
    whole = aimed.file
    unchanged = 0
    for _ in range(400):
        damaged = bytearray(whole)
        damaged[random.integers(whole.index(begin), len(whole))] ^= 1 << int(random.integers(8))
        try:
            back = decoded(bytes(damaged), origin="x.npz")
        except SkillError:
            continue
        unchanged += 1
        assert with_file(replace(back, file=b"")).file == whole
    assert unchanged < 40


def test_large_archive_is_not_unpacked() -> None:
    """The archive would unpack to too many bytes."""
    out = io.BytesIO()
    with (
        zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as archive,
        archive.open("format.npy", "w") as file,
    ):
        file.write(b"\x93NUMPY\x01\x00")
        for _ in range(101):
            file.write(bytes(1_000_000))
    with pytest.raises(SkillError, match=r"101000008 bytes unpacked, at most 100000000 accepted"):
        decoded(out.getvalue(), origin="x.npz")


def test_damaged_archive_is_told_apart(skill: Skill) -> None:
    """Other files are refused as no archive."""
    random = Random(5)
    for _ in range(30):
        cut = skill.file[: random.randrange(4, len(skill.file))]
        with pytest.raises(SkillError, match=r"^x: not a skill \(a damaged \.npz archive\)$"):
            decoded(cut, origin="x")
        for begin in (b"", b"P", b"PK", b"PK\x03", b"PK\x07\x08"):
            with pytest.raises(SkillError, match=r"^x: not a skill \(no \.npz archive\)$"):
                decoded(begin + bytes(random.randrange(256) for _ in range(200)), origin="x")


@pytest.mark.parametrize("name", ["", "  ", "a/b", "x" * 129])
def test_invalid_name_is_refused(learned: Skill, name: str) -> None:
    """The name is empty or a path."""
    with pytest.raises(SkillError, match="1 to 128 characters without / accepted"):
        decoded(with_file(replace(learned, name=name)).file, origin="a file")


def test_too_many_arrays_are_refused(learned: Skill) -> None:
    """The refusal is immediate."""
    out = io.BytesIO(learned.file)
    with zipfile.ZipFile(out, "a") as archive:
        for number in range(1000):
            archive.writestr(f"{number}.npy", b"")
    with pytest.raises(SkillError, match="arrays in an archive, at most 500 accepted"):
        decoded(out.getvalue(), origin="a file")
