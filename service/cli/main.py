"""The command line: the options of each command, and the module that runs it.

Errors go to standard error. Exit code 1 is a failure, 2 bad usage. A command's module is imported
only when that command runs, because imports are slow.
"""

from __future__ import annotations

import argparse
import contextlib
import importlib
import os
import sys
from importlib import metadata
from pathlib import Path

from service import interrupt
from service.cli import record_options, via_point_options
from service.cli.usage import Parser, UsageError, check_cell
from service.config import RATES_HZ
from service.contract import channels
from service.contract.explain import ExplainedError
from service.contract.roles import DAEMON, ROLES

RUN_BY = {
    "demo": "cli.demo",
    "serve": "cli.serve",
    "play": "cli.recordings",
    "replay": "cli.recordings",
    "learn": "cli.recordings",
    "record": "cli.record",
    "via-points": "cli.clients",
    "status": "cli.status",
    "doctor": "cli.doctor",
    "hold": "cli.clients",
    "resume": "cli.clients",
    "reset": "cli.clients",
    "cells": "cli.cells",
    "view": "cli.view",
    "report": "cli.report_command",
    "certificates": "cli.certificates",
    "bench": "timing.benchmark",
}
SIM = "The PyBullet bench: publishes hands and joint states, and follows commands; `thirdhand sim --help` tells more."
CLEAN_UP_FIRST = ("demo", "bench", "view", "record")  # they end processes before Ctrl-C ends them
FORMATTER = argparse.RawDescriptionHelpFormatter


def parser() -> argparse.ArgumentParser:
    """The parser of the command line."""
    top = Parser(
        prog="thirdhand",
        description="A robot arm as a third hand at the soldering bench.",
        epilog="example: thirdhand demo",
    )
    top.add_argument("--version", action=_Version, nargs=0, help="print the version and exit")
    commands_of = top.add_subparsers(dest="command", required=True, metavar="COMMAND")

    def command(name: str, about: str, example: str) -> argparse.ArgumentParser:
        sub = commands_of.add_parser(
            name, help=about, description=about, epilog=f"example:\n  {example}", formatter_class=FORMATTER
        )
        sub.set_defaults(run=f"{RUN_BY[name]}.{name.replace('-', '_')}")
        return sub

    def client(name: str, about: str, example: str) -> argparse.ArgumentParser:
        sub = command(name, about, example)
        _reach(sub)
        return sub

    c = command(
        "demo",
        "The soldering scenario, closed loop and headless: bench, service and scribe.",
        "thirdhand demo --scene my-scene.toml",
    )
    c.add_argument(
        "--out",
        metavar="DIR",
        type=Path,
        default=Path("thirdhand-demo"),
        help="where recording and viewer file go (default: %(default)s)",
    )
    c.add_argument(
        "--scene", metavar="FILE", type=Path, help="TOML file with handover, glass and soldering as [x, y, z] in metres"
    )
    c.add_argument("--rate", metavar="HZ", type=_rate, default=500, help="of the loop (default: %(default)s)")
    c.add_argument("--json", action="store_true", help="print the report as one JSON object")

    c = command("bench", "How the loop keeps its time on this machine.", "thirdhand bench --rate 1000 --seconds 60")
    c.add_argument("--seconds", metavar="S", type=float, default=24.0, help="to measure for (default: %(default)g)")
    c.add_argument("--rate", metavar="HZ", type=_rate, default=500, help="of the loop (default: %(default)s)")
    c.add_argument("--json", action="store_true", help="print the report as one JSON object")
    c.add_argument(
        "--output", metavar="DIR", type=Path, help="write bench.json there, a picture, and what the whole recorded"
    )
    other = c.add_mutually_exclusive_group()
    other.add_argument(
        "--loads", action="store_true", help="what happens beside the loop instead, each for so many seconds"
    )
    other.add_argument("--soak", metavar="MIN", type=float, help="memory and open files over so many minutes instead")

    c = command(
        "serve", "The daemon: hand poses in, joint commands out.", "thirdhand serve --record recordings --arm state"
    )
    c.add_argument(
        "--config", metavar="FILE", type=Path, help="settings of the cell as TOML; options below go before it"
    )
    c.add_argument("--cell", metavar="NAME", help="prefix of all keys (default: thirdhand)")
    c.add_argument(
        "--listen",
        metavar="EP",
        action="append",
        help=f"Zenoh endpoint to listen on; may be repeated (default: {channels.ENDPOINT})",
    )
    c.add_argument("--connect", metavar="EP", action="append", help="Zenoh endpoint to connect to; may be repeated")
    _zenoh_config(c)
    c.add_argument("--rate", metavar="HZ", type=_rate, help="of the loop (default: 500)")
    c.add_argument(
        "--skill",
        metavar="FILE",
        type=Path,
        help="a skill made by `thirdhand learn` (default: the shipped soldering skill)",
    )
    c.add_argument(
        "--arm",
        choices=("state", "assumed"),
        help="wait for the arm's joint states, or assume its posture (default: state)",
    )
    c.add_argument("--record", metavar="DIR", type=Path, help="write .mcap and .rrd files there")
    c.add_argument("--live", metavar="PORT", type=int, help="serve Rerun viewers on this loopback port")

    c = command(
        "play",
        "Publishes the hands of a recording or demonstration, as a tracker would.",
        "thirdhand play recordings/demonstration-6.mcap --loop",
    )
    c.add_argument("file", metavar="FILE", type=Path, help="an MCAP file with hands/left and hands/right")
    c.add_argument(
        "--speed", metavar="X", type=float, default=1.0, help="times as fast as recorded (default: %(default)s)"
    )
    c.add_argument("--loop", action="store_true", help="over and over")
    _reach(c)

    c = command(
        "replay",
        "Runs the core on a recording, or on several that follow each other, and compares every frame. What is missing "
        "or damaged is listed; only --exact fails for it.",
        "thirdhand replay recordings/golden.mcap --exact",
    )
    c.add_argument("files", metavar="FILE", type=Path, nargs="+", help="a recording, and those that follow it")
    c.add_argument(
        "--exact", action="store_true", help="forbid gaps, damage, a cut, and even differences below 10 µm and 10 µrad"
    )
    c.add_argument(
        "--after", metavar="TICK", type=int, help="start from the first recorded state at or after this tick"
    )

    c = command("record", record_options.ABOUT, record_options.EXAMPLE)
    record_options.add_options(c)
    _reach(c, cell=None)

    c = command(
        "report",
        "A report of recordings: what they lack, modes and reasons, faults and what led to them, promptness, closest "
        "approach, places, limits, rejections. Several are set side by side.",
        "thirdhand report thirdhand-demo/*.mcap --html report.html",
    )
    c.add_argument("files", metavar="FILE", type=Path, nargs="+", help="a recording (.mcap); of two their differences")
    c.add_argument("--html", metavar="FILE", type=Path, help="all of it with plots as one page, too")
    c.add_argument("--csv", metavar="DIR", type=Path, help="each table, and every tick, as CSV files there, too")

    c = command(
        "learn",
        "Learns a skill from demonstrations and judges it by leaving out one at a time. Where it would be unsafe, "
        "exit 1 and no file.",
        "thirdhand learn recordings/demonstration-[1-5].mcap --output soldering.npz --plot soldering.png",
    )
    c.add_argument(
        "demonstrations",
        metavar="DEMO",
        nargs="+",
        type=Path,
        help="recordings with hands/left, hands/right and tool/pose or the arm's joints/state: MCAP, .db3, a bag's "
        "folder",
    )
    for name in ("left", "right", "tool"):
        c.add_argument(
            f"--{name}",
            metavar="TOPIC[:PART]",
            help=f"where the {name}{' hand' * (name != 'tool')} is in recordings of others: poses, a PoseArray with an "
            "index, or a TFMessage with a child frame" + "; or joint states" * (name == "tool"),
        )
    c.add_argument("--output", metavar="FILE", type=Path, required=True, help="the skill, .npz")
    c.add_argument("--plot", metavar="FILE", type=Path, help="a picture of what it is judged by, .png")
    c.add_argument("--name", help="of the skill (default: the file's)")
    c.add_argument(
        "--config", metavar="FILE", type=Path, help="settings of the cell: the tracker's axes and unit, the arm"
    )
    c.add_argument(
        "--places",
        metavar="FILE",
        type=Path,
        help="where the named places of the task were, as `via-points add --file` takes them, for demonstrations that "
        "do not hold it: then the skill is learned between them, and holds wherever they are",
    )
    c.add_argument("--points", metavar="N", type=_count, default=200, help="of the reference (default: %(default)s)")
    c.add_argument("--ell", metavar="L", type=_positive, help="of the kernel [1/m²] (default: chosen; mixture: 5)")
    c.add_argument(
        "--components",
        metavar="K",
        type=_count,
        help="take the reference from a mixture of K, the paper's way (default: from the demonstrations themselves)",
    )
    c.add_argument("--penalty", metavar="L", type=_positive, help="the mixture's lambda (default: 2)")
    c.add_argument(
        "--seed", type=int, default=0, help="of the mixture's start and the sampled inputs (default: %(default)s)"
    )

    c = command("via-points", "Via-points taught to a running daemon.", "thirdhand via-points list")
    actions = c.add_subparsers(dest="action", required=True, metavar="ACTION")
    nothing = "example:\n  thirdhand via-points "
    a = actions.add_parser(
        "add", help="teach via-points, all or nothing", formatter_class=FORMATTER,
        epilog=f"{nothing}add handover --left .62 -.28 .30 --right .98 .32 .06 --tool .54 -.28 .38 "
        "--radius .03 --follow left --std .001\n  thirdhand via-points add glass --here",
    )  # fmt: skip
    a.add_argument("name", nargs="?", help="of the via-point; one given again is replaced")
    via_point_options.add_options(a)
    _reach(a)
    a = actions.add_parser(
        "remove", help="forget via-points by name", epilog=f"{nothing}remove handover", formatter_class=FORMATTER
    )
    a.add_argument("names", metavar="NAME", nargs="+")
    _reach(a)
    _reach(
        actions.add_parser("list", help="the via-points in force", epilog=f"{nothing}list", formatter_class=FORMATTER)
    )
    _reach(
        actions.add_parser("clear", help="forget all via-points", epilog=f"{nothing}clear", formatter_class=FORMATTER)
    )

    c = client("status", "What a running daemon does.", "thirdhand status --json")
    c.add_argument("--json", action="store_true", help="print what <cell>/status carries; with --watch a line each")
    c.add_argument("--watch", action="store_true", help="hands, tool, target and distances as they change")
    c = client(
        "doctor", "Looks at a running cell, and says what is wrong and what to do. Then exit 1.", "thirdhand doctor"
    )
    c.add_argument("--json", action="store_true", help="print the findings as JSON")
    c.add_argument("--seconds", metavar="S", type=float, default=2.0, help="to look for (default: %(default)g)")
    client("hold", "Stops the arm, which then stays.", "thirdhand hold")
    client("resume", "Ends an operator's hold.", "thirdhand resume")
    client("reset", "Ends a fault.", "thirdhand reset")

    c = command("cells", "The daemons on a network and what each does.", "thirdhand cells --connect tcp/127.0.0.1:7447")
    c.add_argument("--json", action="store_true", help="print their names and statuses as one JSON list")
    _reach(c, one=False)

    c = command(
        "certificates",
        "Makes an authority, and a certificate for the daemon and for each role on a network; with --role, one more "
        "certificate by the authority that is there.",
        "thirdhand certificates secrets --host bench.local",
    )
    c.add_argument("folder", metavar="DIR", type=Path, help="a new folder, private to its user; with --role an old one")
    c.add_argument(
        "--host", metavar="NAME", action="append", help="or address at which clients reach the daemon; may be repeated"
    )
    c.add_argument("--role", choices=(*ROLES, DAEMON), help="of one more certificate")
    c.add_argument("--name", metavar="ROLE-N", help="of that one, like tracker-2 (default: the first that is free)")
    c.add_argument("--days", metavar="N", type=int, default=3650, help="that they are valid (default: %(default)s)")

    # all arguments are passed to `python -m sim`, so nothing is an option here, not even --help
    c = commands_of.add_parser("sim", help=SIM, prefix_chars="\0", add_help=False)
    c.set_defaults(run="cli.sim.sim")
    c.add_argument("options", nargs="*")

    c = client(
        "view",
        "Shows a recording, or a running daemon, in Rerun.",
        "thirdhand view thirdhand-demo/thirdhand-20260101T120000Z.rrd --screenshot scene.png",
    )
    c.add_argument("file", metavar="FILE|live", help="an .rrd or .mcap file, or `live`")
    c.add_argument("--screenshot", metavar="PNG", type=Path, help="write a picture instead of opening a window")
    c.add_argument(
        "--time", metavar="S", type=float, help="of the picture, from the recording's start (default: its end)"
    )
    c.add_argument(
        "--web",
        metavar="[HOST:]PORT",
        nargs="?",
        const="127.0.0.1:0",
        help="with `live`: a page for browsers, with hold, resume and reset (default: any port of this machine)",
    )
    c.add_argument(
        "--tab", choices=("task", "timing", "learning"), default="task", help="of the picture (default: %(default)s)"
    )
    return top


class _Version(argparse.Action):
    """Prints the version of the installed distribution."""

    def __call__(self, parser: argparse.ArgumentParser, *_: object) -> None:
        print(f"thirdhand {metadata.version('thirdhand')}")
        parser.exit()


def _rate(given: str) -> int:
    low, high = RATES_HZ
    if given.isdecimal() and low <= int(given) <= high:
        return int(given)
    raise argparse.ArgumentTypeError(f"{given} given, {low} to {high} Hz needed")


def _count(given: str) -> int:
    if given.isdecimal() and 1 <= int(given) <= 2500:
        return int(given)
    raise argparse.ArgumentTypeError(f"{given} given, 1 to 2500 needed")


def _positive(given: str) -> float:
    with contextlib.suppress(ValueError):
        if 1e-3 <= float(given) <= 1e4:
            return float(given)
    raise argparse.ArgumentTypeError(f"{given} given, 0.001 to 10000 needed")


def _reach(sub: argparse.ArgumentParser, cell: str | None = "thirdhand", *, one: bool = True) -> None:
    sub.add_argument(
        "--connect",
        metavar="EP",
        action="append",
        help="Zenoh endpoint of the daemon or of a router; of several the first that answers "
        f"(default: {channels.ENDPOINT})",
    )
    if one:
        sub.add_argument(
            "--cell", metavar="NAME", default=cell, help=f"prefix of all keys (default: {cell or 'as configured'})"
        )
    sub.add_argument(
        "--certificate",
        metavar="DIR",
        type=Path,
        help="of one's role, made by `thirdhand certificates` (default: $THIRDHAND_CERTIFICATE)",
    )
    _zenoh_config(sub)


def _zenoh_config(sub: argparse.ArgumentParser) -> None:
    sub.add_argument(
        "--zenoh-config",
        metavar="FILE",
        type=Path,
        help="Zenoh's own settings, for all that the service does not set itself (default: $THIRDHAND_ZENOH_CONFIG)",
    )


def main(arguments: list[str] | None = None) -> int:
    """The exit code of a command."""
    args = parser().parse_args(arguments)
    module, function = args.run.rsplit(".", 1)
    try:
        if "cell" in args and args.cell is not None:  # also rejects a wildcard, which would reach every cell
            check_cell(args.cell)
        run = getattr(importlib.import_module(f"service.{module}"), function)
        with interrupt.clean_up_first() if args.command in CLEAN_UP_FIRST else contextlib.nullcontext():
            return int(run(args))
    except UsageError as error:
        print(f"thirdhand {args.command}: {error}", file=sys.stderr)
        return 2
    except BrokenPipeError:  # the reader, a pager for instance, has ended
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
        return 1
    except (ExplainedError, OSError) as error:
        print(f"thirdhand {args.command}: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        interrupt.end_at_once()
