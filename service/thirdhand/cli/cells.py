"""`thirdhand status --all`: the daemons on a network, and the status of each, once or live."""

from __future__ import annotations

import argparse
import contextlib
import sys
import time
from collections.abc import Iterable

import msgspec
import zenoh
from rich.console import Console
from rich.live import Live
from rich.table import Table
from rich.text import Text

from thirdhand.cli.status import MODE_STYLES
from thirdhand.cli.usage import reached
from thirdhand.client import Cell
from thirdhand.client import cells as served_cells
from thirdhand.contract.incidents import in_brief
from thirdhand.contract.requests import ANY_DIRECTION
from thirdhand.process import interrupt

WATCH_S = 1.0  # interval of --watch, and the time in which a daemon has to answer
DISAPPEARED_S = 2.5  # a cell that was not seen for this time has disappeared
HEADS = ("cell", "mode", "rate [Hz]", "late [µs]", "missed", "hands", "skill", "version", "")
MOST_LETTERS = 1000  # of a line that is not printed on a terminal


def cells(args: argparse.Namespace) -> int:
    """Print the cells; exit code 0 if any daemon is alive, else 1. With --watch until Ctrl-C."""
    with reached(args) as session:
        if args.watch:
            _watch(session, args)
        served = served_cells(session)
    if args.json:
        print(msgspec.json.format(_as_json(served)).decode())
    elif served:
        console = Console(highlight=False)
        (console if console.is_terminal else Console(width=MOST_LETTERS)).print(
            _table(row(cell) for cell in served)
        )
    if not served:
        print("thirdhand status: no daemon is alive on this network", file=sys.stderr)
    return 0 if served else 1


def _watch(session: zenoh.Session, args: argparse.Namespace) -> None:
    """Show each cell as it changes: in a table on a terminal, else in lines."""
    latest_cells: dict[tuple[str, str], tuple[Cell, float]] = {}
    printed: dict[tuple[str, str], str] = {}
    draws = sys.stdout.isatty() and not args.json
    with (
        interrupt.clean_up_first(),
        Live(auto_refresh=False) if draws else contextlib.nullcontext() as live,
    ):
        while True:
            begun_s = time.monotonic()
            served = served_cells(session, timeout_s=WATCH_S)
            now_s = time.monotonic()
            latest_cells |= {(cell.name, cell.session): (cell, now_s) for cell in served}
            rows = {
                key: row(cell, now_s - at_s) for key, (cell, at_s) in sorted(latest_cells.items())
            }
            if args.json:
                print(_as_json(served).decode(), flush=True)
            elif live is not None:
                live.update(_table(rows.values()), refresh=True)
            else:
                for key, (name, mode, _, _, _, _, *more) in rows.items():
                    line = "  ".join(filter(None, (name, mode.partition(" for ")[0], *more)))
                    if printed.get(key) != line:
                        printed[key] = line
                        print(line, flush=True)
            time.sleep(max(0.0, WATCH_S - (time.monotonic() - begun_s)))


def _as_json(served: Iterable[Cell]) -> bytes:
    return msgspec.json.encode([cell._asdict() for cell in served])


def _table(rows: Iterable[tuple[str, ...]]) -> Table:
    table = Table(*HEADS, box=None, pad_edge=False)
    for name, mode, *others in rows:
        table.add_row(
            name, Text(mode, style=MODE_STYLES.get(mode.split(" ")[0], "dim")), *map(Text, others)
        )
    return table


def row(cell: Cell, silent_s: float = 0.0) -> tuple[str, ...]:
    """The texts of HEADS for a cell that was seen `silent_s` ago [s]."""
    now = cell.status
    none = ("",) * (len(HEADS) - 3)
    if silent_s > DISAPPEARED_S:
        return cell.name, f"gone for {silent_s:.0f} s", *none, ""
    if now is None:
        return cell.name, "no status", *none, "it is starting, is busy, or denies access"
    timing = f"{now.rate_hz:.2f}", f"{now.lateness_us.p99:.0f}", f"{now.missed}"
    hands = ", ".join(now.hand_age_ms) or "no hands"
    limits = (
        f"tool {now.tool_limits[ANY_DIRECTION].text}" if ANY_DIRECTION in now.tool_limits else ""
    )
    bound = f"now limited by {now.binding}" if now.binding else ""
    notes = ", ".join(filter(None, (limits, bound)))
    return cell.name, in_brief(now.mode, now.reason), *timing, hands, now.skill, now.version, notes
