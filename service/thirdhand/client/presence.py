"""The daemons on a network, found by their liveliness tokens, with their statuses; and the keys on
which anything is published.
"""

from __future__ import annotations

import contextlib
from contextlib import AbstractContextManager
from typing import NamedTuple

import zenoh

from thirdhand.client.replies import decoded
from thirdhand.client.session import RefusedError, subscribed
from thirdhand.contract import channels
from thirdhand.contract.printable import printable
from thirdhand.contract.requests import Status

PRESENCE_TIMEOUT_S = 5.0
MAX_KEYS = 1000  # `Overheard` remembers at most this many


class Cell(NamedTuple):
    """A cell that a daemon serves: its name, the daemon's Zenoh session, and its status, which is
    None if the daemon does not answer in time, or denies access.
    """

    name: str
    session: str
    status: Status | None


def is_connected(session: zenoh.Session) -> bool:
    """True while a session has a connection to another one."""
    return bool(session.info.transports())


def living(
    session: zenoh.Session, cell: str, *, timeout_s: float = PRESENCE_TIMEOUT_S
) -> frozenset[str]:
    """The ids of the Zenoh sessions of the daemons that serve a cell."""
    return frozenset(
        session_id for _, session_id in _tokens(session, channels.presence(cell), timeout_s)
    )


def why_silent(session: zenoh.Session, cell: str) -> str:
    """A message with the likely reasons for a cell's silence."""
    if not is_connected(session):
        return (
            "this program is not connected to a daemon or router; it restores a lost connection by "
            "itself"
        )
    served = {name for name, _ in _tokens(session, channels.PRESENCE_OF_ALL, PRESENCE_TIMEOUT_S)}
    if cell in served:
        return (
            "its daemon is alive, but it is starting or ending, too busy, denies access, or is "
            "reached through another cell's daemon, which forwards no streams: try again, or "
            "connect to it directly"
        )
    if served:
        return f"only daemons of other cells run there: {', '.join(map(printable, sorted(served)))}"
    return "is the daemon running there, and is the cell's name right?"


def cells(session: zenoh.Session, *, timeout_s: float = PRESENCE_TIMEOUT_S) -> tuple[Cell, ...]:
    """All cells that are served on a network, sorted by name; queried in parallel."""
    tokens = sorted(_tokens(session, channels.PRESENCE_OF_ALL, timeout_s))
    queries = [
        session.get(
            channels.key(name, "status"),
            payload=b"{}",
            target=zenoh.QueryTarget.ALL,
            consolidation=zenoh.ConsolidationMode.NONE,
            timeout=timeout_s,
        )
        for name in dict(tokens)
    ]
    statuses: dict[str, Status] = {}
    for replies in queries:
        for reply in replies:
            if reply.ok is not None and reply.replier_id is not None:
                with contextlib.suppress(RefusedError):
                    statuses[str(reply.replier_id.zid)] = decoded(
                        reply.ok.payload.to_bytes(), Status
                    )
    return tuple(
        Cell(printable(name), session_id, statuses.get(session_id)) for name, session_id in tokens
    )


class Overheard(AbstractContextManager["Overheard"]):
    """The keys on which something is published, of those that match some expressions; a context
    manager.
    """

    def __init__(self, session: zenoh.Session, *expressions: str) -> None:
        self._keys: set[str] = set()
        self._subscribers = [
            subscribed(session, expression, self._take) for expression in expressions
        ]

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def keys(self) -> list[str]:
        """The collected keys, sorted."""
        return sorted(self._keys.copy())

    def close(self) -> None:
        """End the subscriptions."""
        for subscriber in self._subscribers:
            subscriber.undeclare()  # type: ignore[no-untyped-call]
        self._subscribers = []

    def _take(self, sample: zenoh.Sample) -> None:
        if len(self._keys) < MAX_KEYS:
            self._keys.add(printable(str(sample.key_expr)))


def _tokens(session: zenoh.Session, key: str, timeout_s: float) -> set[tuple[str, str]]:
    """The cell and the Zenoh session of each token under a key."""
    tokens = (
        str(reply.ok.key_expr)
        for reply in session.liveliness().get(key, timeout=timeout_s)
        if reply.ok
    )
    # some arrive twice
    return {(token.rsplit("/", 2)[0], token.rsplit("/", 1)[1]) for token in tokens}
