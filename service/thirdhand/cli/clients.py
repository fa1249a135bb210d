"""Requests to a daemon: `via-points`, `begin`, `segment`, `correct`, `hold`, `resume`, `reset`."""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Mapping
from typing import Any

import msgspec

from thirdhand.cli.here import still
from thirdhand.cli.usage import UsageError, added_in, reached
from thirdhand.client import Client, RefusedError, UnreachableError
from thirdhand.contract.incidents import in_brief, what_to_do
from thirdhand.contract.records import SIDES
from thirdhand.contract.requests import Correction
from thirdhand.process.progress import progress, say

WAITING = "waiting for the daemon's answer"


def via_points(args: argparse.Namespace) -> int:
    """Send the request and print the via-points in force; exit code 0."""
    request: dict[str, Any] = {"op": args.action}
    if args.action == "remove":
        request["names"] = args.names
    elif args.action == "add":
        request = _add(args)
    with reached(args) as session, progress(WAITING):
        client = Client(session, args.cell)
        before = client.ask("via_points", {"op": "list"})["points"] if args.action == "add" else []
        reply = client.ask("via_points", request)

    for point in reply["points"]:
        print(_line(point))
    count = len(reply["points"])
    print(f"{count} via-point{'' if count == 1 else 's'} in force at tick {reply['tick']}")
    added = [point["name"] for point in request.get("points", ())]
    if replaced := [point["name"] for point in before if point["name"] in added]:
        print(f"replaced, because a via-point had the same name: {', '.join(replaced)}")
    for warning in reply.get("warnings", ()):
        print(f"warning: {warning}", file=sys.stderr)
    return 0


def _line(point: Mapping[str, Any]) -> str:
    """A via-point in one line."""
    tool = " ".join(f"{v:.3f}" for v in point["tool"])
    parts = [f"missed by {1000 * point['missed_by_m']:.1f} mm"]
    if point["missed_by_rad"] is not None:
        parts.append(f"{math.degrees(point['missed_by_rad']):.1f}°")
    if point["gripper"]:
        parts.append(f"gripper {point['gripper']}")
    if point["segment"]:
        parts.append(f"in the segment from {point['segment']} on")
    if point["corrections"]:
        plural = "s" * (point["corrections"] != 1)
        parts.append(f"corrected {point['corrections']} time{plural}")
    return f"{point['name']:<16} tool {tool}   {', '.join(parts)}"


def _add(args: argparse.Namespace) -> Any:
    """The request that adds the via-points of a file, or the one of the options."""
    if args.file:
        return msgspec.to_builtins(added_in(args.file))
    if args.name:
        _complete(args)
    if not (args.name and args.left and args.right and args.tool):
        raise UsageError(
            "NAME with --here, or NAME with --left, --right and --tool, or --file needed; for a "
            "skill of one hand, its option suffices"
        )
    fields = ("left", "right", "tool", "std", "radius", "follow", "orientation", "gripper")
    point = {"name": args.name, **{name: getattr(args, name) for name in fields}}
    return {
        "op": "add",
        "points": [point],
        **({} if args.tolerance is None else {"tolerance": args.tolerance}),
    }


def _complete(args: argparse.Namespace) -> None:
    """Complete the positions: with --here by those of now, and for a skill of one hand by that of
    the other hand, which the skill ignores.
    """
    if args.here:
        for name, position in still(args).items():
            setattr(args, name, getattr(args, name) or position)
    sides = [side for side in SIDES if getattr(args, side)]
    if args.tool and len(sides) == 1 and ask(args, "status").get("hands") == sides[0]:
        args.left = args.right = args.left or args.right


def begin(args: argparse.Namespace) -> int:
    """Begin the task, once or at each Enter; exit code 0."""
    with reached(args) as session:
        client = Client(session, args.cell)
        if args.key:
            say("each Enter begins the task; Ctrl-C ends this")
        for _ in sys.stdin if args.key else ("once",):
            try:
                reply = client.begin()
            except (UnreachableError, RefusedError) as error:
                if not args.key:
                    raise
                say(f"not begun: {error}")
                continue
            note = f"; {reply.note}" if reply.note else ""
            print(
                f"begun at tick {reply.tick}: {in_brief(reply.mode, reply.reason)}{note}",
                flush=True,
            )
    return 0


def segment(args: argparse.Namespace) -> int:
    """Report the reached via-point and print the resulting mode; exit code 0."""
    reply = ask(args, "segment", {"name": args.name})
    mode, reason = (reply.get(name, "") for name in ("mode", "reason"))
    print(f"at {args.name} since tick {reply['tick']}: {in_brief(mode, reason)}")
    return 0


def correct(args: argparse.Namespace) -> int:
    """Correct the tool, or undo the last correction, and print its effect; exit code 0."""
    request: dict[str, Any] = {"op": "undo"}
    if not args.undo:
        request = {"op": "add", "hands": "now" if args.now else "held", "turned": args.turned}
        request |= {"tool": args.tool} if args.tool else {}
    elif args.tool or args.now or args.turned:
        raise UsageError("--undo accepts no other option")
    reply = ask(args, "correct", request)
    correction = msgspec.convert(reply["correction"], Correction)
    print(
        f"{correction.name} {'undone' if correction.undone else 'in force'} since tick "
        f"{reply['tick']}: {correction.text}"
    )
    print("Then `thirdhand resume`: the tool approaches its target at [tool] engage_speed.")
    if note := reply.get("note"):
        print(note[0].upper() + note[1:])
    for warning in reply.get("warnings", ()):
        print(f"warning: {warning}", file=sys.stderr)
    return 0


def hold(args: argparse.Namespace) -> int:
    """Send hold, resume or reset and print the resulting mode; exit code 0."""
    reply = ask(args, args.command)
    mode, reason, note = (reply.get(name, "") for name in ("mode", "reason", "note"))
    print(
        f"{args.command} in force since tick {reply['tick']}: "
        f"{in_brief(mode, reason)}{f'; {note}' if note else ''}"
    )
    if (mode == "fault" or (args.command == "resume" and mode == "hold")) and what_to_do(reason):
        print(f"What to do: {what_to_do(reason)}")
    return 0


resume = reset = hold


def ask(args: argparse.Namespace, suffix: str, request: Any = None) -> dict[str, Any]:
    """The reply to a request as received. Raises UnreachableError, RefusedError."""
    with reached(args) as session, progress(WAITING):
        return Client(session, args.cell).ask(suffix, request)
