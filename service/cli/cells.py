"""`thirdhand cells`: the daemons on a network, and the status of each."""

from __future__ import annotations

import argparse
import sys

import msgspec

from service.cli.usage import reached
from service.client import Cell
from service.client import cells as served_cells
from service.contract.incidents import in_brief
from service.contract.requests import ANY_DIRECTION


def cells(args: argparse.Namespace) -> int:
    """Print the cells; exit code 0 if any daemon is alive, else 1."""
    with reached(args) as session:
        served = served_cells(session)
    if args.json:
        print(msgspec.json.format(msgspec.json.encode([cell._asdict() for cell in served])).decode())
    elif served:
        width = max(len(cell.name) for cell in served)
        for cell in served:
            print(f"{cell.name:<{width}}  {description(cell)}")
    if not served:
        print("thirdhand cells: no daemon is alive on this network", file=sys.stderr)
    return 0 if served else 1


def description(cell: Cell) -> str:
    """A daemon's status in one line."""
    now = cell.status
    if now is None:
        return f"alive as Zenoh session {cell.session}, but without a status: it is starting, or denies access"
    mode = in_brief(now.mode, now.reason)
    hands = ", ".join(now.hand_age_ms) or "no hands"
    limits = f"  tool {now.tool_limits[ANY_DIRECTION].text}" if ANY_DIRECTION in now.tool_limits else ""
    limits += f", now limited by {now.binding}" * bool(now.binding)
    parts = f"{mode:<24} {now.rate_hz:7.2f} Hz  {now.missed} missed  {hands}  skill {now.skill}  version {now.version}"
    return parts + limits
