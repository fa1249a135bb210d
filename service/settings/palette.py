"""The colours of all pictures: those of Okabe and Ito, which people of every colour vision tell
apart; each thing has one, in the viewer's scene and curves, in reports and beside skills alike.

Text and lines differ from their background by 4.5 to 1 at least, as WCAG 2 computes it. So blue and
vermillion are a little lighter than theirs, and all are darker on paper.
"""

from __future__ import annotations

from collections.abc import Sequence

from service.contract.records import Mode

Colour = tuple[int, int, int]
ORANGE, SKY, GREEN, YELLOW = (230, 159, 0), (86, 180, 233), (0, 158, 115), (240, 228, 66)
BLUE, VERMILLION, PURPLE, GREY = (38, 138, 204), (216, 96, 2), (204, 121, 167), (160, 165, 173)
LEFT, RIGHT, TOOL, TARGET, MEASURED, NEAREST, PLACE = SKY, ORANGE, GREEN, PURPLE, YELLOW, VERMILLION, GREY
OFF = BLUE  # deviation of the hands
GATE = VERMILLION  # deviation above which it holds
LATENCY, WORK, LATENESS = PURPLE, SKY, ORANGE
JOINTS = (SKY, ORANGE, GREEN, PURPLE, YELLOW, BLUE, VERMILLION)
MODES: dict[Mode, Colour] = {Mode.HOLD: ORANGE, Mode.FOLLOW: GREEN, Mode.FAULT: VERMILLION}
ARM: Colour = (200, 203, 208)
PAPER: Colour = (248, 240, 234)  # white, with the tint of a hold or a fault
RGB = (0.2126, 0.7152, 0.0722)  # shares of luminance
LEAST_CONTRAST = 4.5
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


def contrast(one: Colour, other: Colour) -> float:
    """The contrast of two colours, from 1 to 21, by WCAG 2."""
    darker, lighter = sorted(sum(map(_luminance, RGB, colour)) for colour in (one, other))
    return (lighter + 0.05) / (darker + 0.05)


def _luminance(share: float, value: int) -> float:
    return share * (value / 3294.6 if value <= 10 else ((value / 255 + 0.055) / 1.055) ** 2.4)


def written(colour: Colour) -> str:
    """A colour as pages and plots take it, like `#3b7ba0`: dark enough on paper."""
    while contrast(colour, PAPER) < LEAST_CONTRAST:
        red, green, blue = colour
        colour = red - (red > 0), green - (green > 0), blue - (blue > 0)
    return "#{:02x}{:02x}{:02x}".format(*colour)
