"""`thirdhand cells`: the daemons on a network, and what each does."""

from __future__ import annotations

import argparse
import sys

import msgspec

from service.cli.clients import reached
from service.client import Cell
from service.client import cells as found


def cells(args: argparse.Namespace) -> int:
    """Exit code 0 if any daemon is alive, 1 if none is."""
    with reached(args) as session:
        there = found(session)
    if args.json:
        print(msgspec.json.format(msgspec.json.encode([cell._asdict() for cell in there])).decode())
    elif there:
        width = max(len(cell.name) for cell in there)
        for cell in there:
            print(f"{cell.name:<{width}}  {said(cell)}")
    if not there:
        print("thirdhand cells: no daemon is alive on this network", file=sys.stderr)
    return 0 if there else 1


def said(cell: Cell) -> str:
    """What a daemon does, in a line."""
    now = cell.status
    if now is None:
        return f"alive as Zenoh session {cell.session}, and does not tell its status"
    mode = now.mode + (f" ({now.reason})" if now.reason else "")
    hands = ", ".join(now.hand_age_ms) or "no hands"
    return f"{mode:<24} {now.rate_hz:7.2f} Hz  {now.missed} missed  {hands}  skill {now.skill}  version {now.version}"
