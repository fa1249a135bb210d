"""`thirdhand via-points add NAME --here`: the positions of hands and tool from a running daemon."""

from __future__ import annotations

import argparse
import math
import time
from typing import Any

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


class NotHereError(ExplainedError, RuntimeError):
    """Hands or tool are not seen, or do not hold still."""


def still(args: argparse.Namespace) -> dict[str, list[float]]:
    """The positions [m] of the skill's hands and of the tool that the arguments do not give, once
    they hold still.

    The tool's position is measured if the arm publishes its joints, else commanded. Raises
    NotHereError if hands or tool are not seen, or move, for HERE_TIMEOUT_S.
    """
    reported: set[str] = set()
    samples: list[tuple[float, dict[str, list[float]]]] = []
    with reached(args, HERE_TIMEOUT_S) as session:
        client = Client(session, args.cell)
        client.wait_until_ready(timeout_s=HERE_TIMEOUT_S)
        hands = client.status().hands
        going = [name for name in (*SIDES, "tool") if name not in SIDES or hands in ("both", name)]
        names = [name for name in going if not getattr(args, name)]
        say(f"waiting until {', '.join(names)} are seen and hold still for {STILL_S:g} s")
        begun_s = time.monotonic()
        while True:
            now = client.ask("status")
            at_s = time.monotonic()
            lacking = _not_seen(now, names)
            if lacking.keys() - reported:
                say("; ".join(lacking.values()))
            reported = set(lacking)
            if lacking:
                samples.clear()
            else:
                positions = {**now["hands_m"], "tool": now["tool_measured_m"] or now["tool_m"]}
                samples.append((at_s, {name: positions[name] for name in names}))
                while any(
                    math.dist(samples[0][1][name], samples[-1][1][name]) > STILL_M for name in names
                ):
                    samples.pop(0)
                if at_s - samples[0][0] >= STILL_S:
                    return samples[-1][1]
            if at_s - begun_s > HERE_TIMEOUT_S:
                raise NotHereError(
                    "nothing was taught: "
                    f"{'; '.join(lacking.values()) or 'hands or tool did not hold still'}"
                )
            time.sleep(HERE_POLL_S)


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
