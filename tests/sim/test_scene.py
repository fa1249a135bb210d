"""The scene: its file, and the places that follow from it."""

from __future__ import annotations

from pathlib import Path

import pytest

from thirdhand_sim.scene import Scene, SceneError


def load(folder: Path, text: str) -> Scene:
    path = folder / "scene.toml"
    path.write_text(text, encoding="utf-8")
    return Scene.load(path)


def test_an_empty_file_is_the_nominal_scene(tmp_path: Path) -> None:
    assert load(tmp_path, "") == Scene()


def test_file_moves_what_it_names(tmp_path: Path) -> None:
    """Places that depend on them move too."""
    scene = load(tmp_path, "soldering = [0.70, 0.10, 0.08]\nseed = 7\n")
    assert scene.seed == 7
    assert scene.carry == pytest.approx((0.57, 0.10, 0.28))
    assert scene.right_final == pytest.approx((0.73, 0.16, 0.13))
    assert scene.handover == Scene().handover


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
def test_unplayable_file_is_refused(tmp_path: Path, text: str, words: list[str]) -> None:
    """The error is a sentence."""
    with pytest.raises(SceneError) as refused:
        load(tmp_path, text)
    assert all(word in str(refused.value) for word in words), str(refused.value)
