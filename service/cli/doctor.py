"""`thirdhand doctor`: looks at a running cell, and says of each thing what was found, what is
wanted and what to do.
"""

from __future__ import annotations

import argparse
import contextlib
import re
import socket
import time
from collections.abc import Iterator
from importlib.metadata import version

import msgspec

from service.cli.diagnosis import Finding, findings, wrong
from service.cli.status import heard
from service.cli.usage import CONNECT_TIMEOUT_S, reached, reaching
from service.client import Overheard, UnreachableError
from service.contract.channels import ENDPOINT

PROBE_S = 1.0
PUBLISHED = ("**/hands/*", "**/joints/state")  # of whatever cell: a name may be wrong


def doctor(args: argparse.Namespace) -> int:
    """Exit code 1 when something is wrong."""
    found = []
    for finding in _looked_at(args):
        found.append(finding)
        if not args.json:
            print(finding.line(), flush=True)
    count = sum(finding.level == "wrong" for finding in found)
    if args.json:
        print(msgspec.json.format(msgspec.json.encode(found)).decode())
    else:
        print("nothing is wrong" if not count else f"{count} thing{' is' if count == 1 else 's are'} wrong")
    return 1 if count else 0


def _looked_at(args: argparse.Namespace) -> Iterator[Finding]:
    try:
        session = reached(args)
    except UnreachableError as error:
        yield from (unreachable(endpoint, str(error)) for endpoint in reaching(args).connect or [ENDPOINT])
        return
    with session, Overheard(session, *PUBLISHED) as published:
        try:
            with contextlib.closing(heard(session, args.cell)) as told:
                before = now = next(told)
                end = time.monotonic() + args.seconds
                while time.monotonic() < end:
                    now = next(told)
        except UnreachableError as error:
            cells = {
                str(reply.ok.key_expr).split("/daemon/")[0]
                for reply in session.liveliness().get("**/daemon/*", timeout=CONNECT_TIMEOUT_S)
                if reply.ok is not None
            }
            cells.discard(args.cell)
            there = f"give --cell: {', '.join(sorted(cells))} can be reached here"
            start = "start `thirdhand serve`; with certificates use an operator's or an observer's"
            yield wrong("daemon", str(error), f"a daemon of cell {args.cell}", there if cells else start)
            return
        except msgspec.ValidationError as error:
            yield wrong("daemon", f"a status of another version: {error}", version("thirdhand"), "update the older one")
            return
    yield from findings(before, now, own_ns=time.time_ns(), own_version=version("thirdhand"), published=published.keys)


def unreachable(endpoint: str, said: str) -> Finding:
    """Why no session comes about with an endpoint."""
    match = re.fullmatch(r"(tcp|tls)/\[?(.+?)\]?:(\d+)", endpoint)
    if match is None:
        return wrong("port", said, "an endpoint like tcp/127.0.0.1:7447", "give another --connect")
    protocol, host, port = match.groups()
    wanted = f"a daemon that listens on {endpoint}"
    try:
        socket.create_connection((host, int(port)), timeout=PROBE_S).close()
    except ConnectionRefusedError:
        remedy = "start `thirdhand serve`; its first line says where it listens: give that as --connect"
        return wrong("port", f"nothing listens on {host} port {port}", wanted, remedy)
    except (OSError, OverflowError) as error:
        remedy = "look at the address, the network and its firewall"
        return wrong("port", f"{host} port {port} cannot be reached: {error}", wanted, remedy)
    secured = "the --certificate of your role" if protocol == "tls" else "tls/... and a --certificate"
    remedy = f"a daemon may need {secured}, or be overrun; from another program take the port by another --listen"
    return wrong("port", f"something listens on {host} port {port}, but opens no Zenoh session", wanted, remedy)
