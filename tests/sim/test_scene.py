"""The scene: what a file may say, and the places that follow from it."""

from __future__ import annotations

import math
from pathlib import Path

import pytest

from thirdhand_sim.scene import Scene, SceneError


def load(folder: Path, text: str) -> Scene:
    path = folder / "scene.toml"
    path.write_text(text, encoding="utf-8")
    return Scene.load(path)


def test_the_nominal_scene_lasts_as_long_as_its_phases_and_rests() -> None:
    scene = Scene()
    assert [end for segment in scene.segments for end in segment] == pytest.approx([0.0, 3.0, 3.4, 6.9, 7.3, 10.3])
    assert scene.duration_s == pytest.approx(10.6)


def test_an_empty_file_is_the_nominal_scene(tmp_path: Path) -> None:
    assert load(tmp_path, "") == Scene()


def test_a_file_moves_what_it_names_and_what_hangs_on_it(tmp_path: Path) -> None:
    scene = load(tmp_path, "soldering = [0.70, 0.10, 0.08]\nseed = 7\n")
    assert scene.seed == 7
    assert scene.carry == pytest.approx((0.57, 0.10, 0.28))
    assert scene.right_final == pytest.approx((0.73, 0.16, 0.13))
    assert scene.handover == Scene().handover


def test_the_three_taught_places_are_flat_neighbourhoods_and_only_the_handover_follows_a_hand() -> None:
    scene = Scene()
    handover, glass, soldering = scene.via_points()
    assert [p.name for p in (handover, glass, soldering)] == ["handover", "glass", "soldering"]
    assert [p.follow for p in (handover, glass, soldering)] == ["left", "none", "none"]
    assert {(p.radius, p.std) for p in (handover, glass, soldering)} == {(0.03, 0.001)}
    assert (handover.left, handover.tool) == (scene.handover, scene.offer)
    assert handover.right == scene.right_start
    assert (glass.left, glass.right, glass.tool) == (scene.soldering, scene.iron, scene.glass)
    assert (soldering.left, soldering.right, soldering.tool) == (scene.soldering, scene.right_final, scene.carry)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("handovr = [0.6, 0, 0.3]", ["handovr", "known are", "handover"]),
        ("handover = [0.62, -0.28]", ["handover"]),
        ("handover = [0.62, -0.28, 0.46]", ["handover", "0.16 m", "0.15 m"]),
        ("handover = [nan, -0.28, 0.30]", ["handover", "0.15 m"]),
        ("handover = [620.0, -280.0, 300.0]", ["handover", "Is it in metres?"]),
        ("soldering = [0.75, 0.0, 0.04]", ["soldering", "4.0 cm above the table", "5 cm"]),
        ("phases_s = [3.0, 0.0, 3.0]", ["phases_s, entry 2"]),
        ("seed = -1", ["seed"]),
        ("seed = ", ["scene.toml"]),
    ],
)
def test_a_file_that_cannot_be_played_is_refused_in_words(tmp_path: Path, text: str, words: list[str]) -> None:
    with pytest.raises(SceneError) as refused:
        load(tmp_path, text)
    assert all(word in str(refused.value) for word in words), str(refused.value)


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(SceneError, match=r"cannot read scene .*nowhere\.toml"):
        Scene.load(tmp_path / "nowhere.toml")


def test_a_place_may_lie_at_the_very_edge(tmp_path: Path) -> None:
    scene = load(tmp_path, "handover = [0.62, -0.28, 0.45]")
    assert math.dist(scene.handover, Scene().handover) == pytest.approx(0.15)
