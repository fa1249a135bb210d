"""`thirdhand doctor`: looks at a running cell, and says of each thing what was found, what is
wanted and what to do.
"""

from __future__ import annotations

import argparse
import contextlib
import functools
import re
import socket
import time
from collections.abc import Iterator
from importlib.metadata import version

import msgspec
import zenoh

from service.cli.diagnosis import Finding, findings, wrong
from service.cli.status import heard
from service.cli.usage import CONNECT_TIMEOUT_S, reached, reaching
from service.client import Overheard, RefusedError, StartingError, UnreachableError
from service.contract import cdr
from service.contract.channels import ENDPOINT, key
from service.contract.explain import in_words
from service.contract.messages import WireError
from service.contract.printable import printable_lines

PROBE_S = 1.0
PUBLISHED = ("**/hands/*", "**/joints/state")  # of whatever cell: a name may be wrong


def doctor(args: argparse.Namespace) -> int:
    """Exit code 1 when something is wrong."""
    found = []
    for finding in _looked_at(args):
        found.append(finding)
        if not args.json:
            print(printable_lines(finding.line()), flush=True)
    count = sum(finding.level == "wrong" for finding in found)
    if args.json:
        print(msgspec.json.format(msgspec.json.encode(found)).decode())
    else:
        many = f"{count} things are wrong, the first may be the cause of the rest"
        print("nothing is wrong" if not count else "1 thing is wrong" if count == 1 else many)
    return 1 if count else 0


def _looked_at(args: argparse.Namespace) -> Iterator[Finding]:
    try:
        session = reached(args)
    except UnreachableError as error:
        yield from (unreachable(endpoint, str(error)) for endpoint in reaching(args).connect or [ENDPOINT])
        return
    with session, Overheard(session, *PUBLISHED) as published, contextlib.ExitStack() as closing:
        try:
            with contextlib.closing(heard(session, args.cell)) as told:
                seen = [next(told)]
                travel = Travel()
                if seen[0].command_heard:  # else who is looked for would be ourselves
                    closing.enter_context(travel.watching(session, args.cell))
                end = time.monotonic() + args.seconds
                while time.monotonic() < end:
                    seen.append(next(told))
        except StartingError as error:
            yield wrong("daemon", str(error), "a daemon that is ready", "wait: it tells how far it is")
            return
        except UnreachableError as error:
            cells = {
                str(reply.ok.key_expr).split("/daemon/")[0]
                for reply in session.liveliness().get("**/daemon/*", timeout=CONNECT_TIMEOUT_S)
                if reply.ok is not None
            }
            remedy = "start `thirdhand serve`; with certificates use an operator's or an observer's"
            if args.cell in cells:
                remedy = "ask again; see the log of `thirdhand serve` where it stays so"
            elif cells:
                remedy = f"give --cell: {', '.join(sorted(cells))} can be reached here"
            yield wrong("daemon", str(error), f"a daemon of cell {args.cell}", remedy)
            return
        except RefusedError as error:
            yield wrong("daemon", str(error), f"one of version {version('thirdhand')}", "update the older one")
            return
    yield from findings(
        *seen,
        own_ns=time.time_ns(),
        own_version=version("thirdhand"),
        published=published.keys,
        travels=travel.of_joints(),
    )


class Travel:
    """How far the joints of an arm are told to go, and go, while it watches."""

    def __init__(self) -> None:
        self._told: dict[str, tuple[float, float]] = {}  # lowest and highest of each joint [rad]
        self._went: dict[str, tuple[float, float]] = {}

    @contextlib.contextmanager
    def watching(self, session: zenoh.Session, cell: str) -> Iterator[None]:
        """Watches a cell's arm as long as the context lasts."""
        commands = functools.partial(self._take, self._told)
        states = functools.partial(self._take, self._went)
        with (
            session.declare_subscriber(key(cell, "joints/command"), commands),
            session.declare_subscriber(key(cell, "joints/state"), states),
        ):
            yield

    def of_joints(self) -> dict[str, tuple[float, float]]:
        """How far each joint was told to go, and went [rad]."""
        return {
            name: (told[1] - told[0], went[1] - went[0])
            for name, told in self._told.copy().items()
            if (went := self._went.get(name)) is not None
        }

    @staticmethod
    def _take(spans: dict[str, tuple[float, float]], sample: zenoh.Sample) -> None:
        with contextlib.suppress(WireError):
            message = cdr.decode_joints(sample.payload.to_bytes())
            for name, at in zip(message.names, message.position, strict=False):
                low, high = spans.get(name, (at, at))
                spans[name] = min(low, at), max(high, at)


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
        return wrong("port", f"{host} port {port} cannot be reached: {in_words(error)}", wanted, remedy)
    secured = "the --certificate of your role" if protocol == "tls" else "tls/... and a --certificate"
    remedy = f"a daemon may need {secured}, or be overrun; from another program take the port by another --listen"
    return wrong("port", f"something listens on {host} port {port}, but opens no Zenoh session", wanted, remedy)
