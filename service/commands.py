"""What each `thirdhand` command does with its arguments. Heavy imports wait until a command needs them."""

from __future__ import annotations

import argparse
import json
import logging
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import msgspec

from service import wire
from service.client import Client, UnreachableError, open_session
from service.config import ENDPOINT, ExplainedError, Settings, SettingsError, converted, load

CONNECT_TIMEOUT_S = 3.0
SHIPPED_SKILL = "soldering.npz"


class UsageError(ValueError):
    """A command line that cannot be meant."""


def recordings() -> Path:
    """The folder of the shipped recordings and their skill."""
    here = Path(__file__).parent
    return next((folder for folder in (here / "recordings", here.parent / "recordings") if folder.is_dir()), here.parent / "recordings")


def demo(args: argparse.Namespace) -> int:
    """0 only if the task succeeded."""
    from service import demo as scenario

    report = scenario.demo(args.out, scene=args.scene, say=lambda line: print(line, file=sys.stderr, flush=True))
    print(json.dumps(report, indent=2) if args.json else scenario.text(report))
    return 0 if report["success"] else 1


def serve(args: argparse.Namespace) -> int:
    """0 once it was asked to stop and has closed everything."""
    from service import daemon
    from service.scribe import Scribe

    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(message)s", stream=sys.stderr)
    settings = _overridden(load(args.config) if args.config else Settings(), args)
    skills = Path(settings.files.skills).expanduser() if settings.files.skills else recordings()
    folder = Path(settings.files.record).expanduser() if settings.files.record else None
    scribe = Scribe(settings, folder=folder, live_port=args.live)

    def announce(running: daemon.Daemon) -> None:
        where = ", ".join(running.endpoints) or f"nothing, connected to {', '.join(settings.network.connect)}"
        print(f"listening on {where} as cell {settings.cell}", flush=True)

    daemon.serve(settings, args.skill or skills / SHIPPED_SKILL, skills=skills, scribe=scribe, announce=announce)
    return 0


def _overridden(settings: Settings, args: argparse.Namespace) -> Settings:
    """The settings with what the command line says in their place."""
    given: dict[str, Any] = msgspec.to_builtins(settings)
    for section, field, value in (
        (given, "cell", args.cell),
        (given, "rate_hz", args.rate),
        (given["network"], "listen", args.listen or ([] if args.connect and not args.config else None)),
        (given["network"], "connect", args.connect),
        (given["arm"], "source", args.arm),
        (given["files"], "record", str(args.record) if args.record else None),
    ):
        if value is not None:
            section[field] = value
    try:
        return converted(given, origin="command line")
    except SettingsError as error:
        raise UsageError(str(error)) from None


def play(args: argparse.Namespace) -> int:
    """0 once all hands are published."""
    from service.recording import iter_hands

    if not 0.01 <= args.speed <= 100:
        raise UsageError(f"--speed {args.speed}: 0.01 to 100 accepted")
    hands = list(iter_hands(args.file))
    start_ns, last_ns = hands[0][0], hands[-1][0]
    with open_session(connect=args.connect or [ENDPOINT], timeout_s=CONNECT_TIMEOUT_S) as session:
        publishers = {side: session.declare_publisher(wire.key(args.cell, f"hands/{side}")) for side in ("left", "right")}
        until = time.monotonic() + 5.0
        while not all(publisher.matching_status for publisher in publishers.values()):
            if time.monotonic() > until:
                raise UnreachableError(f"nobody listens to {wire.key(args.cell, 'hands/left')}: is a daemon running in this cell?")
            time.sleep(0.02)
        print(f"{len(hands)} hand poses over {(last_ns - start_ns) / 1e9:.1f} s from {args.file}", file=sys.stderr)
        while True:
            begin = time.monotonic()
            for time_ns, side, payload in hands:
                early = begin + (time_ns - start_ns) / 1e9 / args.speed - time.monotonic()
                if early > 0:
                    time.sleep(early)
                # a tracker stamps what it sees now
                publishers[side].put(wire.encode_pose(wire.decode_pose(payload)._replace(stamp_ns=time.time_ns())))
            if not args.loop:
                return 0


def replay(args: argparse.Namespace) -> int:
    """0 if every frame is identical, or close enough where that is allowed."""
    from service.replay import replay as run

    def progress(ticks: int) -> None:
        print(f"\r{ticks} ticks", end="", file=sys.stderr, flush=True)

    result = run(args.file, after=args.after, progress=progress if sys.stderr.isatty() else None)
    if sys.stderr.isatty():
        print("\r", end="", file=sys.stderr)
    print(result.text())
    return 0 if result.exact or (result.close and not args.exact) else 1


def learn(args: argparse.Namespace) -> int:
    """0 once the skill is written."""
    import numpy as np

    from service.recording import read_demonstration
    from service.skill import Demonstrated
    from service.skill import learn as learned

    demonstrations = []
    for i, path in enumerate(args.demonstrations, start=1):
        taught = read_demonstration(path)
        period_s = float(taught.stamps_ns[-1] - taught.stamps_ns[0]) / 1e9 / (len(taught.stamps_ns) - 1)
        demonstrations.append(Demonstrated(np.hstack([taught.left[:, :3], taught.right[:, :3]]), taught.tool, period_s))
        print(
            f"{i} of {len(args.demonstrations)}: {path}, {len(taught.stamps_ns)} samples over {period_s * len(taught.stamps_ns):.1f} s",
            file=sys.stderr,
        )
    skill = learned(
        demonstrations, name=args.name or args.output.stem, seed=args.seed, progress=lambda line: print(line, file=sys.stderr, flush=True)
    )
    args.output.write_bytes(skill.to_bytes())
    print(f"{args.output}: {len(skill.primitive.inputs)} reference points; off the data above {1000 * skill.threshold:.0f} mm of deviation")
    return 0


def via_points(args: argparse.Namespace) -> int:
    """0 once the daemon has carried it out."""
    request: Any = {"op": args.action}
    if args.action == "remove":
        request["names"] = args.names
    elif args.action == "add":
        request = _add(args)
    reply = _ask(args, "via_points", request)
    for point in reply["points"]:
        tool = " ".join(f"{v:.3f}" for v in point["tool"])
        print(f"{point['name']:<16} tool {tool}   missed by {1000 * point['missed_by_m']:.1f} mm")
    print(f"{len(reply['points'])} places in force at tick {reply['tick']}")
    return 0


def _add(args: argparse.Namespace) -> Any:
    if args.file:
        return wire.decode_request(sys.stdin.buffer.read() if args.file == "-" else Path(args.file).read_bytes(), wire.Add)
    if not (args.name and args.left and args.right and args.tool):
        raise UsageError("a name, --left, --right and --tool are needed, or --file")
    point = {"name": args.name, **{k: getattr(args, k) for k in ("left", "right", "tool", "std", "radius", "follow")}}
    return {"op": "add", "points": [point], **({} if args.tolerance is None else {"tolerance": args.tolerance})}


def status(args: argparse.Namespace) -> int:
    """0 if a daemon answers."""
    now = _ask(args, "status")
    if args.json:
        print(json.dumps(now, indent=2))
        return 0
    rows = {
        "mode": now["mode"] + (f" ({now['reason']})" if now["reason"] else "") + (f"  {', '.join(now['flags'])}" if now["flags"] else ""),
        "skill": f"{now['skill']}; places: {', '.join(now['places']) or 'none'}",
        "loop": f"{now['rate_hz']:.2f} Hz, tick {now['tick']}, {now['missed']} missed",
        "scheduling": "real time" if now["realtime"] else "ordinary: real time was not granted",
        "hands": ", ".join(f"{side} {age:.0f} ms old" for side, age in now["hand_age_ms"].items()) or "none seen",
        "rejected": ", ".join(f"{count} {cause}" for cause, count in now["rejected"].items()) or "none",
        "recording": now["scribe"].get("recording") or "none",
    }
    for name in ("lateness_us", "work_us", "latency_ms"):
        label, unit = name.rsplit("_", 1)
        rows[label] = "p50 {p50:.4g}, p99 {p99:.4g}, max {max:.4g} {unit}".format(**now[name], unit=unit.replace("us", "µs"))
    for name, text in rows.items():
        print(f"{name:<10} {text}")
    return 0


def hold(args: argparse.Namespace) -> int:
    """0 once the arm is told to stop, resume or reset."""
    print(f"{args.command} in force since tick {_ask(args, args.command)['tick']}")
    return 0


resume = reset = hold


def _ask(args: argparse.Namespace, suffix: str, request: Any = None) -> dict[str, Any]:
    with open_session(connect=args.connect or [ENDPOINT], timeout_s=CONNECT_TIMEOUT_S) as session:
        return Client(session, args.cell).ask(suffix, request)


def view(args: argparse.Namespace) -> int:
    """0 once the viewer is open, or the picture written."""
    from service import viewer

    if args.file == "live":
        url = _ask(args, "status")["scribe"].get("live")
        if not url:
            raise UsageError("this daemon serves no live view; start it with --live PORT")
        return _show(viewer, url, args)
    path = Path(args.file)
    if not path.exists():
        raise ExplainedError(f"no such file: {path}")
    if path.suffix == ".rrd":
        return _show(viewer, str(path), args)
    with tempfile.TemporaryDirectory() as folder:
        drawn = Path(folder) / f"{path.stem}.rrd"
        viewer.convert(path, drawn)
        return _show(viewer, str(drawn), args)


def _show(viewer: Any, source: str, args: argparse.Namespace) -> int:
    if args.screenshot:
        viewer.screenshot(source, args.screenshot, time=args.time)
        print(args.screenshot)
        return 0
    return int(viewer.show(source))
