"""`thirdhand doctor`: examines a running cell; prints what was found and what to do about it."""

from __future__ import annotations

import argparse
import contextlib
import functools
import math
import socket
import time
from collections import deque
from collections.abc import Iterator
from importlib.metadata import version
from typing import TypeAlias

import msgspec
import zenoh

from thirdhand.cli.diagnosis import Finding, findings, wrong
from thirdhand.cli.status import statuses
from thirdhand.cli.usage import CONNECT_TIMEOUT_S, reached, reaching
from thirdhand.client import Overheard, RefusedError, StartingError, UnreachableError
from thirdhand.contract import cdr
from thirdhand.contract.channels import ENDPOINT, key, tcp_address
from thirdhand.contract.explain import in_words
from thirdhand.contract.incidents import Condition, what_to_do
from thirdhand.contract.messages import WireError
from thirdhand.contract.printable import printable_lines
from thirdhand.contract.requests import Status
from thirdhand.contract.ros2 import NO_TYPE_HASH
from thirdhand.process import bytecode

PROBE_S = 1.0
MAX_SERIES = 30_000  # samples of a joint: 60 s at 500 Hz
# in any cell, because a name may be wrong
PUBLISHED = ("**/hands/*", "**/joints/state", f"**/{NO_TYPE_HASH}")

Series: TypeAlias = deque[tuple[float, float]]  # arrival [s] and position [rad] of a joint


def doctor(args: argparse.Namespace) -> int:
    """Examine a cell and print what is found; exit code 1 if something is wrong."""
    results = []
    for finding in _examined(args):
        results.append(finding)
        if not args.json:
            print(printable_lines(finding.text()), flush=True)
    count = sum(finding.level == "wrong" for finding in results)
    if args.json:
        print(msgspec.json.format(msgspec.json.encode(results)).decode())
    else:
        few = ("nothing is wrong", "1 thing is wrong")
        many = f"{count} things are wrong; the first may cause the others"
        print(few[count] if count < len(few) else many)
    return 1 if count else 0


def _examined(args: argparse.Namespace) -> Iterator[Finding]:
    try:
        session = reached(args)
    except UnreachableError as error:
        yield from (
            unreachable(endpoint, str(error)) for endpoint in reaching(args).connect or [ENDPOINT]
        )
        return
    travel = Travel()
    with session, Overheard(session, *PUBLISHED) as published:
        try:
            history = _history(session, args, travel)
        except (UnreachableError, RefusedError) as error:
            yield _no_daemon(session, args.cell, error)
            return
    yield from findings(
        *history,
        own_ns=time.time_ns(),
        own_version=version("thirdhand"),
        published=published.keys,
        travels=travel.of_joints(),
        lag_ms=travel.lag_ms(),
    )
    if uncompiled := bytecode.missing():
        yield Finding("note", "bytecode", uncompiled)


def _history(session: zenoh.Session, args: argparse.Namespace, travel: Travel) -> list[Status]:
    """The statuses of the next seconds, in which the arm's `travel` is watched. Raises
    UnreachableError and RefusedError.
    """
    with (
        contextlib.ExitStack() as closing,
        contextlib.closing(statuses(session, args.cell)) as arriving,
    ):
        history = [next(arriving)]
        # otherwise the daemon would take this subscriber for a driver
        if history[0].command_heard:
            closing.enter_context(travel.watching(session, args.cell))
        end_s = time.monotonic() + args.seconds
        while time.monotonic() < end_s:
            history.append(next(arriving))
    return history


def _no_daemon(
    session: zenoh.Session, cell: str, error: UnreachableError | RefusedError
) -> Finding:
    """The finding on a daemon that gives no status."""
    if isinstance(error, StartingError):
        required = "a daemon that is ready"
        condition = Condition.STARTING
    elif isinstance(error, RefusedError):
        required = f"version {version('thirdhand')}"
        condition = Condition.VERSIONS_DIFFER
    else:
        required = f"a daemon of cell {cell}"
        condition = _absence(session, cell)
    return wrong("daemon", str(error), required, what_to_do(condition))


def _absence(session: zenoh.Session, cell: str) -> Condition:
    """The condition of a cell that does not answer, by the daemons that are alive."""
    cells = {
        str(reply.ok.key_expr).split("/daemon/")[0]
        for reply in session.liveliness().get("**/daemon/*", timeout=CONNECT_TIMEOUT_S)
        if reply.ok is not None
    }
    if cell in cells:
        return Condition.NO_ANSWER
    return Condition.OTHER_CELL if cells else Condition.NO_DAEMON


class Travel:
    """Commanded and measured positions of an arm's joints while they are watched."""

    def __init__(self) -> None:
        self._commanded: dict[str, Series] = {}  # of each joint
        self._measured: dict[str, Series] = {}

    @contextlib.contextmanager
    def watching(self, session: zenoh.Session, cell: str) -> Iterator[None]:
        """Watch a cell's arm while the context lasts."""
        commands = functools.partial(self._take, self._commanded)
        states = functools.partial(self._take, self._measured)
        with (
            session.declare_subscriber(key(cell, "joints/command"), commands),
            session.declare_subscriber(key(cell, "joints/state"), states),
        ):
            yield

    def of_joints(self) -> dict[str, tuple[float, float]]:
        """Commanded and measured travel of each joint [rad]."""
        return {
            name: (_span(commanded), _span(measured))
            for name, commanded in self._commanded.copy().items()
            if (measured := self._measured.get(name)) is not None
        }

    def lag_ms(self) -> float | None:
        """The measured lag of the arm behind its commands; None if it followed no motion."""
        # numpy is slow to import, and most findings need none
        from thirdhand.cli.arm_lag import lag

        commanded, measured = (
            {name: list(series) for name, series in joints.copy().items()}
            for joints in (self._commanded, self._measured)
        )
        estimate = lag(commanded, measured)
        return None if estimate is None else 1000 * estimate.lag_s

    @staticmethod
    def _take(joints: dict[str, Series], sample: zenoh.Sample) -> None:
        at_s = time.monotonic()
        with contextlib.suppress(WireError):
            message = cdr.decode_joints(sample.payload.to_bytes())
            for name, position in zip(message.names, message.position, strict=False):
                if math.isfinite(position):
                    joints.setdefault(name, deque(maxlen=MAX_SERIES)).append((at_s, position))


def _span(series: Series) -> float:
    positions = [position for _, position in series.copy()]
    return max(positions) - min(positions)


def unreachable(endpoint: str, error_text: str) -> Finding:
    """The reason why no session with an endpoint can be opened."""
    expected = f"a daemon that listens on {endpoint}"
    if (address := tcp_address(endpoint)) is None:
        return wrong("port", error_text, expected, what_to_do(Condition.PORT_CLOSED))
    host, port = address
    try:
        socket.create_connection(address, timeout=PROBE_S).close()
    except ConnectionRefusedError:
        return wrong(
            "port",
            f"nothing listens on {host} port {port}",
            expected,
            what_to_do(Condition.PORT_CLOSED),
        )
    except (OSError, OverflowError) as error:
        actual = f"{host} port {port} cannot be reached: {in_words(error)}"
        return wrong("port", actual, expected, what_to_do(Condition.NO_WAY))
    actual = f"something listens on {host} port {port}, but opens no Zenoh session"
    return wrong("port", actual, expected, what_to_do(Condition.PORT_FOREIGN))
