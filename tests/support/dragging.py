"""A person at the page for a mouse, who finds the hands on it, drags and lifts them."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable
from typing import Any

from support.chromium import Tab

STEP_S = 0.016  # interval of a mouse's or a finger's events
DRAG_S = 0.5  # duration of a drag
ARRIVE_S = 10.0
PIXEL_M = 0.01  # [m] largest error of a drag, which moves from pixel to pixel
WHEEL_M = 0.0002  # [m] lift of a hand by one unit of the wheel


class Person:
    """Drags hands on a page. `drag` moves a pointer along pixels, `lift` a hand by a height [m]."""

    def __init__(self, tab: Tab) -> None:
        self.tab = tab

    def hand(self, side: str, what: str = "at") -> tuple[float, float, float]:
        """The position at which a hand is drawn, or with `aim` the one to which it was dragged
        [m].
        """
        x, y, z = self._found(f"hands.{side}.{what}")
        return x, y, z

    def pixel(self, at: tuple[float, float, float]) -> tuple[float, float]:
        """The pixel of the page at which a point of the bench is drawn."""
        corner = "canvas.getBoundingClientRect()"
        x, y = self._found(
            f"(shown.plan ?? plan()).flat({list(at)}).map((v, i) => v + {corner}[i ? 'y' : 'x'])"
        )
        return x, y

    def _found(self, expression: str) -> Any:
        """The value of an expression, which may be an array or an object."""
        return json.loads(self.tab.ask(f"JSON.stringify({expression})"))

    def drag(self, side: str, to: tuple[float, float, float]) -> None:
        """Drag a hand to a point with the mouse, and turn the wheel until the heights agree."""
        self.along(self.pixel(self.hand(side)), self.pixel(to), self.tab.mouse)
        end = time.monotonic() + ARRIVE_S  # the page may still process mouse events
        while math.dist(self.hand(side, "aim")[:2], to[:2]) > PIXEL_M and time.monotonic() < end:
            time.sleep(STEP_S)
        pixel = self.pixel(self.hand(side, "aim"))
        self.tab.mouse(
            "Wheel", *pixel, deltaX=0, deltaY=-(to[2] - self.hand(side, "aim")[2]) / WHEEL_M
        )

    @staticmethod
    def along(
        start: tuple[float, float], end: tuple[float, float], mouse: Callable[..., None]
    ) -> None:
        """Press at a pixel, move evenly to another one, and release."""
        mouse("Pressed", *start)
        steps = round(DRAG_S / STEP_S)
        begun_s = time.monotonic()
        for i in range(1, steps + 1):
            mouse("Moved", *(a + i / steps * (b - a) for a, b in zip(start, end, strict=True)))
            time.sleep(max(0.0, begun_s + i * STEP_S - time.monotonic()))
        mouse("Released", *end)

    def arrive(self, side: str, to: tuple[float, float, float], within_m: float = 0.01) -> None:
        """Wait until a hand has arrived at a point."""
        end = time.monotonic() + ARRIVE_S
        while math.dist(self.hand(side), to) > within_m:
            assert time.monotonic() < end, f"{side} hand: {self.hand(side)}, {to} wanted"
            time.sleep(0.05)
