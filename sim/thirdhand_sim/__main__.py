"""`thirdhand sim`: the bench as a process in real time, connected through Zenoh."""

from __future__ import annotations

from thirdhand.process import one_blas_thread  # noqa: F401

# isort: split
import argparse
import math
import signal
import sys
import threading
from pathlib import Path
from typing import TYPE_CHECKING

import msgspec

from thirdhand.cli.usage import UsageError, add_end_with, end_with, option
from thirdhand.client import ClientSettings, client_settings, endpoints, open_session
from thirdhand.contract import requests
from thirdhand.contract.channels import ENDPOINT
from thirdhand.contract.explain import in_words
from thirdhand.contract.printable import printable_lines
from thirdhand.daemon.launch import ENGINES, LaunchError, engine_of
from thirdhand.process import interrupt, output
from thirdhand.recordings.shipped import ARMS, cell_of
from thirdhand.settings.config import Settings
from thirdhand.settings.file_content import SettingsError, UnreadableError
from thirdhand_sim.scene import Scene, SceneError
from thirdhand_sim.script import Clock, HandScript, ScriptPause

if TYPE_CHECKING:
    from thirdhand_sim.bench import BenchHands
    from thirdhand_sim.network import RunReport

SIM_EXAMPLE = """example:
  thirdhand serve &
  thirdhand sim --once --output report.json
"""


def parser() -> argparse.ArgumentParser:
    """The command line."""
    p = argparse.ArgumentParser(
        prog="thirdhand sim",
        description="The simulated bench publishes hands and joint states, follows joint commands, "
        "and plays the soldering scene again and again, or once with --once. It prints progress on "
        "standard error, and writes reports to --output.",
        epilog=SIM_EXAMPLE,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    connect = (
        f"Zenoh endpoint of the service; may be repeated ($THIRDHAND_CONNECT, else {ENDPOINT})"
    )
    option(p, "--connect", "EP", connect, action="append", type=str)
    option(
        p,
        "--listen",
        "EP",
        "Zenoh endpoint to listen on; may be repeated",
        action="append",
        type=str,
    )
    option(p, "--cell", "NAME", "prefix of all keys ($THIRDHAND_CELL, else thirdhand)")
    option(
        p,
        "--scene",
        "FILE",
        "a TOML file with places [x, y, z] in metres (default: the nominal scene)",
    )
    via_points = (
        "only print the request that teaches the scene's via-points, for `thirdhand via-points add "
        "--file -`"
    )
    p.add_argument("--via-points", action="store_true", help=via_points)
    option(p, "--arm", "ARM", f"{', '.join(ARMS)} or a cell's settings, FILE.toml", "wam")
    p.add_argument(
        "--engine", choices=list(ENGINES), help="the physics (default: the first that is installed)"
    )
    hands_only = (
        "publish hands and things only, and evaluate a real or other arm by its joint states"
    )
    p.add_argument("--hands-only", action="store_true", help=hands_only)
    tracked = (
        "receive the hands that a tracker or `thirdhand hands` publishes, instead of playing a "
        "script; the scene shows where they belong next. The run ends after S seconds (default: "
        "once all events are reached)"
    )
    p.add_argument(
        "--tracked-hands", metavar="S", nargs="?", type=float, const=math.inf, help=tracked
    )
    option(
        p,
        "--seed",
        None,
        "the seed for scatter, tremor and noise of the hands (default: the scene's)",
        type=int,
    )
    once = "end after one run; its report goes to standard output unless --output says otherwise"
    p.add_argument("--once", action="store_true", help=once)
    output = "write reports to this file, one JSON object per line; - is standard output"
    option(p, "--output", "FILE", output, type=str)
    p.add_argument(
        "--seconds", metavar="S", type=float, default=float("inf"), help="end after this time"
    )
    p.add_argument(
        "--duration", dest="seconds", type=float, default=argparse.SUPPRESS, help=argparse.SUPPRESS
    )
    option(
        p, "--wait", "S", "wait this long for the first command, and again for tracked hands", 60.0
    )
    option(p, "--hands-rate", "HZ", "the rate of the hand poses, 30 to 500", 100, type=int)
    option(p, "--speed", "X", "the speed of the hands; 1 is as demonstrated", 1.0, type=float)
    for name, about in (
        (
            "--pause",
            "stop the hands AT seconds after the beginning for LASTS seconds, at least 0.6; may be "
            "repeated",
        ),
        ("--turn", "like --pause, but the hands move back and return; may be repeated"),
    ):
        p.add_argument(
            name,
            metavar=("AT", "LASTS"),
            type=float,
            nargs=2,
            action="append",
            default=[],
            help=about,
        )
    option(
        p,
        "--offset-mm",
        "MM",
        "the scatter of the places, standard deviation per axis",
        8.0,
        type=float,
    )
    option(p, "--tremor-mm", "MM", "the tremor of the hands, rms per axis", 0.5, type=float)
    option(
        p,
        "--noise-mm",
        "MM",
        "the noise of the tracker, standard deviation per axis",
        0.5,
        type=float,
    )
    dropout = "hide one hand from START of the script for DURATION seconds"
    p.add_argument("--dropout", metavar=("START", "DURATION"), type=float, nargs=2, help=dropout)
    option(
        p,
        "--dropout-hand",
        None,
        "the hand that --dropout hides",
        "left",
        choices=("left", "right"),
    )
    add_end_with(p)
    return p


def main(arguments: list[str] | None = None) -> int:
    """Run the bench; exit code 0, 1 on failure, 2 on bad usage."""
    p = parser()
    args = p.parse_args(arguments)
    _check(p, args)
    try:
        if args.end_with is not None:
            end_with(args.end_with)
        settings = cell_of(args.arm)
        scene, _ = (Scene.load(args.scene) if args.scene else Scene()).in_reach(settings.reach)
        if args.via_points:
            print(requests.encode_json(requests.Add(scene.via_points())).decode(), flush=True)
            return 0
        if not args.hands_only:
            engine_of(args.engine)
        reach = client_settings(connect=args.connect, cell=args.cell)
    except (SceneError, LaunchError, UnreadableError, OSError) as error:
        print(f"thirdhand sim: {printable_lines(in_words(error))}", file=sys.stderr)
        return 1
    except (SettingsError, UsageError) as error:
        p.error(str(error))
    return _run(args, settings, scene, reach)


def _check(p: argparse.ArgumentParser, args: argparse.Namespace) -> None:
    """End with bad usage if an option is out of its range."""
    if not 30 <= args.hands_rate <= 500:
        p.error(f"--hands-rate {args.hands_rate}: 30 to 500 accepted")
    if not 0.05 <= args.speed <= 20:
        p.error(f"--speed {args.speed}: 0.05 to 20 accepted")
    if min(args.offset_mm, args.tremor_mm, args.noise_mm) < 0:
        p.error("--offset-mm, --tremor-mm and --noise-mm cannot be negative")
    try:
        Clock(pauses=[ScriptPause(*pause) for pause in args.pause + args.turn])
    except ValueError as error:
        p.error(f"--pause, --turn: {error}")


def _run(args: argparse.Namespace, settings: Settings, scene: Scene, reach: ClientSettings) -> int:
    """Run the bench in a cell, until a signal or its end; the exit code."""
    from thirdhand_sim.bench import Bench
    from thirdhand_sim.engines import world_of
    from thirdhand_sim.network import BenchError, Dropout, Live, run
    from thirdhand_sim.observed_world import ObservedWorld
    from thirdhand_sim.parts import before_others

    stop = threading.Event()
    signals: list[int] = []

    def end(number: int, _: object) -> None:
        signals.append(number)
        stop.set()

    live = Live(
        cell=reach.cell,
        hands_hz=args.hands_rate,
        once=args.once,
        duration_s=args.seconds,
        wait_s=args.wait,
        dropout=args.dropout and Dropout(args.dropout[0], args.dropout[1], args.dropout_hand),
    )
    world = ObservedWorld if args.hands_only else world_of(args.engine)
    try:
        reports = _Reports(args.output or ("-" if args.once else ""))
        script = _script(args, settings, scene)
        before_others()
        if args.listen:
            session = open_session(connect=args.connect or (), listen=args.listen)
        else:
            session = reach.session(timeout_s=None)
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, end)
        with session, Bench(script, settings=settings, world=world) as bench:
            if args.listen:
                print(f"listening on {', '.join(endpoints(session))}", file=sys.stderr, flush=True)
            run(bench, session, live, stop=stop, report=reports.write)
    except (BenchError, OSError) as error:
        print(f"thirdhand sim: {printable_lines(in_words(error))}", file=sys.stderr)
        return 1
    if not args.once:
        ended = f"ended: the bench of cell {reach.cell}, after {reports.count} complete runs"
        print(f"{ended}; {reports.note}", file=sys.stderr)
    return interrupt.EXIT_CODE if signal.SIGINT in signals else 0


def _script(args: argparse.Namespace, settings: Settings, scene: Scene) -> BenchHands:
    """The hands: those of a script, or tracked ones."""
    from thirdhand_sim.tracked_hands import TrackedHands

    if args.tracked_hands is not None:
        return TrackedHands(scene, settings, timeout_s=args.tracked_hands)
    return HandScript(
        scene,
        seed=scene.seed if args.seed is None else args.seed,
        speed=args.speed,
        pauses=[
            *(ScriptPause(start_s, lasts) for start_s, lasts in args.pause),
            *(ScriptPause(start_s, lasts, depth=2.0) for start_s, lasts in args.turn),
        ],
        offset_std=args.offset_mm / 1000,
        tremor_rms=args.tremor_mm / 1000,
        noise_std=args.noise_mm / 1000,
    )


class _Reports:
    """A writer of reports as JSON lines: to a file, to standard output (`-`), or nowhere (empty).

    A file that cannot be written is reported before the run. Raises OSError.
    """

    def __init__(self, target: str) -> None:
        self._target = target
        self.count = 0
        self.note = "without --output no report was written"
        if target:
            self.note = f"their reports are in {target}"
        if target not in ("", "-"):
            Path(target).write_text("", encoding="utf-8")

    def write(self, report: RunReport) -> None:
        """Write the report of a run."""
        self.count += 1
        line = msgspec.json.encode(report).decode() + "\n"
        if self._target == "-":
            sys.stdout.write(line)
            sys.stdout.flush()
        elif self._target:
            with Path(self._target).open("a", encoding="utf-8") as file:
                file.write(line)


if __name__ == "__main__":
    interrupt.watch()
    output.accept_all_characters()
    sys.exit(main())
