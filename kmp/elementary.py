"""Elementary functions with the same bits on every processor.

Those of a C library differ in the last bit between processors with and without fused multiply-add.
These use additions, multiplications, divisions and square roots alone, which IEEE 754 rounds
correctly, in a fixed order. Errors are below 3 units in the last place; those of `tanh` and `acos`
are below 7e-16.
"""

from __future__ import annotations

import math

import numpy as np

from kmp.compiled import compiled

# log(2) and pi / 2 as sums of two numbers, the first with so few bits that its products with
# integers below 2^20 are exact.
LOG_2_HIGH = float.fromhex("0x1.62e42fee00000p-1")
LOG_2_LOW = float.fromhex("0x1.a39ef35793c76p-33")
HALF_PI_HIGH = float.fromhex("0x1.921fb54400000p+0")
HALF_PI_LOW = float.fromhex("0x1.0b4611a626331p-34")
LARGEST_EXPONENT = 708.0  # exp of more is infinite, exp of less than its negative is 0

# Coefficients of Taylor series without their first terms, from the last one on.
EXP_SERIES = tuple(1.0 / math.factorial(n) for n in range(13, 1, -1))
SIN_SERIES = tuple((-1.0) ** (n // 2) / math.factorial(n) for n in range(17, 1, -2))
COS_SERIES = tuple((-1.0) ** (n // 2) / math.factorial(n) for n in range(16, 2, -2))
LOG_SERIES = tuple(2.0 / n for n in range(23, 1, -2))
ATAN_SERIES = tuple((-1.0) ** (n // 2) / n for n in range(23, 1, -2))


@compiled
def polynomial(coefficients: tuple[float, ...], x: float) -> float:
    """The sum of c_i x^(n - i) over the n + 1 coefficients c_i, by Horner's rule."""
    total = 0.0
    for coefficient in coefficients:
        total = total * x + coefficient
    return total


@compiled
def exp(x: float) -> float:
    """exp(x) = 2^k exp(r), with k = round(x / log 2) and the series of exp(r)."""
    if x < -LARGEST_EXPONENT:
        return 0.0
    if not x <= LARGEST_EXPONENT:
        return x + math.inf
    k = math.floor(x / (LOG_2_HIGH + LOG_2_LOW) + 0.5)
    r = (x - k * LOG_2_HIGH) - k * LOG_2_LOW
    power = np.int64((np.int64(k) + 1023) << 52).view(np.float64)  # 2^k
    return float((1.0 + (r + r * r * polynomial(EXP_SERIES, r))) * power)


@compiled
def log(x: float) -> float:
    """log(x) of an x > 0, x = 2^k m: k log 2 + log m, with the series in (m - 1) / (m + 1)."""
    m, k = math.frexp(x)
    if m < 0.7071067811865476:
        m *= 2.0
        k -= 1
    s = (m - 1.0) / (m + 1.0)
    return k * LOG_2_HIGH + (
        k * LOG_2_LOW + (2.0 * s + s * (s * s) * polynomial(LOG_SERIES, s * s))
    )


@compiled
def tanh(x: float) -> float:
    """tanh(x) = sign(x) (1 - 2 / (exp(2 |x|) + 1))."""
    return math.copysign(1.0 - 2.0 / (exp(2.0 * abs(x)) + 1.0), x)


@compiled
def sin_cos(x: float) -> tuple[float, float]:
    """Sine and cosine of an angle below 10^6, by their series at x - k pi / 2."""
    k = math.floor(x / (HALF_PI_HIGH + HALF_PI_LOW) + 0.5)
    r = (x - k * HALF_PI_HIGH) - k * HALF_PI_LOW
    square = r * r
    sine = r + r * square * polynomial(SIN_SERIES, square)
    cosine = 1.0 - (0.5 * square - square * square * polynomial(COS_SERIES, square))
    quarter = k % 4
    if quarter == 1:
        return cosine, -sine
    if quarter == 2:
        return -sine, -cosine
    if quarter == 3:
        return -cosine, sine
    return sine, cosine


@compiled
def atan2(y: float, x: float) -> float:
    """The angle of the point (x, y), in [-pi, pi].

    With t = min(|x|, |y|) / max(|x|, |y|), atan(t) = 4 atan(u), where each of two steps halves the
    angle: t -> t / (1 + sqrt(1 + t^2)).
    """
    largest = max(abs(x), abs(y))
    if largest == 0.0:
        return 0.0
    t = min(abs(x), abs(y)) / largest
    for _ in range(2):
        t /= 1.0 + math.sqrt(1.0 + t * t)
    angle = 4.0 * (t + t * (t * t) * polynomial(ATAN_SERIES, t * t))
    if abs(y) > abs(x):
        angle = HALF_PI_HIGH - (angle - HALF_PI_LOW)
    if x < 0.0:
        angle = 2.0 * HALF_PI_HIGH - (angle - 2.0 * HALF_PI_LOW)
    return math.copysign(angle, y)


@compiled
def acos(x: float) -> float:
    """The angle in [0, pi] whose cosine is x, from -1 to 1."""
    return atan2(math.sqrt((1.0 - x) * (1.0 + x)), x)
