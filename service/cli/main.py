"""The command line: the options of each command, and the module that runs it.

Errors go to standard error. Exit code 1 is a failure, 2 bad usage. A command's module is imported
only when that command runs, because imports are slow.
"""

from __future__ import annotations

import argparse
import contextlib
import importlib
import os
from pathlib import Path
from typing import Any

from service.cli import calibrate_options, record_options
from service.cli.usage import ARM_HELP, WORKERS_HELP, Parser, UsageError, add_end_with, flag, option, reaching, within
from service.client import CLIENT_FILE
from service.contract import channels
from service.contract.explain import ExplainedError, in_file, in_words
from service.contract.records import SIDES
from service.contract.requests import TOLERANCE_M, ViaPoint
from service.learning.residual_risk import OPTION
from service.process import foreign_modules, interrupt
from service.process.progress import say
from service.settings.file_content import SettingsError, UnreadableError

RUN_BY = {  # the modules that are not named as their command
    **dict.fromkeys(("play", "replay", "learn"), "cli.recordings"),
    **dict.fromkeys(("via-points", "stage", "correct", "hold", "resume", "reset"), "cli.clients"),
    "report": "cli.report_command",
    "bench": "timing.benchmark",
}
SIM = "Runs the simulated bench: it publishes hands and joint states, and follows commands."
RATE = "the rate of the control loop (default: the rate in the cell's settings)"
DEMO_RATE = (
    "the rate of the control loop (default: the rate in the cell's settings; 100 Hz for a shipped arm with --mouse, "
    "because a browser without a GPU needs a core for itself)"
)
GROUPS = {
    "run": ("demo", "serve", "follow", "sim", "hands", "play"),
    "stop and continue": ("hold", "resume", "reset"),
    "teach": ("record", "learn", "via-points", "stage", "correct"),
    "look": ("status", "view", "report"),
    "check": ("doctor", "metrics", "bundle", "replay", "tune", "bench"),
    "set up": ("arm", "calibrate"),
}
CLEAN_UP_FIRST = ("demo", "bench", "view", "record", "hands", "calibrate")  # on Ctrl-C these first end their processes


def parser() -> argparse.ArgumentParser:
    """The parser of the command line."""
    top = Parser(
        prog="thirdhand",
        description="A robot arm as a third hand at the soldering bench.",
        epilog="thirdhand COMMAND --help explains a command, with an example. Begin with: thirdhand demo",
    )
    top.add_argument("--version", action=_Version, nargs=0, help="print the version and exit")
    commands_of = top.add_subparsers(dest="command", required=True, metavar="COMMAND")
    abouts: dict[str, str] = {}

    def described(among: Any, name: str, about: str, example: str) -> argparse.ArgumentParser:
        added: argparse.ArgumentParser = among.add_parser(
            name,
            help=about,
            description=about,
            epilog=f"example:\n  {example}",
            formatter_class=argparse.RawDescriptionHelpFormatter,
        )
        return added

    def command(name: str, about: str, example: str) -> argparse.ArgumentParser:
        sub, abouts[name] = described(commands_of, name, about, example), about
        sub.set_defaults(run=f"{RUN_BY.get(name, f'cli.{name}')}.{name.replace('-', '_')}")
        return sub

    c = command(
        "demo",
        "Runs the soldering scenario once, without a window: simulated bench, service and recording. Then reports how "
        "the task went.",
        "thirdhand demo --scene my-scene.toml\n  thirdhand demo --mouse --open",
    )
    output = "write the recording, the drawing and the service's log to this folder"
    option(c, "--output", "DIR", output, Path("thirdhand-demo"))
    scene = "a TOML file with the places of the scene, as handover = [x, y, z] in metres, frame base"
    option(c, "--scene", "FILE", scene)
    option(c, "--arm", "ARM", ARM_HELP, "wam")
    engine = "the physics engine of the bench (default: the first that is installed)"
    c.add_argument("--engine", choices=("pybullet", "mujoco"), help=engine)
    option(c, "--rate", "HZ", DEMO_RATE)
    mouse = (
        "play the hands yourself, with a mouse or a finger, on a page that is served at this address (default: any "
        "port of this machine)"
    )
    option(c, "--mouse", "[HOST:]PORT", mouse, nargs="?", const="127.0.0.1:0")
    flag(c, "--open", "open the page of --mouse in this machine's browser")
    flag(c, "--json", "print the report as one JSON object")

    c = command(
        "follow",
        "Drives an arm by the joint commands of a running cell, and brakes it when the commands end.",
        "thirdhand follow franka --config cell.toml --robot 172.16.0.2",
    )
    c.add_argument("arm", metavar="ARM", help="the arm to drive: franka, or simulated, which is an ideal arm")
    option(c, "--config", "CELL", f"the settings that the daemon runs with: {ARM_HELP}")
    option(c, "--robot", "ADDRESS", "the host name or IP address of a Franka's control box", "172.16.0.2")
    option(c, "--wait", "S", "wait this long for the daemon, and again this long for its first command", 60.0)
    _reach(c)

    c = command(
        "bench", "Measures the timing of the control loop on this machine.", "thirdhand bench --rate 1000 --seconds 60"
    )
    option(c, "--seconds", "S", "measure for this time", 24.0, type=within(float, 0.1, 1e6))
    option(c, "--rate", "HZ", RATE)
    flag(c, "--json", "print the report as one JSON object")
    option(c, "--arm", "ARM", ARM_HELP, "wam")
    option(c, "--output", "DIR", "write bench.json, a picture of it and the recording to this folder")

    c = command(
        "serve",
        "Runs the daemon of a cell: it receives hand poses and publishes joint commands.",
        "thirdhand serve --record recordings --joints state",
    )
    option(c, "--config", "CELL", f"the cell: {ARM_HELP}; the options below override its settings")
    option(c, "--cell", "NAME", "the prefix of all keys on the network (default: thirdhand)")
    listen = f"listen on this Zenoh endpoint; may be repeated (default: {channels.ENDPOINT})"
    option(c, "--listen", "EP", listen, action="append")
    option(c, "--connect", "EP", "connect to this Zenoh endpoint; may be repeated", action="append")
    option(c, "--rate", "HZ", RATE)
    skill = "run this skill, made by `thirdhand learn` (default: that of the settings, or else the shipped one)"
    option(c, "--skill", "FILE", skill)
    joints = "wait for the arm's joint states, or assume the posture in the settings (default: [arm] source, or state)"
    c.add_argument("--joints", choices=("state", "assumed"), help=joints)
    option(c, "--record", "DIR", "record to .mcap files in this folder")
    live = "serve Rerun viewers of this machine on this port"
    option(c, "--live", "PORT", live, type=within(int, 0, channels.LAST_PORT))
    hold = "begin in hold, until `thirdhand resume`, whatever [arm] start is: for a service manager"
    flag(c, "--hold", hold)
    log = "write the log on standard error as text, or as one JSON object on each line (default: text)"
    c.add_argument("--log", choices=("text", "json"), default="text", help=log)
    check = "examine settings, arm, skill, folders, disk, certificates and ports, start nothing, and exit with 0 or 1"
    first = c.add_mutually_exclusive_group()
    first.add_argument("--check", action="store_const", dest="run", const="cli.serve_check.check", help=check)
    prepare = "compile what this cell needs, once on a machine, so that its next start takes seconds, and exit"
    first.add_argument("--prepare", action="store_const", dest="run", const="cli.prepare.prepare", help=prepare)
    add_end_with(c)

    c = command(
        "play",
        "Publishes the hands of a recording or demonstration, as a tracker does.",
        "thirdhand play recordings/demonstration-6.mcap --loop",
    )
    option(c, "file", "FILE", "the recording or demonstration: an MCAP file with hands/left and hands/right")
    option(c, "--speed", "X", "play this many times as fast as recorded", 1.0, type=within(float, 0.01, 100))
    flag(c, "--loop", "start again at the end, until Ctrl-C")
    _reach(c)

    c = command(
        "hands",
        "Publishes your hands, as a headset's browser or a camera of this machine tracks them, or as you drag them "
        "with a mouse or a finger. Open the address that it prints.",
        "thirdhand hands --mouse --open\n  thirdhand hands --web --listen 0.0.0.0:8443 --https 192.168.1.20\n"
        "  thirdhand hands --camera --hand-length 0.19",
    )
    kinds = c.add_mutually_exclusive_group(required=True)
    flag(kinds, "--web", "serve a page for the browser of a headset (WebXR)")
    flag(kinds, "--mouse", "serve a page on which both hands are dragged over the bench, seen from above")
    camera = "the hands that this camera sees (default: camera 0), or a video file; needs thirdhand[camera]"
    option(kinds, "--camera", "NUMBER", camera, nargs="?", const="0")
    address = "serve the page at this address; port 0: any free one; for other machines with --https"
    option(c, "--listen", "HOST:PORT", address, "127.0.0.1:8443")
    https = "serve the page by HTTPS, for a headset that reaches this machine by this name or address"
    option(c, "--https", "NAME", https)
    length = "length of your hand, from the crease of the wrist to the tip of the middle finger (--camera)"
    option(c, "--hand-length", "M", length, 0.18, type=within(float, 0.1, 0.3, " m"))
    view = "horizontal angle of view of the lens, in degrees (--camera)"
    option(c, "--view", "DEG", view, 60.0, type=within(float, 20, 150, " degrees"))
    model = "hand_landmarker.task, or the wheel of mediapipe 0.10.21 (--camera; default: it is downloaded once)"
    option(c, "--model", "FILE", model)
    clutch = "press the clutch of `[hands] clutch` while this hand pinches (--web)"
    c.add_argument("--pinch-clutch", choices=SIDES, help=clutch)
    gripper = "close the gripper of `[hands] gripper` with the fingers of this hand (--web)"
    c.add_argument("--pinch-gripper", choices=SIDES, help=gripper)
    flag(c, "--open", "open the page of --mouse in this machine's browser")
    _reach(c)

    c = command(
        "replay",
        "Runs the core on a recording, or on several that follow each other, and compares every frame. Missing and "
        "damaged parts are listed; only with --exact they are failures.",
        "thirdhand replay recordings/golden.mcap --exact\n  thirdhand replay archive/*.mcap --each --workers 8",
    )
    option(c, "files", "FILE", "a recording, and those that follow it", nargs="+")
    flag(c, "--exact", "fail for gaps, damage, a cut, and differences below 10 µm and 10 µrad")
    option(c, "--after", "TICK", "start from the first recorded state at or after this tick", type=int)
    option(c, "--output", "FILE", "write the new frames as a recording, for report, view or comparison")
    flag(c, "--each", "replay each recording by itself; no failure stops the others")
    option(c, "--workers", "WORKERS", f"{WORKERS_HELP}; with --each")

    c = command(
        "tune",
        "Tries about a dozen settings on the hands of a recording or a take: error, lag, jerk, overshoot and "
        "rejections of each, and the noise and tremor of the hands. Prints the lines to write for the best trade-off, "
        "of several files for all of them.",
        "thirdhand tune recordings/golden.mcap --plot tune.png\n  thirdhand tune archive/*.mcap --workers 8",
    )
    option(c, "files", "FILE", "a recording of the daemon, or a take (.mcap); several are judged together", nargs="+")
    option(c, "--config", "CELL", f"the cell (default: the settings in the file): {ARM_HELP}")
    option(c, "--skill", "FILE", "the skill (default: that in the file; for a take the shipped soldering skill)")
    part = "use this part only, in seconds from the start; the default is all of it"
    c.add_argument("--part", nargs=2, type=within(float, 0, 1e6, " s"), metavar=("FROM", "TO"), help=part)
    option(c, "--plot", "PNG", "draw the variants and the hands of a single file to this file")
    option(c, "--workers", "WORKERS", WORKERS_HELP)
    flag(c, "--json", "print the figures as one JSON object")

    c = command("record", record_options.ABOUT_RECORD, record_options.RECORD_EXAMPLE)
    record_options.add_options(c)
    _reach(c)

    c = command(
        "report",
        "Reports on recordings: missing ticks, modes and reasons, faults and their causes, timing, closest approach, "
        "via-points, limits, rejections. Several recordings are compared.",
        "thirdhand report thirdhand-demo/*.mcap --html report.html",
    )
    option(c, "files", "FILE", "a recording (.mcap); several are compared", nargs="+")
    option(c, "--html", "FILE", "also write the report with plots as a page to this file")
    option(c, "--csv", "DIR", "also write each table, and every tick, as CSV files to this folder")
    option(c, "--lerobot", "DIR", "also write joints, hands, images, commands as a LeRobot data set to this new folder")
    option(c, "--fps", "N", "the rate of the data set [rows/s]", 50, type=within(int, 1, 1000))
    option(c, "--task", "TEXT", "the task of the data set, in words (default: the name of the skill)")
    option(c, "--workers", "WORKERS", WORKERS_HELP)

    c = command(
        "learn",
        "Learns a skill from demonstrations and judges it by held-out ones: each is left out once and predicted "
        "from the others. An unsafe skill is not written, and the exit code is 1. A skill with a residual risk is "
        "written, but the daemon serves it only if somebody has accepted that.",
        "thirdhand learn recordings/demonstration-[1-5].mcap --output soldering.npz --plot soldering.png\n"
        "  thirdhand learn --from soldering.npz mine-[1-3].mcap --output mine.npz",
    )
    demonstrations = (
        "demonstrations with hands/left, hands/right and tool/pose or the arm's joints/state: MCAP, .db3, a bag's "
        "folder, .bag, CSV of Motive, C3D"
    )
    option(c, "demonstrations", "DEMO", demonstrations, nargs="+", type=Path)
    for name in ("left", "right", "tool"):
        c.add_argument(
            f"--{name}",
            metavar="TOPIC[:PART]",
            help=f"the topic of the {name}{' hand' * (name != 'tool')} in recordings of other systems: poses, a "
            "PoseArray with an index, or a TFMessage with a child frame" + "; or joint states" * (name == "tool"),
        )
    option(c, "--output", "FILE", "write the skill to this .npz file", required=True)
    option(c, "--plot", "FILE", "draw the held-out errors to this .png file")
    refine = (
        "refine the skill in this .npz file: learn from its demonstrations and these, which are of those who will work "
        "with it and count as much more as predicts them best; about three are enough"
    )
    option(c, "--from", "FILE", refine, dest="refined")
    c.add_argument("--name", help="the name of the skill (default: the name of the file)")
    delay = "the teacher's delay [s], for demonstrations with via-points (default: chosen by held-out errors)"
    option(c, "--delay", "S", delay, type=within(float, 0.0, 1.0, " s"))
    option(c, "--config", "CELL", f"the cell, for the tracker's axes and unit and for the arm: {ARM_HELP}")
    places = (
        "the via-points of the task, as `via-points add --file` reads them, for demonstrations without via-points; the "
        "skill is then learned between these via-points and follows them when they move"
    )
    option(c, "--places", "FILE", places)
    accept = (
        "accept the residual risk of the skill, if it has one, in the name of this person, who takes responsibility "
        "for it; skill, daemon and status name both"
    )
    option(c, OPTION, "NAME", accept)

    c = command("via-points", "Adds, lists and removes via-points of a running daemon.", "thirdhand via-points list")
    actions = c.add_subparsers(dest="action", required=True, metavar="ACTION")
    example = "thirdhand via-points"
    a = described(
        actions,
        "add",
        "teach via-points: all of them, or none after an error",
        f"{example} add handover --left .62 -.28 .30 --right .98 .32 .06 --tool .54 -.28 .38 "
        f"--radius .03 --follow left --std .001\n  {example} add glass --here",
    )
    a.add_argument("name", nargs="?", help="the name of the via-point; a via-point of this name is replaced")
    for place in (*SIDES, "tool"):
        at = f"the position of the {place}{' hand' * (place != 'tool')} in frame base [m]"
        a.add_argument(f"--{place}", nargs=3, type=within(float, -10, 10, " m"), metavar=("X", "Y", "Z"), help=at)
    flag(a, "--here", "use the present positions, once hands and tool hold still")
    defaults = ViaPoint("defaults", (0, 0, 0), (0, 0, 0), (0, 0, 0))
    option(a, "--std", "M", "the standard deviation of the tool's position there [m]", defaults.std)
    option(a, "--radius", "M", "the via-point also holds for hands within this distance [m]", defaults.radius)
    follow = "the hand that the tool moves with, within the radius"
    option(a, "--follow", None, follow, defaults.follow, choices=("none", *SIDES))
    turn = "the orientation of the tool there, as a quaternion"
    a.add_argument("--orientation", nargs=4, type=within(float, -1.001, 1.001), metavar=("X", "Y", "Z", "W"), help=turn)
    a.add_argument("--gripper", choices=("open", "closed"), help="the state of the gripper there")
    option(a, "--tolerance", "M", f"replace learned points within this distance (default: {TOLERANCE_M} m)")
    option(a, "--file", "FILE", "read the request in JSON from this file instead; - is standard input")
    _reach(a)
    a = described(actions, "remove", "remove via-points by name", f"{example} remove handover")
    a.add_argument("names", metavar="NAME", nargs="+")
    _reach(a)
    _reach(described(actions, "list", "list the via-points in force", f"{example} list"))
    _reach(described(actions, "clear", "remove all via-points", f"{example} clear"))

    c = _reach(
        command(
            "stage", "Reports to a running daemon that the task has reached a via-point.", "thirdhand stage handover"
        )
    )
    c.add_argument("name", metavar="NAME", help="the name of a via-point of the task")

    c = _reach(
        command(
            "correct",
            "Corrects the tool while the arm holds: it belongs where you led it by hand.",
            "thirdhand correct\n  thirdhand correct --tool .55 -.28 .40\n  thirdhand correct --undo",
        )
    )
    at = "the tool belongs here, in frame base [m] (default: where the arm was led by hand in this hold)"
    c.add_argument("--tool", nargs=3, type=within(float, -10, 10, " m"), metavar=("X", "Y", "Z"), help=at)
    now = "correct for the hands of this moment (default: for those at which the hold began, as leading takes a hand)"
    flag(c, "--now", now)
    flag(c, "--turned", "correct the orientation of the tool too")
    flag(c, "--undo", "undo the last correction")

    about = "Shows the status of a running daemon, or of all."
    c = _reach(command("status", about, "thirdhand status --json\n  thirdhand status --all"))
    flag(c, "--json", "print <cell>/status as JSON; with --watch, one line per status")
    kinds = c.add_mutually_exclusive_group()
    flag(kinds, "--watch", "show hands, tool, target and distances as they change")
    flag(kinds, "--exit-code", "exit with code 1 also if the cell is at fault")
    every = "list all cells on the network; with --watch in a table, each second"
    c.add_argument("--all", action="store_const", dest="run", const="cli.cells.cells", help=every)
    about = "Diagnoses a running cell. For each problem it prints cause and remedy, and then exits with code 1."
    c = _reach(command("doctor", about, "thirdhand doctor"))
    flag(c, "--json", "print the findings as JSON")
    option(c, "--seconds", "S", "observe the cell for this time", 2.0, type=within(float, 0.2, 60))
    _reach(command("hold", "Stops the arm until `resume`.", "thirdhand hold"))
    _reach(command("resume", "Ends an operator's hold.", "thirdhand resume"))
    _reach(command("reset", "Ends a fault.", "thirdhand reset"))

    about = "Writes settings without secrets, status, doctor, versions, log and recordings to an archive for support."
    c = command("bundle", about, "thirdhand bundle --config cell.toml")
    option(c, "--output", "FILE", "write this file (default: thirdhand-CELL-TIME.tar.gz)")
    option(c, "--config", "FILE", "the cell's settings, for the archive and for the folder of its recordings")
    minutes = "take the recordings of this time, and at least the newest one"
    option(c, "--minutes", "N", minutes, 10.0, type=within(float, 0, 1e6, " minutes"))
    option(c, "--log", "FILE", "take the end of this log (default: the journal of the unit thirdhand@NAME)")
    _reach(c)

    about = "Serves the statuses of all cells on a network as metrics for Prometheus."
    c = command("metrics", about, "thirdhand metrics --listen 127.0.0.1:9464")
    option(c, "--listen", "[HOST:]PORT", "serve the page /metrics at this address", "127.0.0.1:9464")
    _reach(c, one=False)

    c = command(
        "arm",
        "Reads an arm's URDF, reports on it, and writes a first cell: settings, and a picture of them.",
        "thirdhand arm my-arm.urdf",
    )
    option(c, "urdf", "URDF", "the arm's description", type=Path)
    option(c, "--plate", "LINK", "the link that carries the tool (default: the end of the chain, if it has only one)")
    at = (
        "position of the arm's root in frame base [m] (default: 0 0 0, or nearby if only that reaches the demo's scene)"
    )
    c.add_argument("--at", metavar=("X", "Y", "Z"), nargs=3, type=within(float, -3.0, 3.0), help=at)
    option(c, "--packages", "DIR", "a folder with ROS packages, for the arm's meshes; may be repeated", action="append")
    output = "write the cell's settings to this file, and the picture to a .png beside it"
    option(c, "--output", "FILE", output, Path("cell.toml"), type=Path)

    c = command("calibrate", calibrate_options.ABOUT_CALIBRATE, calibrate_options.CALIBRATE_EXAMPLE)
    calibrate_options.add_options(c)
    _reach(c)

    # All arguments are passed to `python -m sim`, so there are no options here, not even --help.
    c, abouts["sim"] = commands_of.add_parser("sim", help=SIM, prefix_chars="\0", add_help=False), SIM
    c.set_defaults(run="cli.sim.sim")
    c.add_argument("options", nargs="*")

    c = command(
        "view",
        "Shows recordings or a running daemon in Rerun: in a window, as a picture, or in a browser.",
        "thirdhand view thirdhand-demo/*.rrd\n  thirdhand view thirdhand-demo/*.rrd --screenshot scene.png --time 12\n"
        "  thirdhand view live --web 8080",
    )
    option(c, "files", "FILE|live", "drawings (.rrd) and recordings (.mcap), or `live` for a running daemon", nargs="+")
    picture = c.add_argument_group("a picture")
    option(picture, "--screenshot", "PNG", "write a picture instead of opening a window; of several files, of the last")
    option(picture, "--time", "S", "show this time after the start (default: the last moment in mode follow)")
    tabs = ("task", "timing", "learning")
    option(picture, "--tab", None, "show this tab of the viewer (default: task)", choices=tabs)
    browser = c.add_argument_group("a browser")
    web = "serve `live` as a page for browsers with hold, resume and reset (default: any port of this machine)"
    option(browser, "--web", "[HOST:]PORT", web, nargs="?", const="127.0.0.1:0")
    _reach(c)

    top.groups = {
        title: {name: abouts[name].split(". ")[0].rstrip(".") for name in names} for title, names in GROUPS.items()
    }
    return top


class _Version(argparse.Action):
    """Print the version of the installed distribution."""

    def __call__(self, parser: argparse.ArgumentParser, *_: object) -> None:
        from importlib import metadata  # slow to import

        print(f"thirdhand {metadata.version('thirdhand')}")
        parser.exit()


def _reach(sub: argparse.ArgumentParser, *, one: bool = True) -> argparse.ArgumentParser:
    """The same parser with the options by which a daemon is reached, and if `one`, its cell."""
    group = sub.add_argument_group(
        "how the daemon is reached",
        "An option that is not given is taken from the variable in its help, else from the file\n"
        f"{CLIENT_FILE}.\nThe certificate and Zenoh's own settings are taken from $THIRDHAND_CERTIFICATE and\n"
        "$THIRDHAND_ZENOH_CONFIG, else from the same file.",
    )
    endpoint = "Zenoh endpoint of the daemon or of a router; if repeated, the first that answers"
    option(group, "--connect", "EP", f"{endpoint} ($THIRDHAND_CONNECT, else {channels.ENDPOINT})", action="append")
    if one:
        option(group, "--cell", "NAME", "prefix of all keys ($THIRDHAND_CELL, else thirdhand)")
    sub.set_defaults(reaches=True)
    return sub


def main(arguments: list[str] | None = None) -> int:
    """Run a command line and return its exit code."""
    args = parser().parse_args(arguments)
    module, function = args.run.rsplit(".", 1)
    try:
        if "reaches" in args and not vars(args).get("config"):
            args.cell = reaching(args).cell
        with foreign_modules.named():
            run = getattr(importlib.import_module(f"service.{module}"), function)
            with interrupt.clean_up_first() if args.command in CLEAN_UP_FIRST else contextlib.nullcontext():
                return int(run(args))
    except (UsageError, SettingsError) as error:
        say(f"thirdhand {args.command}: {in_file(str(error))}")
        return 1 if isinstance(error, UnreadableError) else 2
    except BrokenPipeError:  # the reader of standard output, a pager for instance, has ended
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
        return 1
    except (ExplainedError, OSError) as error:
        say(f"thirdhand {args.command}: {in_file(in_words(error))}")
        return 1
    except KeyboardInterrupt:
        interrupt.end_at_once()
