"""Options of the run-time's commands."""

from __future__ import annotations

from thirdhand.arms import GAIN, LAG_S
from thirdhand.cli.usage import (
    ARM_HELP,
    RATE_HELP,
    AddCommand,
    add_end_with,
    described,
    flag,
    option,
    reach,
    within,
)
from thirdhand.contract import channels
from thirdhand.contract.records import SIDES
from thirdhand.contract.requests import TOLERANCE_M, ViaPoint


def follow(add: AddCommand) -> None:
    """Options of `follow`."""
    c = add(
        "follow",
        "Drives an arm by the joint commands of a running cell, and brakes it when the commands "
        "end.",
        "thirdhand follow franka --config cell.toml --robot 172.16.0.2",
    )
    arm = (
        "the arm to drive: franka, ur, wam, xarm, or simulated, an ideal arm; or one of your own, "
        "MODULE:CLASS or FILE.py:CLASS"
    )
    c.add_argument("arm", metavar="ARM", help=arm)
    option(c, "--config", "CELL", f"the settings that the daemon runs with: {ARM_HELP}")
    option(
        c,
        "--robot",
        "ADDRESS",
        "the host name or IP address of the arm's control box (default of franka: 172.16.0.2; of "
        "wam: this machine)",
    )
    lag = "what is written leads by this delay of the servo [s] (default: that of the arm's class)"
    option(c, "--lag", "S", lag, type=within(float, *LAG_S, " s"))
    gain = (
        "and by the acceleration / this stiffness of the servo [1/s²] (default: that of the arm's "
        "class)"
    )
    option(c, "--gain", "K", gain, type=within(float, *GAIN, " 1/s²"))
    option(
        c,
        "--wait",
        "S",
        "wait this long for the daemon, and again this long for its first command",
        60.0,
        type=within(float, 0, 3600, " s"),
    )
    reach(c)


def serve(add: AddCommand) -> None:
    """Options of `serve`."""
    c = add(
        "serve",
        "Runs the daemon of a cell: it receives hand poses and publishes joint commands.",
        "thirdhand serve --record recordings --joints state",
    )
    option(c, "--config", "CELL", f"the cell: {ARM_HELP}; the options below override its settings")
    option(c, "--cell", "NAME", "the prefix of all keys on the network (default: thirdhand)")
    listen = f"listen on this Zenoh endpoint; may be repeated (default: {channels.ENDPOINT})"
    option(c, "--listen", "EP", listen, action="append")
    option(c, "--connect", "EP", "connect to this Zenoh endpoint; may be repeated", action="append")
    option(c, "--rate", "HZ", RATE_HELP)
    skill = (
        "run this skill, made by `thirdhand learn` (default: that of the settings, or else the "
        "shipped one)"
    )
    option(c, "--skill", "FILE", skill)
    joints = (
        "wait for the arm's joint states, or assume the posture in the settings (default: [arm] "
        "source, or state)"
    )
    c.add_argument("--joints", choices=("state", "assumed"), help=joints)
    option(c, "--record", "DIR", "record to .mcap files in this folder")
    live = "serve Rerun viewers of this machine on this port"
    option(c, "--live", "PORT", live, type=within(int, 0, channels.LAST_PORT))
    hold = "begin in hold, until `thirdhand resume`, whatever [arm] start is: for a service manager"
    flag(c, "--hold", hold)
    log = (
        "write the log on standard error as text, or as one JSON object on each line (default: "
        "text)"
    )
    c.add_argument("--log", choices=("text", "json"), default="text", help=log)
    check = (
        "examine settings, arm, skill, folders, disk, certificates and ports, start nothing, and "
        "exit with 0 or 1"
    )
    first = c.add_mutually_exclusive_group()
    first.add_argument(
        "--check",
        action="store_const",
        dest="run",
        const="thirdhand.cli.serve_check.check",
        help=check,
    )
    prepare = (
        "compile what this cell needs, once on a machine, so that its next start takes seconds, "
        "and exit"
    )
    first.add_argument(
        "--prepare",
        action="store_const",
        dest="run",
        const="thirdhand.cli.prepare.prepare",
        help=prepare,
    )
    add_end_with(c)


def via_points(add: AddCommand) -> None:
    """Options of `via-points`."""
    c = add(
        "via-points",
        "Adds, lists and removes via-points of a running daemon.",
        "thirdhand via-points list",
        run="clients.via_points",
    )
    actions = c.add_subparsers(dest="action", required=True, metavar="ACTION")
    example = "thirdhand via-points"
    a = described(
        actions,
        "add",
        "teach via-points: all of them, or none after an error",
        f"{example} add handover --left .62 -.28 .30 --right .98 .32 .06 --tool .54 -.28 .38 "
        f"--radius .03 --follow left --std .001\n  {example} add glass --here",
    )
    a.add_argument(
        "name", nargs="?", help="the name of the via-point; a via-point of this name is replaced"
    )
    for place in (*SIDES, "tool"):
        help_text = f"the position of the {place}{' hand' * (place != 'tool')} in frame base [m]"
        a.add_argument(
            f"--{place}",
            nargs=3,
            type=within(float, -10, 10, " m"),
            metavar=("X", "Y", "Z"),
            help=help_text,
        )
    flag(a, "--here", "use the present positions, once hands and tool hold still")
    defaults = ViaPoint("defaults", (0, 0, 0), (0, 0, 0), (0, 0, 0))
    option(a, "--std", "M", "the standard deviation of the tool's position there [m]", defaults.std)
    option(
        a,
        "--radius",
        "M",
        "the via-point also holds for hands within this distance [m]",
        defaults.radius,
    )
    follow = "the hand that the tool moves with, within the radius"
    option(a, "--follow", None, follow, defaults.follow, choices=("none", *SIDES))
    turn = "the orientation of the tool there, as a quaternion"
    a.add_argument(
        "--orientation",
        nargs=4,
        type=within(float, -1.001, 1.001),
        metavar=("X", "Y", "Z", "W"),
        help=turn,
    )
    a.add_argument("--gripper", choices=("open", "closed"), help="the state of the gripper there")
    option(
        a,
        "--tolerance",
        "M",
        f"replace learned points within this distance (default: {TOLERANCE_M} m)",
    )
    option(
        a, "--file", "FILE", "read the request in JSON from this file instead; - is standard input"
    )
    reach(a)
    a = described(actions, "remove", "remove via-points by name", f"{example} remove handover")
    a.add_argument("names", metavar="NAME", nargs="+")
    reach(a)
    reach(described(actions, "list", "list the via-points in force", f"{example} list"))
    reach(described(actions, "clear", "remove all via-points", f"{example} clear"))


def begin(add: AddCommand) -> None:
    """Options of `begin`."""
    c = reach(
        add(
            "begin",
            "Begins the task of a running daemon anew. A skill that was learned from takes that a "
            "request began needs it.",
            "thirdhand begin\n  thirdhand begin --key",
            run="clients.begin",
        )
    )
    flag(c, "--key", "begin at each Enter, until Ctrl-C; a foot pedal is a keyboard")


def segment(add: AddCommand) -> None:
    """Options of `segment`."""
    c = reach(
        add(
            "segment",
            "Reports to a running daemon that the task has reached a via-point.",
            "thirdhand segment handover",
            run="clients.segment",
        )
    )
    c.add_argument("name", metavar="NAME", help="the name of a via-point of the task")


def correct(add: AddCommand) -> None:
    """Options of `correct`."""
    c = reach(
        add(
            "correct",
            "Corrects the tool while the arm holds: it belongs where you led it by hand.",
            "thirdhand correct\n  thirdhand correct --tool .55 -.28 .40\n"
            "  thirdhand correct --undo",
            run="clients.correct",
        )
    )
    help_text = (
        "the tool belongs here, in frame base [m] (default: where the arm was led by hand in this "
        "hold)"
    )
    c.add_argument(
        "--tool",
        nargs=3,
        type=within(float, -10, 10, " m"),
        metavar=("X", "Y", "Z"),
        help=help_text,
    )
    now = (
        "correct for the hands of this moment (default: for those at which the hold began, as "
        "leading takes a hand)"
    )
    flag(c, "--now", now)
    flag(c, "--turned", "correct the orientation of the tool too")
    flag(c, "--undo", "undo the last correction")


def status(add: AddCommand) -> None:
    """Options of `status`."""
    about = "Shows the status of a running daemon, or of all."
    c = reach(add("status", about, "thirdhand status --json\n  thirdhand status --all"))
    flag(c, "--json", "print <cell>/status as JSON; with --watch, one line per status")
    kinds = c.add_mutually_exclusive_group()
    flag(kinds, "--watch", "show hands, tool, target and distances as they change")
    flag(kinds, "--exit-code", "exit with code 1 also if the cell is at fault")
    every = "list all cells on the network; with --watch in a table, each second"
    c.add_argument(
        "--all", action="store_const", dest="run", const="thirdhand.cli.cells.cells", help=every
    )


def doctor(add: AddCommand) -> None:
    """Options of `doctor`."""
    about = (
        "Diagnoses a running cell. For each problem it prints cause and remedy, and then exits "
        "with code 1."
    )
    c = reach(add("doctor", about, "thirdhand doctor"))
    flag(c, "--json", "print the findings as JSON")
    option(c, "--seconds", "S", "observe the cell for this time", 2.0, type=within(float, 0.2, 60))


def holding(add: AddCommand) -> None:
    """Options of `hold`, `resume` and `reset`."""
    reach(add("hold", "Stops the arm until `resume`.", "thirdhand hold", run="clients.hold"))
    reach(add("resume", "Ends an operator's hold.", "thirdhand resume", run="clients.resume"))
    reach(add("reset", "Ends a fault.", "thirdhand reset", run="clients.reset"))


RUN_TIME = (follow, serve, via_points, begin, segment, correct, status, doctor, holding)
