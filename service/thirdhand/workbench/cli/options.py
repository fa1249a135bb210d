"""Options of the workbench's commands."""

from __future__ import annotations

from pathlib import Path

from thirdhand.cli.usage import (
    ARM_HELP,
    RATE_HELP,
    WORKERS_HELP,
    AddCommand,
    flag,
    option,
    reach,
    within,
)
from thirdhand.contract.records import SIDES
from thirdhand.skills.residual_risk import OPTION
from thirdhand.workbench.cli import calibrate_options, record_options

DEMO_RATE = (
    "the rate of the control loop (default: the rate in the cell's settings; 100 Hz for a shipped "
    "arm with --mouse or --open, because a browser without a GPU needs a core for itself)"
)


def demo(add: AddCommand) -> None:
    """Options of `demo`."""
    c = add(
        "demo",
        "Runs the soldering scenario once, without a window: simulated bench, service and "
        "recording. Then reports how the task went.",
        "thirdhand demo --open\n  thirdhand demo --scene my-scene.toml\n  thirdhand demo --mouse "
        "--open",
    )
    output = "write the recording, the drawing and the service's log to this folder"
    option(c, "--output", "DIR", output, Path("thirdhand-demo"))
    scene = (
        "a TOML file with the places of the scene, as handover = [x, y, z] in metres, frame base"
    )
    option(c, "--scene", "FILE", scene)
    option(c, "--arm", "ARM", ARM_HELP, "wam")
    engine = "the physics engine of the bench (default: the first that is installed)"
    c.add_argument("--engine", choices=("pybullet", "mujoco"), help=engine)
    option(c, "--rate", "HZ", DEMO_RATE)
    mouse = (
        "play the hands yourself, with a mouse or a finger, on a page that is served at this "
        "address (default: any port of this machine)"
    )
    option(c, "--mouse", "[HOST:]PORT", mouse, nargs="?", const="127.0.0.1:0")
    flag(c, "--open", "open the live view, or the page of --mouse, in this machine's browser")
    flag(c, "--json", "print the report as one JSON object")


def bench(add: AddCommand) -> None:
    """Options of `bench`."""
    c = add(
        "bench",
        "Measures the timing of the control loop on this machine.",
        "thirdhand bench --rate 1000 --seconds 60",
        run="thirdhand.workbench.timing.benchmark.bench",
    )
    option(c, "--seconds", "S", "measure for this time", 24.0, type=within(float, 0.1, 1e6))
    option(c, "--rate", "HZ", RATE_HELP)
    flag(c, "--json", "print the report as one JSON object")
    option(c, "--arm", "ARM", ARM_HELP, "wam")
    option(
        c, "--output", "DIR", "write bench.json, a picture of it and the recording to this folder"
    )


def play(add: AddCommand) -> None:
    """Options of `play`."""
    c = add(
        "play",
        "Publishes the hands of a recording or demonstration, as a tracker does.",
        "thirdhand play recordings/demonstration-6.mcap --loop",
        run="recordings.play",
    )
    option(
        c,
        "file",
        "FILE",
        "the recording or demonstration: an MCAP file with hands/left and hands/right",
    )
    option(
        c,
        "--speed",
        "X",
        "play this many times as fast as recorded",
        1.0,
        type=within(float, 0.01, 100),
    )
    flag(c, "--loop", "start again at the end, until Ctrl-C")
    reach(c)


def hands(add: AddCommand) -> None:
    """Options of `hands`."""
    c = add(
        "hands",
        "Publishes your hands, as a headset's browser, a camera or your own tracker sees them, or "
        "as you drag them with a mouse or a finger. Open the address that it prints.",
        "thirdhand hands --mouse --open\n  thirdhand hands --web --listen 0.0.0.0:8443 --https "
        "192.168.1.20\n"
        "  thirdhand hands --camera --hand-length 0.19",
    )
    kinds = c.add_mutually_exclusive_group(required=True)
    flag(kinds, "--web", "serve a page for the browser of a headset (WebXR)")
    flag(
        kinds,
        "--mouse",
        "serve a page on which both hands are dragged over the bench, seen from above",
    )
    camera = (
        "the hands that this camera sees (default: camera 0), or a video file; needs "
        "thirdhand[camera]"
    )
    option(kinds, "--camera", "NUMBER", camera, nargs="?", const="0")
    own = "the hands of your own tracker: MODULE:CLASS or FILE.py:CLASS of a thirdhand.Hands"
    option(kinds, "--own", "CLASS", own)
    address = (
        "serve the page at this address; port 0: any free one; for other machines with --https"
    )
    option(c, "--listen", "HOST:PORT", address, "127.0.0.1:8443")
    https = (
        "serve the page by HTTPS, for a headset that reaches this machine by this name or address"
    )
    option(c, "--https", "NAME", https)
    length = (
        "length of your hand, from the crease of the wrist to the tip of the middle finger "
        "(--camera)"
    )
    option(c, "--hand-length", "M", length, 0.18, type=within(float, 0.1, 0.3, " m"))
    view = "horizontal angle of view of the lens, in degrees (--camera)"
    option(c, "--view", "DEG", view, 60.0, type=within(float, 20, 150, " degrees"))
    model = (
        "hand_landmarker.task, or the wheel of mediapipe 0.10.21 (--camera; default: it is "
        "downloaded once)"
    )
    option(c, "--model", "FILE", model)
    clutch = "press the clutch of `[hands] clutch` while this hand pinches (--web)"
    c.add_argument("--pinch-clutch", choices=SIDES, help=clutch)
    gripper = "close the gripper of `[hands] gripper` with the fingers of this hand (--web)"
    c.add_argument("--pinch-gripper", choices=SIDES, help=gripper)
    lead = "lead the tool by this hand or controller while it pinches: tool/wish (--web)"
    c.add_argument("--lead", choices=SIDES, help=lead)
    flag(c, "--open", "open the page of --mouse in this machine's browser")
    reach(c)


def replay(add: AddCommand) -> None:
    """Options of `replay`."""
    c = add(
        "replay",
        "Runs the core on a recording, or on several that follow each other, and compares every "
        "frame. Missing and "
        "damaged parts are listed; only with --exact they are failures.",
        "thirdhand replay recordings/golden.mcap --exact\n  thirdhand replay archive/*.mcap --each "
        "--workers 8",
        run="recordings.replay",
    )
    option(c, "files", "FILE", "a recording, and those that follow it", nargs="+")
    flag(c, "--exact", "fail for gaps, damage, a cut, and differences below 10 µm and 10 µrad")
    option(
        c, "--after", "TICK", "start from the first recorded state at or after this tick", type=int
    )
    option(
        c, "--output", "FILE", "write the new frames as a recording, for report, view or comparison"
    )
    flag(c, "--each", "replay each recording by itself; no failure stops the others")
    option(c, "--workers", "WORKERS", f"{WORKERS_HELP}; with --each")


def record(add: AddCommand) -> None:
    """Options of `record`."""
    c = add("record", record_options.ABOUT_RECORD, record_options.RECORD_EXAMPLE)
    record_options.add_options(c)
    reach(c)


def report(add: AddCommand) -> None:
    """Options of `report`."""
    c = add(
        "report",
        "Reports on recordings: missing ticks, modes and reasons, faults and their causes, timing, "
        "closest approach, "
        "via-points, limits, rejections. Several recordings are compared.",
        "thirdhand report thirdhand-demo/*.mcap --html report.html",
        run="report_command.report",
    )
    option(c, "files", "FILE", "a recording (.mcap); several are compared", nargs="+")
    option(c, "--html", "FILE", "also write the report with plots as a page to this file")
    option(c, "--csv", "DIR", "also write each table, and every tick, as CSV files to this folder")
    option(
        c,
        "--lerobot",
        "DIR",
        "also write joints, hands, images, commands as a LeRobot data set to this new folder",
    )
    option(c, "--fps", "N", "the rate of the data set [rows/s]", 50, type=within(int, 1, 1000))
    option(
        c, "--task", "TEXT", "the task of the data set, in words (default: the name of the skill)"
    )
    option(c, "--workers", "WORKERS", WORKERS_HELP)


def learn(add: AddCommand) -> None:
    """Options of `learn`."""
    c = add(
        "learn",
        "Learns a skill from demonstrations and judges it by held-out ones: each is left out once "
        "and predicted "
        "from the others. An unsafe skill is not written, and the exit code is 1. A skill with a "
        "residual risk is written, but the daemon serves it only if somebody has accepted that.",
        "thirdhand learn recordings/demonstration-[1-5].mcap --output soldering.npz --plot "
        "soldering.png\n"
        "  thirdhand learn --from soldering.npz mine-[1-3].mcap --output mine.npz",
        run="recordings.learn",
    )
    demonstrations = (
        "demonstrations with hands/left, hands/right and tool/pose or the arm's joints/state: "
        "MCAP, .db3, a bag's folder, .bag, CSV of Motive, C3D"
    )
    option(c, "demonstrations", "DEMO", demonstrations, nargs="+", type=Path)
    for name in ("left", "right", "tool"):
        c.add_argument(
            f"--{name}",
            metavar="TOPIC[:PART]",
            help=f"the topic of the {name}{' hand' * (name != 'tool')} in recordings of other "
            "systems: poses, a PoseArray with an index, or a TFMessage with a child frame"
            + "; or joint states"
            * (name == "tool"),
        )
    option(c, "--output", "FILE", "write the skill to this .npz file", required=True)
    option(c, "--plot", "FILE", "draw the held-out errors to this .png file")
    refine = (
        "refine the skill in this .npz file: learn from its demonstrations and these, which are of "
        "those who will work with it and count as much more as predicts them best; about three are "
        "enough"
    )
    option(c, "--from", "FILE", refine, dest="refined")
    c.add_argument("--name", help="the name of the skill (default: the name of the file)")
    delay = (
        "the teacher's delay [s], for demonstrations with via-points (default: chosen by held-out "
        "errors)"
    )
    option(c, "--delay", "S", delay, type=within(float, 0.0, 1.0, " s"))
    option(c, "--workers", "WORKERS", WORKERS_HELP)
    option(
        c,
        "--config",
        "CELL",
        f"the cell, for the tracker's axes and unit and for the arm: {ARM_HELP}",
    )
    via_points = (
        "the via-points of the task, as `via-points add --file` reads them, for demonstrations "
        "without via-points; the skill is then learned between these via-points and follows them "
        "when they move"
    )
    option(c, "--via-points", "FILE", via_points)
    wishes = (
        "calibrate a policy instead: each DEMO is a recording of a cell whose tool wishes lead, in "
        "which somebody leads the arm through the task"
    )
    c.add_argument("--wishes", action="store_true", help=wishes)
    accept = (
        "accept the residual risk of the skill, if it has one, in the name of this person, who "
        "takes responsibility for it; skill, daemon and status name both"
    )
    option(c, OPTION, "NAME", accept)


def bundle(add: AddCommand) -> None:
    """Options of `bundle`."""
    about = (
        "Writes settings without secrets, status, doctor, versions, log and recordings to an "
        "archive for support."
    )
    c = add("bundle", about, "thirdhand bundle --config cell.toml")
    option(c, "--output", "FILE", "write this file (default: thirdhand-CELL-TIME.tar.gz)")
    option(
        c,
        "--config",
        "FILE",
        "the cell's settings, for the archive and for the folder of its recordings",
    )
    minutes = "take the recordings of this time, and at least the newest one"
    option(c, "--minutes", "N", minutes, 10.0, type=within(float, 0, 1e6, " minutes"))
    option(
        c,
        "--log",
        "FILE",
        "take the end of this log (default: the journal of the unit thirdhand@NAME)",
    )
    reach(c)


def metrics(add: AddCommand) -> None:
    """Options of `metrics`."""
    about = "Serves the statuses of all cells on a network as metrics for Prometheus."
    c = add("metrics", about, "thirdhand metrics --listen 127.0.0.1:9464")
    option(
        c, "--listen", "[HOST:]PORT", "serve the page /metrics at this address", "127.0.0.1:9464"
    )
    reach(c, one=False)


def arm(add: AddCommand) -> None:
    """Options of `arm`."""
    c = add(
        "arm",
        "Reads an arm's URDF, reports on it, and writes a first cell: settings, and a picture of "
        "them.",
        "thirdhand arm my-arm.urdf",
    )
    option(c, "urdf", "URDF", "the arm's description", type=Path)
    option(
        c,
        "--plate",
        "LINK",
        "the link that carries the tool (default: the end of the chain, if it has only one)",
    )
    position = (
        "position of the arm's root in frame base [m] (default: 0 0 0, or nearby if only that "
        "reaches the demo's scene)"
    )
    c.add_argument(
        "--at", metavar=("X", "Y", "Z"), nargs=3, type=within(float, -3.0, 3.0), help=position
    )
    option(
        c,
        "--packages",
        "DIR",
        "a folder with ROS packages, for the arm's meshes; may be repeated",
        action="append",
    )
    output = "write the cell's settings to this file, and the picture to a .png beside it"
    option(c, "--output", "FILE", output, Path("cell.toml"), type=Path)


def calibrate(add: AddCommand) -> None:
    """Options of `calibrate`."""
    c = add("calibrate", calibrate_options.ABOUT_CALIBRATE, calibrate_options.CALIBRATE_EXAMPLE)
    calibrate_options.add_options(c)
    reach(c)


def sim(add: AddCommand) -> None:
    """Options of `sim`."""
    # `python -m thirdhand_sim` reads all arguments, so there are no options here, not even --help.
    about = "Runs the simulated bench: it publishes hands and joint states, and follows commands."
    c = add.bare("sim", about)
    c.add_argument("options", nargs="*")


def view(add: AddCommand) -> None:
    """Options of `view`."""
    c = add(
        "view",
        "Shows recordings or a running daemon in Rerun: in a window, as a picture, or in "
        "a browser.",
        "thirdhand view thirdhand-demo/*.rrd\n  thirdhand view thirdhand-demo/*.rrd --screenshot "
        "scene.png --time 12\n"
        "  thirdhand view live --web 8080",
    )
    option(
        c,
        "files",
        "FILE|live",
        "drawings (.rrd) and recordings (.mcap), or `live` for a running daemon",
        nargs="+",
    )
    picture = c.add_argument_group("a picture")
    option(
        picture,
        "--screenshot",
        "PNG",
        "write a picture instead of opening a window; of several files, of the last",
    )
    option(
        picture,
        "--time",
        "S",
        "show this time after the start (default: the last moment in mode follow)",
    )
    tabs = ("task", "timing", "learning")
    option(picture, "--tab", None, "show this tab of the viewer (default: task)", choices=tabs)
    browser = c.add_argument_group("a browser")
    web = (
        "serve `live` as a page for browsers with hold, resume and reset (default: any port of "
        "this machine)"
    )
    option(browser, "--web", "[HOST:]PORT", web, nargs="?", const="127.0.0.1:0")
    reach(c)


WORKBENCH = (
    demo,
    bench,
    play,
    hands,
    replay,
    record,
    report,
    learn,
    bundle,
    metrics,
    arm,
    calibrate,
    sim,
    view,
)
