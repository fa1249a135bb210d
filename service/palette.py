"""The colours of all pictures: those of Okabe and Ito, which people of every colour vision tell
apart; each thing has one, in the viewer's scene and curves, in reports and beside skills alike.
"""

from __future__ import annotations

from collections.abc import Sequence

from service.contract.records import Mode

Colour = tuple[int, int, int]
ORANGE, SKY, GREEN, YELLOW = (230, 159, 0), (86, 180, 233), (0, 158, 115), (240, 228, 66)
BLUE, VERMILLION, PURPLE, GREY = (0, 114, 178), (213, 94, 0), (204, 121, 167), (160, 165, 173)
LEFT, RIGHT, TOOL, TARGET, MEASURED, NEAREST, PLACE = SKY, ORANGE, GREEN, PURPLE, YELLOW, VERMILLION, GREY
OFF = BLUE  # deviation of the hands
GATE = VERMILLION  # deviation above which it holds
LATENCY, WORK, LATENESS = PURPLE, SKY, ORANGE
JOINTS = (SKY, ORANGE, GREEN, PURPLE, YELLOW, BLUE, VERMILLION)
MODES: dict[Mode, Colour] = {Mode.HOLD: ORANGE, Mode.FOLLOW: GREEN, Mode.FAULT: VERMILLION}
ARM: Colour = (200, 203, 208)
BACKGROUND, TABLE, GRID = (24, 27, 33), (58, 63, 72), (70, 76, 86)


def faint(colour: Colour, opacity: float) -> tuple[int, int, int, int]:
    """A colour that lets through what is behind it."""
    return (*colour, round(255 * opacity))


def light(colour: Sequence[int]) -> Colour:
    """A colour, its opacity aside, in which a word is read on what is dark."""
    red, green, blue = (128 + value // 2 for value in colour[:3])
    return red, green, blue


def packed(colour: Colour) -> int:
    """A colour as one number, red first."""
    red, green, blue = colour
    return red << 24 | green << 16 | blue << 8 | 0xFF


def written(colour: Colour) -> str:
    """A colour as pages and plots take it, like `#56b4e9`."""
    return "#{:02x}{:02x}{:02x}".format(*colour)
