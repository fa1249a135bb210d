"""The banner in the scene: mode and reason in large letters on the mode's colour."""

from __future__ import annotations

import functools

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from service.contract.incidents import explained, word
from service.contract.records import Mode, Reason
from service.settings import palette

WIDTH, HEIGHT = 640, 80  # pixels
LETTERS, MARGIN = 44, 24


def title(mode: int, reason: int) -> str:
    """Mode and reason in words: `hold: no hands`."""
    return ": ".join(filter(None, (word(Mode(mode)), word(Reason(reason)).replace("_", " "))))


def line(mode: int, reason: int) -> str:
    """The same for the log, and what the reason means."""
    return ": ".join(filter(None, (title(mode, reason), explained(Reason(reason)).why)))


@functools.cache
def banner(mode: int, reason: int) -> NDArray[np.uint8]:
    """The picture (HEIGHT, WIDTH, 3) that shows mode and reason."""
    image = Image.new("RGB", (WIDTH, HEIGHT), palette.BY_MODE[Mode(mode)])
    draw, text, size = ImageDraw.Draw(image), title(mode, reason), LETTERS
    while draw.textlength(text, font=ImageFont.load_default(size)) > WIDTH - 2 * MARGIN:
        size -= 1
    draw.text((MARGIN, HEIGHT / 2), text, fill=(0, 0, 0), anchor="lm", font=ImageFont.load_default(size))
    return np.asarray(image)
