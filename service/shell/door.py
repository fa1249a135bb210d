"""Who and what gets in to a daemon: bounds on what may come from the network, and one daemon to a
cell.
"""

from __future__ import annotations

import contextlib
import resource
from typing import Any

import zenoh

from service.client import Client, RefusedError, UnreachableError
from service.contract import channels
from service.contract.explain import ExplainedError

MOST_SESSIONS = 64
MOST_DESCRIPTORS = 65536
MOST_HANDSHAKES = 16  # at once: those given up are closed together, and that holds up the others
HANDSHAKE_TIMEOUT_MS = 2000
ENVELOPE = 1024  # bytes of key, attachment and Zenoh's own around the largest request
NEIGHBOURS_TIMEOUT_S = 5.0

BOUNDS: dict[str, Any] = {
    "transport/unicast/max_sessions": MOST_SESSIONS,
    "transport/unicast/accept_pending": MOST_HANDSHAKES,
    "transport/unicast/accept_timeout": HANDSHAKE_TIMEOUT_MS,
    "transport/link/rx/max_message_size": channels.LARGEST_REQUEST + ENVELOPE,
}


class OccupiedError(ExplainedError, RuntimeError):
    """A cell that another daemon serves already."""


def allow_descriptors() -> None:
    """Lets this process have as many files and connections open as the system allows, so that a
    burst of connections does not use them up.
    """
    _, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    wanted = MOST_DESCRIPTORS if hard == resource.RLIM_INFINITY else min(hard, MOST_DESCRIPTORS)
    with contextlib.suppress(OSError, ValueError):
        resource.setrlimit(resource.RLIMIT_NOFILE, (wanted, hard))


def occupy(session: zenoh.Session, cell: str) -> zenoh.LivelinessToken:
    """The token that says that this session's daemon serves the cell, while it is held.

    Raises OccupiedError where another one on this network does; of two that start at once, both may
    be refused.
    """
    own = channels.key(cell, f"daemon/{session.zid()}")
    token = session.liveliness().declare_token(own)
    others = [
        str(reply.ok.key_expr)
        for reply in session.liveliness().get(channels.key(cell, "daemon/*"), timeout=NEIGHBOURS_TIMEOUT_S)
        if reply.ok is not None and str(reply.ok.key_expr) != own
    ]
    if not others:
        return token
    token.undeclare()  # type: ignore[no-untyped-call]
    which = f"Zenoh session {others[0].rsplit('/', 1)[1]}"
    with contextlib.suppress(UnreachableError, RefusedError):
        found = Client(session, cell, timeout_s=2.0).status()
        which += f", version {found['version']}, listening on {', '.join(found['endpoints']) or 'nothing'}"
    raise OccupiedError(f"cell {cell} is served already ({which}): stop that daemon, or give this one another --cell")
