"""The banner in the scene: mode and reason in large letters on the mode's colour."""

from __future__ import annotations

import functools

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from thirdhand.contract.incidents import title, what_happened, word
from thirdhand.contract.records import Flag, Mode, Reason
from thirdhand.settings import palette
from thirdhand.settings.config import Settings

# pixels
WIDTH = 640
HEIGHT = 80
LETTERS = 44
MARGIN = 24


def _incident(reason: int, is_engaging: bool) -> str:
    """The word for the reason, or for an arm that engages; empty for one that follows."""
    return word(Flag.ENGAGING) if is_engaging else word(Reason(reason))


def headline(mode: int, reason: int, is_engaging: bool = False) -> str:
    """Mode and reason as one title: `hold: no hands yet`, `follow: engaging`."""
    return ": ".join(filter(None, (title(word(Mode(mode))), title(_incident(reason, is_engaging)))))


def log_line(mode: int, reason: int, is_engaging: bool, settings: Settings) -> str:
    """The headline, and what happened."""
    named = _incident(reason, is_engaging)
    return ": ".join(
        filter(None, (headline(mode, reason, is_engaging), what_happened(named, settings)))
    )


@functools.cache
def banner(mode: int, reason: int, is_engaging: bool = False) -> NDArray[np.uint8]:
    """The picture (HEIGHT, WIDTH, 3) that shows the headline."""
    image = Image.new("RGB", (WIDTH, HEIGHT), palette.BY_MODE[Mode(mode)])
    draw = ImageDraw.Draw(image)
    text = headline(mode, reason, is_engaging)
    size = LETTERS
    while draw.textlength(text, font=ImageFont.load_default(size)) > WIDTH - 2 * MARGIN:
        size -= 1
    draw.text(
        (MARGIN, HEIGHT / 2), text, fill=(0, 0, 0), anchor="lm", font=ImageFont.load_default(size)
    )
    return np.asarray(image)
