"""Colours: words on the colour of a mode are legible."""

from __future__ import annotations

from thirdhand.contract.records import Mode
from thirdhand.settings import palette
from thirdhand.settings.palette import BY_MODE, LEAST_CONTRAST, PAPER, contrast
from thirdhand.workbench.report.page import MODE_COLOURS, TINT


def channels(colour: str) -> palette.Colour:
    """A colour's channels from its hexadecimal form."""
    red, green, blue = bytes.fromhex(colour[1:])
    return red, green, blue


def test_words_on_a_mode_are_read_in_the_banner_and_on_a_page() -> None:
    for mode, colour in BY_MODE.items():
        assert contrast((0, 0, 0), colour) >= LEAST_CONTRAST
        assert contrast((255, 255, 255), channels(MODE_COLOURS[mode])) >= LEAST_CONTRAST
        if mode is not Mode.FOLLOW:  # plots are tinted in other modes
            tinted = [round(255 - TINT * (255 - value)) for value in channels(MODE_COLOURS[mode])]
            assert all(value >= paper for value, paper in zip(tinted, PAPER, strict=True))
