"""`thirdhand via-points add NAME --here`: the positions of hands and tool from a running daemon."""

from __future__ import annotations

import argparse
import math
import time
from typing import Any, TypeAlias

from thirdhand.cli.usage import reached
from thirdhand.client import Client
from thirdhand.contract.explain import ExplainedError
from thirdhand.contract.records import SIDES
from thirdhand.process.progress import say

STILL_S = 1.0  # hands and tool hold still if they move less than STILL_M within this time
STILL_M = 0.015  # trackers are noisy, and hands tremble
MAX_HAND_AGE_MS = 200.0  # an older position of a hand is not used
HERE_TIMEOUT_S = 30.0  # hands and tool must hold still within this time
HERE_POLL_S = 0.05
Sample: TypeAlias = tuple[float, dict[str, list[float]]]  # time [s], and positions [m] by name


class NotHereError(ExplainedError, RuntimeError):
    """Hands or tool are not seen, or do not hold still."""


def still(args: argparse.Namespace) -> dict[str, list[float]]:
    """The positions [m] of the skill's hands and of the tool that the arguments do not give, once
    they hold still.

    The tool's position is measured if the arm publishes its joints, else commanded. Raises
    NotHereError if hands or tool are not seen, or move, for HERE_TIMEOUT_S.
    """
    reported: set[str] = set()
    samples: list[Sample] = []
    with reached(args, HERE_TIMEOUT_S) as session:
        client = Client(session, args.cell)
        client.wait_until_ready(timeout_s=HERE_TIMEOUT_S)
        names = _needed(args, client.status().hands)
        say(f"waiting until {', '.join(names)} are seen and hold still for {STILL_S:g} s")
        begun_s = time.monotonic()
        while True:
            now = client.ask("status")
            now_s = time.monotonic()
            lacking = _not_seen(now, names)
            if lacking.keys() - reported:
                say("; ".join(lacking.values()))
            reported = set(lacking)

            samples = [] if lacking else _near([*samples, (now_s, _positions(now, names))])
            if samples and now_s - samples[0][0] >= STILL_S:
                return samples[-1][1]
            if now_s - begun_s > HERE_TIMEOUT_S:
                raise NotHereError(
                    "nothing was taught: "
                    f"{'; '.join(lacking.values()) or 'hands or tool did not hold still'}"
                )
            time.sleep(HERE_POLL_S)


def _needed(args: argparse.Namespace, hands: str) -> list[str]:
    """The hands that the skill follows, and the tool, unless the arguments give their position."""
    sides = [side for side in SIDES if hands in ("both", side)]
    return [name for name in (*sides, "tool") if not getattr(args, name)]


def _positions(status: dict[str, Any], names: list[str]) -> dict[str, list[float]]:
    """The positions [m] of hands and tool in a status, by name."""
    tool = status["tool_measured_m"] or status["tool_m"]
    positions = {**status["hands_m"], "tool": tool}
    return {name: positions[name] for name in names}


def _near(samples: list[Sample]) -> list[Sample]:
    """The newest samples, from the first one on at which nothing is far from the newest."""
    _, newest = samples[-1]
    begin = next(
        i
        for i, (_, positions) in enumerate(samples)
        if all(math.dist(positions[name], newest[name]) <= STILL_M for name in newest)
    )
    return samples[begin:]


def _not_seen(status: dict[str, Any], wanted: list[str]) -> dict[str, str]:
    """Messages on the wanted positions that are not known now, by name."""
    messages = {}
    for side in (side for side in SIDES if side in wanted):
        age_ms = status["hand_age_ms"].get(side) if side in status["hands_m"] else None
        if age_ms is None or age_ms > MAX_HAND_AGE_MS:
            ago = (
                "has not been seen yet"
                if age_ms is None
                else f"was last seen {age_ms / 1000:.1f} s ago"
            )
            messages[side] = f"the {side} hand {ago}; --{side} X Y Z gives its position"
    return messages | (
        {"tool": "the tool's position is unknown before the first tick"}
        if status["tick"] < 0
        else {}
    )
