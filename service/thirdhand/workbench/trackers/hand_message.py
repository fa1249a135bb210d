"""The binary messages of a page: its hands, and a ping to compare clocks.

All numbers are little endian. A message of hands has 120 bytes:

    offset  type       content
    0       uint32     HANDS_MAGIC
    4       uint8      which hands are seen: 1 left, 2 right, 3 both
    5       uint8      epoch: it is raised where the page's coordinate frame has moved
    6       uint16     number, which grows by 1 with each message and wraps
    8       float64    time of the frame [ms since 1970, by the server's clock]
    16      float64    time from there to the moment that the poses are predicted for [ms]
    24, 72  12 float32 left and right hand: palm position (3) [m], orientation x y z w (4), tip of
                       the index finger (3) [m], distance of thumb and index tip [m], spare

A ping has 16 bytes, PING_MAGIC (uint32), 4 spare bytes and a float64. The answer is the same bytes,
then the server's time as float64 [ms since 1970].
"""

from __future__ import annotations

import math
import struct
from typing import NamedTuple

from thirdhand.contract.messages import Quaternion, Vector3, WireError, finite
from thirdhand.contract.records import SIDES

HANDS_MAGIC = 0x53444E48
PING_MAGIC = 0x474E4950
HANDS_LAYOUT = struct.Struct("<IBBHdd12f12f")
PING = struct.Struct("<I4xd")
SERVER_TIME = struct.Struct("<d")
HAND_FLOATS = 12
MAX_AHEAD_MS = 200.0  # a headset predicts less than this
MAX_CLOCK_ERROR_MS = 1000.0  # a page that compares clocks is never ahead by this
MAX_AGE_MS = 60_000.0  # a larger age is caused by a wrong clock, not by a delay
UNIT_TOLERANCE = 0.01  # tolerance of a quaternion's norm, as in the daemon


class PageHand(NamedTuple):
    """One hand in a message: palm position [m] and orientation x y z w, tip of the index finger
    [m], and distance of thumb and index tip [m], all in the page's frame.
    """

    side: str
    position: Vector3
    orientation: Quaternion
    index_tip: Vector3
    pinch_m: float


class PageHands(NamedTuple):
    """The hands in a message; `stamp_ns` is the time for which they are measured or predicted."""

    epoch: int
    number: int
    stamp_ns: int
    hands: tuple[PageHand, ...]


def is_ping(data: bytes) -> bool:
    """True for a ping."""
    return len(data) == PING.size and PING.unpack(data)[0] == PING_MAGIC


def pong(ping: bytes, now_ns: int) -> bytes:
    """The answer to a ping."""
    return ping + SERVER_TIME.pack(now_ns / 1e6)


def decode_hands(data: bytes, now_ns: int) -> PageHands:
    """The hands in a message that arrives at `now_ns` [ns since 1970].

    A prediction is stamped as if it were measured now: stamp = min(predicted, now). Raises
    WireError for anything that no page of this service sends.
    """
    if len(data) != HANDS_LAYOUT.size:
        raise WireError(f"a message of {len(data)} bytes, {HANDS_LAYOUT.size} needed")
    magic, seen_bits, epoch, number, at_ms, ahead_ms, *values = HANDS_LAYOUT.unpack(data)
    if magic != HANDS_MAGIC or not 1 <= seen_bits <= 3:
        raise WireError("not a message of hands")
    if not 0.0 <= ahead_ms <= MAX_AHEAD_MS:
        raise WireError(f"poses predicted {ahead_ms:g} ms ahead, 0 to {MAX_AHEAD_MS:g} accepted")
    age_ms = now_ns / 1e6 - at_ms
    if not -MAX_CLOCK_ERROR_MS <= age_ms <= MAX_AGE_MS:
        raise WireError(f"hands of {_ago(age_ms)}: the page's clock is wrong")
    hands = tuple(
        _hand(side, values[HAND_FLOATS * i : HAND_FLOATS * (i + 1)])
        for i, side in enumerate(SIDES)
        if seen_bits >> i & 1
    )
    return PageHands(epoch, number, min(int((at_ms + ahead_ms) * 1e6), now_ns), hands)


def _hand(side: str, values: list[float]) -> PageHand:
    if not finite(tuple(values[:11])):
        raise WireError(f"{side} hand: a number that is not finite")
    if values[10] < 0.0:
        raise WireError(f"{side} hand: a distance of {values[10]:g} m, 0 or more accepted")
    x, y, z, w = values[3:7]
    norm = math.sqrt(x * x + y * y + z * z + w * w)
    if abs(norm - 1.0) > UNIT_TOLERANCE:
        raise WireError(f"{side} hand: a quaternion of norm {norm:.3g}, 1 needed")
    turn = (x / norm, y / norm, z / norm, w / norm)  # float32 leaves 1e-7
    return PageHand(
        side, (values[0], values[1], values[2]), turn, (values[7], values[8], values[9]), values[10]
    )


def _ago(age_ms: float) -> str:
    """An age in words."""
    if not math.isfinite(age_ms):
        return "no time"
    return f"{abs(age_ms) / 1000:.4g} s {'ago' if age_ms > 0 else 'ahead'}"
