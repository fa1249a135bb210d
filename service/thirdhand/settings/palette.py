"""The colours of all pictures, by Okabe and Ito, which people with any colour vision can
distinguish. A thing has the same colour in the viewer's scene and curves and in reports.

Text and lines have a contrast of at least 4.5 to 1, as WCAG 2 computes it. Blue and vermillion are
therefore a little lighter than in the original, and all colours are darker on paper.
"""

from __future__ import annotations

from collections.abc import Sequence

from thirdhand.contract.records import Mode

Colour = tuple[int, int, int]
ORANGE = (230, 159, 0)
SKY = (86, 180, 233)
GREEN = (0, 158, 115)
YELLOW = (240, 228, 66)
BLUE = (38, 138, 204)
VERMILLION = (216, 96, 2)
PURPLE = (204, 121, 167)
GREY = (160, 165, 173)
LEFT = SKY
RIGHT = ORANGE
TOOL = GREEN
TARGET = PURPLE
MEASURED = YELLOW
NEAREST = VERMILLION
VIA_POINT = GREY
OFF = BLUE  # curve of the hands' deviation
GATE = VERMILLION  # curve of the deviation above which the arm holds
LATENCY = PURPLE
WORK = SKY
LATENESS = ORANGE
BY_TRACK = {"left": LEFT, "right": RIGHT, "tool": TOOL}  # the paths of hands and tool
BY_JOINT = (SKY, ORANGE, GREEN, PURPLE, YELLOW, BLUE, VERMILLION)
BY_MODE: dict[Mode, Colour] = {Mode.HOLD: ORANGE, Mode.FOLLOW: GREEN, Mode.FAULT: VERMILLION}
ARM_BODY: Colour = (200, 203, 208)
# white with the tint of a hold or a fault, the darkest background of plots
PAPER: Colour = (248, 240, 234)
RGB = (0.2126, 0.7152, 0.0722)  # weights of red, green and blue in the luminance
LEAST_CONTRAST = 4.5  # WCAG 2 requires this for text
BACKGROUND = (24, 27, 33)
TABLE = (58, 63, 72)
GRID = (70, 76, 86)


def faint(colour: Colour, opacity: float) -> tuple[int, int, int, int]:
    """A translucent colour of an opacity from 0 to 1."""
    return (*colour, round(255 * opacity))


def light(colour: Sequence[int]) -> Colour:
    """A lighter colour for words on a dark background; the opacity is ignored."""
    red, green, blue = (128 + value // 2 for value in colour[:3])
    return red, green, blue


def packed(colour: Colour) -> int:
    """A colour as one number, with red in the highest byte."""
    red, green, blue = colour
    return red << 24 | green << 16 | blue << 8 | 0xFF


def contrast(one: Colour, other: Colour) -> float:
    """The contrast of two colours, from 1 to 21, by WCAG 2."""
    darker, lighter = sorted(sum(map(_luminance, RGB, colour)) for colour in (one, other))
    return (lighter + 0.05) / (darker + 0.05)


def _luminance(share: float, value: int) -> float:
    return share * (value / 3294.6 if value <= 10 else ((value / 255 + 0.055) / 1.055) ** 2.4)


def written(colour: Colour) -> str:
    """A colour in the form `#3b7ba0`, darkened until its contrast to paper suffices."""
    while contrast(colour, PAPER) < LEAST_CONTRAST:
        red, green, blue = colour
        colour = red - (red > 0), green - (green > 0), blue - (blue > 0)
    return "#{:02x}{:02x}{:02x}".format(*colour)
