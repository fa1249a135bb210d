"""The moving picture of the demo: the one in the README, and how it is made."""

from __future__ import annotations

import itertools

import numpy as np
from PIL import Image

from support.paths import ROOT
from thirdhand.core.controller import Controller
from thirdhand.recordings.shipped import shipped_skill
from thirdhand.settings.config import Settings, robot_description
from thirdhand_sim.bench import Bench
from thirdhand_sim.closed_loop import ClosedLoop
from thirdhand_sim.film import (
    FRAME_HZ,
    PICTURE_PX,
    PLAYBACK_SPEED,
    Film,
)
from thirdhand_sim.scene import Scene
from thirdhand_sim.script import HandScript


def test_the_picture_in_the_readme_is_small_lasts_some_seconds_and_moves() -> None:
    path = ROOT / "docs" / "demo.webp"
    assert path.stat().st_size <= 2_000_000
    assert "(docs/demo.webp)" in "\n".join((ROOT / "README.md").read_text(encoding="utf-8").splitlines()[:12])
    lasts_ms = 0
    with Image.open(path) as picture:
        assert picture.size == PICTURE_PX
        frames = []
        for number in range(picture.n_frames):
            picture.seek(number)
            frames.append(np.asarray(picture.convert("RGB"), int))
            lasts_ms += picture.info["duration"]
    assert 4000 < lasts_ms < 10_000
    moved = [np.abs(b - a).max() for a, b in itertools.pairwise(frames)]
    assert np.median(moved) > 60


def test_pictures_are_taken_as_the_script_goes() -> None:
    scene = Scene()
    with Bench(HandScript(scene, seed=scene.seed)) as bench:
        film, loop = Film(bench), ClosedLoop(bench)
        settings = Settings()
        one = Controller(settings, shipped_skill().for_loop(), urdf=robot_description(settings))
        for tick in loop.ticks():
            frame = one.step(tick)
            loop.follow(tick, frame)
            film.look(tick, frame)
            if bench.time_s > 0.5:
                break
    assert len(film.pictures) == int(0.5 * FRAME_HZ / PLAYBACK_SPEED) + 1
    assert {picture.size for picture in film.pictures} == {PICTURE_PX}
