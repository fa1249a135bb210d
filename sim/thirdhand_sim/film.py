"""`python -m thirdhand_sim.film`: the demo as a short moving picture, for the README.

The closed loop runs in one process, so that each run gives the same picture on any machine. The
bench draws it without a screen at twice its size, which smooths the edges.
"""

from __future__ import annotations

from thirdhand.process import one_blas_thread  # noqa: F401

# isort: split
import argparse
from collections import deque
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from thirdhand.contract.records import Mode
from thirdhand.core.controller import Controller, run
from thirdhand.core.frame import Frame, Tick
from thirdhand.recordings.shipped import shipped_skill
from thirdhand.settings import palette
from thirdhand.settings.config import Settings, robot_description
from thirdhand.skills.via_points import adapted
from thirdhand_sim.bench import Bench
from thirdhand_sim.closed_loop import ClosedLoop
from thirdhand_sim.scene import Scene
from thirdhand_sim.script import HandScript
from thirdhand_sim.world import Floats, pixels

CAMERA_M = (1.66, -0.78, 0.80)
LOOK_AT_M = (0.53, -0.02, 0.31)
PICTURE_PX = (640, 420)  # width and height
FINER = 2  # drawn pixels per shown pixel
FRAME_HZ = 15
PLAYBACK_SPEED = 2  # the film is twice as fast as the bench
PATH_S = 1.2  # paths are drawn over this time
LAST_FRAME_S = 1.5  # duration of the last frame
FILM_TOLERANCE_M = 0.001
QUALITY = 80  # [%] quality of WebP
PATH_COLOURS = (palette.LEFT, palette.RIGHT, palette.TOOL)
SKY_ABOVE = np.array((236, 240, 245))
SKY_BELOW = np.array((206, 214, 224))
CAPTIONS = (
    "The left hand comes: the robot hands the board over",
    "The hands go on: it fetches the magnifying glass",
    "The right hand solders: it holds the glass over the board",
)


class Film:
    """The pictures of a run, taken while the bench runs."""

    def __init__(self, bench: Bench) -> None:
        self._bench = bench
        self._ways: deque[Floats] = deque(maxlen=round(PATH_S * FRAME_HZ / PLAYBACK_SPEED))
        self.pictures: list[Image.Image] = []

    def look(self, _: Tick, frame: Frame) -> None:
        """Take a picture if it is due."""
        bench = self._bench
        if bench.time_s * FRAME_HZ / PLAYBACK_SPEED > len(self.pictures):
            seen = bench.observe()
            self._ways.append((*seen.hands.left.position, *seen.hands.right.position, *seen.tool.position))
            self.pictures.append(self._picture(Mode(int(frame["mode"]))))

    def _picture(self, mode: Mode) -> Image.Image:
        bench, size = self._bench, (FINER * PICTURE_PX[0], FINER * PICTURE_PX[1])
        colours, matrix = bench.world.picture(eye=CAMERA_M, target=LOOK_AT_M, size=size)
        blend = np.linspace(0, 1, size[1])[:, None, None]
        sky = (SKY_ABOVE * (1 - blend) + SKY_BELOW * blend).astype(np.uint8)
        image = Image.fromarray(np.where((colours == 255).all(axis=2, keepdims=True), sky, colours))
        draw, ways = ImageDraw.Draw(image), np.array(self._ways).reshape(-1, 3, 3)
        for number, colour in enumerate(PATH_COLOURS):
            corners = pixels(ways[:, number], matrix, size)
            for i in range(1, len(corners)):
                width = round(FINER * 5 * i / len(corners)) + 1  # the newest is the widest
                draw.line((*corners[i - 1], *corners[i]), fill=colour, width=width)
        self._write(draw, mode)
        return image.resize(PICTURE_PX, Image.Resampling.LANCZOS)

    def _write(self, draw: ImageDraw.ImageDraw, mode: Mode) -> None:
        """Write the caption, and the mode on its colour."""
        height, margin = FINER * 34, FINER * 12
        ends = [end for _, end in self._bench.scene.dwells]
        caption = CAPTIONS[min(int(np.searchsorted(ends, self._bench.time_s)), len(CAPTIONS) - 1)]
        letters = ImageFont.load_default(FINER * 16)
        draw.rectangle((0, 0, FINER * PICTURE_PX[0], height), fill=palette.BACKGROUND)
        draw.text((margin, height / 2), caption, fill=palette.ARM_BODY, anchor="lm", font=letters)
        word = mode.name.lower()
        left = FINER * PICTURE_PX[0] - draw.textlength(word, font=letters) - 2 * margin
        draw.rectangle((left, 0, FINER * PICTURE_PX[0], height), fill=palette.BY_MODE[mode])
        draw.text((left + margin, height / 2), word, fill=(0, 0, 0), anchor="lm", font=letters)


def filmed(scene: Scene) -> list[Image.Image]:
    """The pictures of one run of the scene, with its via-points taught."""
    settings = Settings()
    with Bench(HandScript(scene, seed=scene.seed), settings=settings) as bench:
        film, loop = Film(bench), ClosedLoop(bench)
        skill = adapted(shipped_skill(), scene.via_points(), tolerance=FILM_TOLERANCE_M)
        controller = Controller(settings, skill.for_loop(), urdf=robot_description(settings))
        run(controller, loop.ticks(), [loop.follow, film.look])
        return film.pictures


def main(arguments: list[str] | None = None) -> int:
    """Write the moving picture; exit code 0."""
    p = argparse.ArgumentParser(prog="python -m thirdhand_sim.film", description="The demo as a moving picture (WebP).")
    p.add_argument("--output", metavar="FILE", type=Path, default=Path("docs/demo.webp"), help="default: %(default)s")
    args = p.parse_args(arguments)
    first, *others = filmed(Scene())
    lasts_ms = [1000 // FRAME_HZ] * len(others) + [round(1000 * LAST_FRAME_S)]
    first.save(args.output, save_all=True, append_images=others, duration=lasts_ms, loop=0, quality=QUALITY, method=6)
    print(f"{args.output}: {1 + len(others)} frames, {sum(lasts_ms) / 1000:.1f} s")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
