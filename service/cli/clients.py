"""`thirdhand via-points`, `status`, `hold`, `resume` and `reset`: requests to a running daemon."""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import Any

import zenoh

from service.cli.usage import CONNECT_TIMEOUT_S, UsageError
from service.client import Client, open_session
from service.contract import requests
from service.contract.channels import ENDPOINT


def via_points(args: argparse.Namespace) -> int:
    """Exit code 0 once the daemon has carried it out."""
    request: Any = {"op": args.action}
    if args.action == "remove":
        request["names"] = args.names
    elif args.action == "add":
        request = _add(args)
    reply = ask(args, "via_points", request)
    for point in reply["points"]:
        tool = " ".join(f"{v:.3f}" for v in point["tool"])
        print(f"{point['name']:<16} tool {tool}   missed by {1000 * point['missed_by_m']:.1f} mm")
    count = len(reply["points"])
    print(f"{count} via-point{'' if count == 1 else 's'} in force at tick {reply['tick']}")
    for warning in reply.get("warnings", ()):
        print(f"warning: {warning}", file=sys.stderr)
    return 0


def _add(args: argparse.Namespace) -> Any:
    if args.file:
        return requests.decode_request(
            sys.stdin.buffer.read() if args.file == "-" else Path(args.file).read_bytes(), requests.Add
        )
    if not (args.name and args.left and args.right and args.tool):
        raise UsageError("a name, --left, --right and --tool are needed, or --file")
    point = {"name": args.name, **{k: getattr(args, k) for k in ("left", "right", "tool", "std", "radius", "follow")}}
    return {"op": "add", "points": [point], **({} if args.tolerance is None else {"tolerance": args.tolerance})}


def status(args: argparse.Namespace) -> int:
    """Exit code 0 if a daemon answers."""
    now = ask(args, "status")
    if args.json:
        print(json.dumps(now, indent=2))
        return 0
    begun = now["tick"] >= 0
    granted = ("real time" if now["realtime"] else "ordinary: real time was not granted") + (
        ", memory locked" if now["memory_locked"] else ", memory not locked"
    )
    near = f"{100 * now['hand_distance_m']:.1f} cm to a hand, toward which {now['hand_limit_m_s']:.2f} m/s are allowed"
    rows = {
        "mode": now["mode"]
        + (f" ({now['reason']})" if now["reason"] else "")
        + (f"  {', '.join(now['flags'])}" if now["flags"] else "")
        + ("" if begun else "  it starts: nothing has been decided yet"),
        "skill": f"{now['skill']}; via-points: {', '.join(now['places']) or 'none'}",
        "loop": f"{now['rate_hz']:.2f} Hz, tick {now['tick']}, {now['missed']} missed" if begun else "no tick yet",
        "scheduling": granted if begun else "not known yet",
        "hands": ", ".join(f"{side} {age:.0f} ms old" for side, age in now["hand_age_ms"].items()) or "none seen",
        "nearest": near if now["hand_age_ms"] else "no hand seen",
        "rejected": ", ".join(f"{count} {cause}" for cause, count in now["rejected"].items()) or "none",
        "recording": now["scribe"].get("recording") or f"none ({now['scribe'].get('state', 'off')})",
        **({"lost": f"{now['scribe']['lost']} ticks are not recorded"} if now["scribe"].get("lost") else {}),
        **({"trouble": "; ".join(now["scribe"]["errors"])} if now["scribe"].get("errors") else {}),
    }
    for name in ("lateness_us", "work_us", "latency_ms"):
        label, unit = name.rsplit("_", 1)
        values, digits, unit = now[name], 1 if unit == "us" else 2, unit.replace("us", "µs")
        rows[label] = (
            ", ".join(f"{key} {values[key]:.{digits}f}" for key in ("p50", "p99", "max")) + f" {unit}"
            if values["max"]
            else "none yet"
        )
    for name, text in rows.items():
        print(f"{name:<10} {text}")
    return 0


def hold(args: argparse.Namespace) -> int:
    """Exit code 0 once the arm is told to stop, resume or reset."""
    print(f"{args.command} in force since tick {ask(args, args.command)['tick']}")
    return 0


resume = reset = hold


def reached(args: argparse.Namespace) -> zenoh.Session:
    """A session to where a command line says that a daemon or router is.

    Raises UnreachableError.
    """
    return open_session(
        connect=args.connect or (),
        otherwise=[ENDPOINT],
        timeout_s=CONNECT_TIMEOUT_S,
        certificate=args.certificate,
        zenoh_config=args.zenoh_config,
    )


def ask(args: argparse.Namespace, suffix: str, request: Any = None) -> dict[str, Any]:
    """The reply to one request, as it came. Raises UnreachableError and RefusedError."""
    with reached(args) as session:
        return Client(session, args.cell).ask(suffix, request)
