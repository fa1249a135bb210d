"""Skills: learned from demonstrations, adapted to places, and the same to the bit after a trip
through a file.
"""

from __future__ import annotations

import io
import pickle
import zipfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from kmp.storage import checksum
from service.contract.requests import ViaPoint
from service.core.frame import Vector
from service.core.skill import Skill
from service.learning.demonstration import Demonstration
from service.learning.learn import GATE, learn, mean_orientation
from service.learning.skill_file import SkillError, decoded, with_file
from service.learning.via_points import adapted, in_force
from sim.scene import Scene
from sim.script import HandMotions, HandScript
from sim.teach import demonstrations

SCENE = Scene()
PLACES = SCENE.via_points()
HANDOVER = PLACES[0]
LATE = 40  # samples of 10 ms


def demonstrated(count: int, *, late: int = 0) -> list[Demonstration]:
    """Demonstrations of the scene, in which the tool trails the hands by some samples."""
    out = []
    for taught in demonstrations(SCENE, count=count, seed=1):
        stamps, left, right = (part[late:] for part in taught[:3])
        out.append(Demonstration(stamps, left, right, taught.tool[: len(taught.tool) - late]))
    return out


def quickly(taught: Sequence[Demonstration]) -> Skill:
    """A coarse skill of two demonstrations, learned in no time."""
    return learn(taught, name="coarse", components=5, points=60)


def error_m(skill: Skill, held_out: Sequence[Demonstration]) -> float:
    """The mean distance between predicted and demonstrated tool [m]."""
    return float(
        np.mean([np.linalg.norm(skill.primitive.mean(one.hands) - one.tool[:, :3], axis=1).mean() for one in held_out])
    )


def deviations(skill: Skill, hands: Vector) -> Vector:
    """Standard deviations (T,) of the predictions for hands (T, 6) at rest [m]."""
    still = np.zeros((2, 3))
    return np.array([skill.predict(one.reshape(2, 3), still, still).deviation for one in hands])


def with_hands(place: ViaPoint, *, left: Sequence[float] = (0.0, 0.0, 0.0)) -> Vector:
    """Hands (6,) at a place, the left one off by some metres."""
    return np.array([*(np.array(place.left) + left), *place.right])


@pytest.fixture(scope="module")
def taught() -> list[Demonstration]:
    """Three demonstrations to learn from and three to hold out."""
    return demonstrated(6)


@pytest.fixture(scope="module")
def learned(taught: list[Demonstration]) -> Skill:
    return learn(taught[:3], name="soldering")


@pytest.fixture(scope="module")
def coarse(taught: list[Demonstration]) -> Skill:
    return quickly(taught[:2])


@pytest.fixture(scope="module")
def aimed(learned: Skill) -> Skill:
    return adapted(learned, PLACES, tolerance=0.05)


# --- learning ------------------------------------------------------------------------------------


def test_a_demonstration_that_was_held_out_is_predicted_to_some_centimetres(
    learned: Skill, taught: list[Demonstration]
) -> None:
    assert error_m(learned, taught[3:]) < 0.035


def test_learning_is_deterministic(coarse: Skill, taught: list[Demonstration]) -> None:
    assert quickly(taught[:2]).file == coarse.file


def test_a_tool_that_lags_is_put_in_phase(coarse: Skill, taught: list[Demonstration]) -> None:
    late = quickly(demonstrated(2, late=LATE))
    assert error_m(late, taught[3:]) < error_m(coarse, taught[3:]) + 0.006
    assert late.learned_from != coarse.learned_from


def test_the_box_holds_the_demonstrated_tool_with_a_margin(learned: Skill, taught: list[Demonstration]) -> None:
    tool = np.concatenate([one.tool[:, :3] for one in taught[:3]])
    np.testing.assert_allclose(learned.workspace, [tool.min(axis=0) - 0.25, tool.max(axis=0) + 0.25])


def test_the_gate_lets_demonstrations_through_and_nothing_far_from_them(
    aimed: Skill, taught: list[Demonstration]
) -> None:
    for one in taught:
        assert deviations(aimed, one.hands[::20]).max() <= aimed.threshold / (GATE / 1.5)
        assert deviations(aimed, one.hands[::20] + np.array([0.0, 0.0, 0.5] * 2)).min() > aimed.threshold


def test_the_tools_orientation_is_that_of_the_demonstrations(learned: Skill, taught: list[Demonstration]) -> None:
    np.testing.assert_allclose(learned.orientation, taught[0].tool[0, 3:], atol=1e-6)


def test_a_mean_orientation_does_not_mind_signs() -> None:
    random = np.random.default_rng(0)
    near = np.array([0.0, 0.9, 0.0, 0.44]) + 0.01 * random.normal(size=(50, 4))
    flipped = near * random.choice([-1.0, 1.0], size=(50, 1))
    np.testing.assert_allclose(mean_orientation(flipped), mean_orientation(near), atol=1e-12)
    assert np.linalg.norm(mean_orientation(flipped)) == pytest.approx(1.0)


def test_demonstrations_that_cannot_be_learned_from_are_refused(taught: list[Demonstration]) -> None:
    one = taught[0]
    turned = one.tool.copy()
    turned[:, 3:] *= 2
    for wrong, message in (
        ([], "no demonstrations given, at least 1 needed"),
        ([one.every(400)], "3 samples is too short"),
        ([one._replace(stamps_ns=one.stamps_ns * 0)], "too short"),
        ([one._replace(tool=np.full_like(one.tool, np.nan))], "not finite"),
        ([one._replace(tool=turned)], "not quaternions of norm 1"),
        ([one._replace(left=1000 * one.left)], "is it in metres"),
        ([one.every(132)._replace(stamps_ns=one.stamps_ns[:9])], "cannot learn from [0-9]+ samples"),
    ):
        with pytest.raises(SkillError, match=message):
            learn(wrong)


def test_a_demonstration_of_unequal_lengths_is_refused(taught: list[Demonstration]) -> None:
    with pytest.raises(SkillError, match="500 left"):
        learn([taught[0]._replace(left=taught[0].left[:500])])


# --- prediction ----------------------------------------------------------------------------------


def stacked(hands: HandMotions) -> tuple[Vector, Vector, Vector]:
    """Positions, velocities and accelerations (2, 3) of both hands."""
    return tuple(np.stack(pair) for pair in zip(hands.left, hands.right, strict=True))  # type: ignore[return-value]


@pytest.mark.parametrize("t", [0.7, 1.5, 2.6, 4.4, 5.9, 7.6, 8.8])
def test_velocity_and_acceleration_are_those_of_the_predicted_motion(aimed: Skill, t: float) -> None:
    script, h = HandScript(SCENE, seed=11), 1e-3
    before, now, after = (
        aimed.primitive.mean(stacked(script.truth(at))[0].reshape(1, 6))[0] for at in (t - h, t, t + h)
    )
    prediction = aimed.predict(*stacked(script.truth(t)))
    np.testing.assert_allclose(prediction.position, now, atol=1e-6)
    np.testing.assert_allclose(prediction.velocity, (after - before) / (2 * h), atol=1e-5)
    np.testing.assert_allclose(prediction.acceleration, (after - 2 * now + before) / h**2, atol=1e-4)


def test_hands_at_rest_ask_for_no_motion(aimed: Skill) -> None:
    prediction = aimed.predict(with_hands(HANDOVER).reshape(2, 3), np.zeros((2, 3)), np.zeros((2, 3)))
    assert not prediction.velocity.any()
    assert not prediction.acceleration.any()


def test_a_prediction_is_rounded_and_its_covariance_is_one(learned: Skill, taught: list[Demonstration]) -> None:
    random = np.random.default_rng(2)
    prediction = learned.predict(
        taught[4].hands[300].reshape(2, 3), random.normal(size=(2, 3)), random.normal(size=(2, 3))
    )
    for value in prediction[:3]:
        np.testing.assert_array_equal(value, np.round(value, 6))
    np.testing.assert_array_equal(prediction.covariance, prediction.covariance.T)
    assert np.linalg.eigvalsh(prediction.covariance).min() > 0
    assert prediction.deviation == pytest.approx(np.sqrt(np.trace(prediction.covariance) / 3))


# --- places --------------------------------------------------------------------------------------


def test_places_are_met(aimed: Skill) -> None:
    assert [point.name for point in in_force(aimed)] == ["handover", "glass", "soldering"]
    assert all(point.missed_by_m < 0.003 for point in in_force(aimed))


def test_a_place_without_neighbours_is_met(learned: Skill) -> None:
    place = ViaPoint("there", left=(0.8, -0.2, 0.2), right=(0.95, 0.35, 0.1), tool=(0.5, 0.0, 0.3))
    (point,) = in_force(adapted(learned, [place], tolerance=0.05))
    assert point.missed_by_m < 0.0005


@pytest.mark.parametrize("step", [(0.02, 0.0, 0.0), (0.0, -0.02, 0.0), (0.0, 0.0, 0.02), (-0.01, 0.01, 0.01)])
def test_a_neighbourhood_follows_the_left_hand(aimed: Skill, step: tuple[float, ...]) -> None:
    np.testing.assert_allclose(
        aimed.primitive.mean([with_hands(HANDOVER, left=step)])[0], np.add(HANDOVER.tool, step), atol=0.006
    )


@pytest.mark.parametrize("step", [(0.02, 0.0, 0.0), (0.0, -0.02, 0.0), (0.0, 0.0, 0.02)])
def test_a_flat_neighbourhood_stays_where_it_is(aimed: Skill, step: tuple[float, ...]) -> None:
    glass = PLACES[1]
    np.testing.assert_allclose(aimed.primitive.mean([with_hands(glass, left=step)])[0], glass.tool, atol=0.006)


def test_forgetting_all_places_gives_the_skill_as_it_was_learned(learned: Skill, aimed: Skill) -> None:
    assert aimed.digest != learned.digest
    assert adapted(aimed, (), tolerance=learned.tolerance).file == learned.file


def test_places_are_taught_to_the_base_and_not_on_top_of_each_other(learned: Skill, aimed: Skill) -> None:
    anew = adapted(aimed, PLACES[1:], tolerance=0.05)
    assert anew.file == adapted(learned, PLACES[1:], tolerance=0.05).file
    assert [place.name for place in aimed.via_points] == ["handover", "glass", "soldering"]


def test_places_that_cannot_be_taught_are_named(learned: Skill) -> None:
    with pytest.raises(SkillError, match=r"handover.*tolerance is -1"):
        adapted(learned, [HANDOVER], tolerance=-1.0)


# --- files ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("places", [(), PLACES])
def test_a_trip_through_a_file_changes_no_bit(
    learned: Skill, places: tuple[ViaPoint, ...], taught: list[Demonstration]
) -> None:
    sent = adapted(learned, places, tolerance=0.04)
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
    for one, other in zip(
        (sent.primitive.mean(queries), sent.primitive.predict(queries).covariance, sent.primitive.jacobian(queries[3])),
        (back.primitive.mean(queries), back.primitive.predict(queries).covariance, back.primitive.jacobian(queries[3])),
        strict=True,
    ):
        assert one.tobytes() == other.tobytes()


def test_a_skill_from_a_file_adapts_as_the_one_that_was_written(learned: Skill) -> None:
    back = decoded(learned.file, origin="a file")
    assert adapted(back, PLACES, tolerance=0.05).file == adapted(learned, PLACES, tolerance=0.05).file


def test_the_shipped_skill_is_what_its_file_says(skill: Skill) -> None:
    assert skill.name == "soldering"
    assert skill.via_points == ()
    assert with_file(replace(skill, file=b"")).file == skill.file


def test_there_is_no_pickle_in_a_file(aimed: Skill) -> None:
    with np.load(io.BytesIO(aimed.file), allow_pickle=False) as arrays:
        assert all(arrays[name].dtype != object for name in arrays.files)
        assert "[m]" in str(arrays["units"])


def changed(skill: Skill, **arrays: Any) -> bytes:
    """The skill's file with some arrays in place of its own, and their checksum; None leaves one
    out.
    """
    with np.load(io.BytesIO(skill.file), allow_pickle=False) as original:
        kept = {name: value for name, value in (dict(original) | arrays).items() if value is not None}
    if not any(value.dtype == object for value in kept.values()):
        kept |= {"checksum": np.array(checksum(kept))} if "checksum" not in arrays else {}
    out = io.BytesIO()
    np.savez(out, allow_pickle=True, **kept)
    return out.getvalue()


def array_file() -> bytes:
    out = io.BytesIO()
    np.save(out, np.zeros(3))
    return out.getvalue()


def empty_archive() -> bytes:
    out = io.BytesIO()
    zipfile.ZipFile(out, "w").close()
    return out.getvalue()


@pytest.mark.parametrize(
    "garbage", [b"", b"nonsense", b"PK\x03\x04 nonsense", pickle.dumps({"a": 1}), empty_archive(), array_file()]
)
def test_a_file_that_is_no_skill_is_refused_by_name(garbage: bytes) -> None:
    with pytest.raises(SkillError, match=r"nonsense\.npz: not a skill"):
        decoded(garbage, origin="nonsense.npz")


def test_a_truncated_file_is_refused(skill: Skill) -> None:
    whole = skill.file
    for size in range(0, len(whole), len(whole) // 40):
        with pytest.raises(SkillError, match=r"x\.npz"):
            decoded(whole[:size], origin="x.npz")


def test_a_damaged_file_is_refused_or_read_and_never_anything_else(skill: Skill) -> None:
    random = np.random.default_rng(0)
    whole = skill.file
    directory = whole.index(b"PK\x01\x02")
    for start in (0, directory):
        for _ in range(200):
            damaged = bytearray(whole)
            damaged[random.integers(start, len(whole))] = random.integers(256)
            try:
                decoded(bytes(damaged), origin="x.npz")
            except SkillError:
                continue


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        ({"format": np.array(2)}, "skill of format 2, 1 needed"),
        ({"format": np.array([1, 2])}, "x.npz"),
        ({"format": np.array("new")}, "x.npz"),
        ({"box": None}, "box"),
        ({"base_inputs": np.zeros(3)}, "inputs"),
        ({"base_inputs": np.zeros((200, 2)), "via_inputs": np.zeros((0, 2))}, "2 inputs and 3 outputs, 6 and 3 needed"),
        ({"ell": np.array(-1.0)}, "ell has -1"),
        ({"places": np.array('[{"name": "a"}]')}, "left"),
        ({"name": np.array([{}], dtype=object)}, "x.npz"),
    ],
)
def test_a_wrong_array_is_named(skill: Skill, arrays: dict[str, Any], message: str) -> None:
    with pytest.raises(SkillError, match=r"^x\.npz: ") as caught:
        decoded(changed(skill, **arrays), origin="x.npz")
    assert message in str(caught.value)


@pytest.mark.parametrize(
    "arrays",
    [
        {"threshold": np.array(np.nan)},
        {"threshold": np.array(-1.0)},
        {"box": np.full((2, 3), np.nan)},
        {"box": np.zeros(3)},
        {"box": np.array([[1.0, 1.0, 1.0], [0.0, 0.0, 0.0]])},
        {"orientation": np.zeros(4)},
        {"orientation": np.zeros(3)},
        {"weights": np.full((200, 3), np.nan)},
    ],
    ids=lambda arrays: f"{next(iter(arrays))} {np.ravel(next(iter(arrays.values())))[0]:g}",
)
def test_an_array_that_would_harm_the_motion_is_refused(skill: Skill, arrays: dict[str, Any]) -> None:
    with pytest.raises(SkillError, match=next(iter(arrays))):
        decoded(changed(skill, **arrays), origin="x.npz")


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        ({"weights": np.full((200, 3), 1e300)}, "weights has 1e+300, -1e+12 to 1e+12 accepted"),
        ({"base_weights": np.full((200, 3), 1e300), "weights": np.full((200, 3), 1e300)}, "base_weights has 1e+300"),
        ({"base_weights": np.full((200, 3), 5e3), "weights": np.full((200, 3), 5e3)}, "where it was learned, the tool"),
        ({"weights": np.zeros((200, 3), complex)}, "weights has numbers of type complex128, real ones needed"),
        ({"threshold": np.array(0.5 + 2j)}, "threshold has numbers of type complex128"),
        ({"ell": np.array(1e300)}, "ell has 1e+300, 0.001 to 10000 1/m² accepted"),
        ({"lambda_mean": np.array(1e300)}, "lambda_mean has 1e+300"),
        ({"lambda_covariance": np.array(1e-300)}, "lambda_covariance has 1e-300"),
        ({"prior_mean": np.array([0.0, 1e5, 0.0])}, "prior_mean has 100000, -10 to 10 m accepted"),
        ({"base_inputs": np.full((200, 6), 1e9)}, "base_inputs has 1e+09"),
        ({"base_inputs": np.zeros((2501, 6))}, "2501 reference points, at most 2500 accepted"),
        ({"box": np.array([[-1e9] * 3, [1e9] * 3])}, "box has -1e+09"),
        ({"threshold": np.array(1e300)}, "threshold has 1e+300"),
        ({"tolerance": np.array(-1.0)}, "tolerance has -1"),
        ({"components": np.array(-3)}, "components has -3"),
        ({"name": np.array("x" * 201)}, "name is no text of up to 200 letters"),
        ({"name": np.array(3)}, "name is no text"),
        ({"checksum": None}, "no checksum: written by an earlier version"),
        ({"checksum": np.array("0" * 32)}, "the checksum is another"),
        ({"tolerance": np.array(0.06), "checksum": np.array("0" * 32)}, "the checksum is another"),
    ],
    ids=lambda value: value[:40] if isinstance(value, str) else "",
)
def test_what_no_skill_has_is_refused_with_what_is_accepted(skill: Skill, arrays: dict[str, Any], message: str) -> None:
    with pytest.raises(SkillError) as caught:
        decoded(changed(skill, **arrays), origin="x.npz")
    assert str(caught.value).startswith("x.npz: ")
    assert message in str(caught.value)


def test_a_bit_that_flips_in_a_file_changes_nothing_or_is_refused(aimed: Skill) -> None:
    random, whole = np.random.default_rng(8), aimed.file
    same = 0
    for _ in range(400):
        damaged = bytearray(whole)
        damaged[random.integers(len(whole))] ^= 1 << int(random.integers(8))
        try:
            back = decoded(bytes(damaged), origin="x.npz")
        except SkillError:
            continue
        same += 1
        assert with_file(replace(back, file=b"")).file == whole
    assert same < 40


def test_a_recording_may_hold_a_skill_of_an_earlier_version(skill: Skill) -> None:
    old = changed(skill, checksum=None)
    assert with_file(replace(decoded(old, origin="a recording", recorded=True), file=b"")).file == skill.file


def test_a_file_that_unpacks_to_much_is_not_unpacked(skill: Skill) -> None:
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as archive, archive.open("format.npy", "w") as file:
        file.write(b"\x93NUMPY\x01\x00")
        for _ in range(101):
            file.write(bytes(1_000_000))
    with pytest.raises(SkillError, match=r"101000008 bytes unpacked, at most 100000000 accepted"):
        decoded(out.getvalue(), origin="x.npz")


def moved(point: ViaPoint, name: str, *, hands: float, tool: float, **more: Any) -> ViaPoint:
    """A via-point whose left hand and tool are elsewhere [m]."""
    left, at = point.left, point.tool
    return msgspec.structs.replace(
        point, name=name, left=(left[0] + hands, left[1], left[2]), tool=(at[0], at[1] + tool, at[2]), **more
    )


EXACT = msgspec.structs.replace(HANDOVER, radius=0.0, std=0.0001)


@pytest.mark.parametrize("hands", [0.0, 0.001, 0.01, 0.05])
def test_places_that_contradict_each_other_are_refused_by_name(skill: Skill, hands: float) -> None:
    steep = 4.0 * hands + 0.001 + 0.0006
    with pytest.raises(SkillError, match=r"'handover' and 'twin' contradict each other: their hands are") as caught:
        adapted(skill, (EXACT, moved(EXACT, "twin", hands=hands, tool=steep + 0.001)), tolerance=0.05)
    assert f"4 times as far, {steep:.4f} m, accepted" in str(caught.value)
    allowed = adapted(skill, (EXACT, moved(EXACT, "twin", hands=hands, tool=steep - 0.0005)), tolerance=0.05)
    here = np.array([*EXACT.left, *EXACT.right])
    assert np.linalg.norm(allowed.primitive.jacobian(here), 2) < 10.0


def test_places_that_are_not_exact_contradict_less_and_neighbourhoods_more(skill: Skill) -> None:
    adapted(skill, (EXACT, moved(EXACT, "twin", hands=0.001, tool=0.05, std=0.02)), tolerance=0.05)
    apart = moved(EXACT, "twin", hands=0.05, tool=0.12)
    adapted(skill, (EXACT, apart), tolerance=0.05)
    with pytest.raises(SkillError, match="contradict each other"):
        adapted(skill, (EXACT, msgspec.structs.replace(apart, radius=0.025)), tolerance=0.05)


def test_a_skill_file_can_be_read_from_disk_as_bytes(tmp_path: Path, aimed: Skill) -> None:
    file = tmp_path / "aimed.npz"
    file.write_bytes(aimed.file)
    assert decoded(file.read_bytes(), origin=str(file)).digest == aimed.digest
