"""Which daemons are there, by the liveliness token that each holds, and what each says."""

from __future__ import annotations

from typing import NamedTuple

import msgspec
import zenoh

from service.contract import channels
from service.contract.requests import Status

TIMEOUT_S = 5.0


class Cell(NamedTuple):
    """A cell that a daemon serves: its name, that daemon's Zenoh session, and its status.

    The status is None where the daemon does not answer in time, or may not be asked.
    """

    name: str
    session: str
    status: Status | None


def living(session: zenoh.Session, cell: str, *, timeout_s: float = TIMEOUT_S) -> frozenset[str]:
    """The Zenoh sessions of the daemons that serve a cell."""
    return frozenset(own for _, own in _tokens(session, channels.presence(cell), timeout_s))


def cells(session: zenoh.Session, *, timeout_s: float = TIMEOUT_S) -> tuple[Cell, ...]:
    """All cells that are served on a network, by name; their daemons are asked at the same time."""
    found = sorted(_tokens(session, channels.PRESENCE_OF_ALL, timeout_s))
    asked = [
        session.get(
            channels.key(name, "status"),
            payload=b"{}",
            target=zenoh.QueryTarget.ALL,
            consolidation=zenoh.ConsolidationMode.NONE,
            timeout=timeout_s,
        )
        for name in dict(found)
    ]
    told: dict[str, Status] = {}
    for replies in asked:
        for reply in replies:
            if reply.ok is not None and reply.replier_id is not None:
                told[str(reply.replier_id.zid)] = msgspec.json.decode(reply.ok.payload.to_bytes(), type=Status)
    return tuple(Cell(name, own, told.get(own)) for name, own in found)


def _tokens(session: zenoh.Session, key: str, timeout_s: float) -> set[tuple[str, str]]:
    """Cell and Zenoh session of each token under a key."""
    tokens = (str(reply.ok.key_expr) for reply in session.liveliness().get(key, timeout=timeout_s) if reply.ok)
    return {(token.rsplit("/", 2)[0], token.rsplit("/", 1)[1]) for token in tokens}  # some come twice
