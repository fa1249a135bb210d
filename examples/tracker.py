"""A tracker of both hands: here two that sway where the shipped skill was learned; put your own
camera's poses in their place. Try: thirdhand hands --own examples/tracker.py:SwayingHands
"""

import math
import time

import thirdhand

# frame base [m]: x forward from the arm, y to its left, z up
LEFT = (0.98, -0.32, 0.06)
RIGHT = (0.98, 0.32, 0.06)


class SwayingHands(thirdhand.Hands):
    """Hands that sway by 2 cm."""

    rate_hz = 100

    def read(self) -> tuple[thirdhand.Pose, thirdhand.Pose]:
        sway = 0.02 * math.sin(2 * math.pi * 0.3 * time.monotonic())
        left, right = ((x, y + sway, z) for x, y, z in (LEFT, RIGHT))
        return left, right  # None for a hand that is not seen
