"""Who and what gets in to a daemon: bounds on what may come from the network, and one daemon to a
cell.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import json
import logging
import os
import resource
import stat
from collections.abc import Iterable
from pathlib import Path
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


log = logging.getLogger("thirdhand")


MOST_TOLD = 4096  # bytes that are read of what a lock's holder says


class OccupiedError(ExplainedError, RuntimeError):
    """A cell that another daemon serves already."""


class Lock:
    """The right to serve a cell with a folder of its own state.

    One daemon at a time has it, also of two that do not see each other by Zenoh. The system takes
    it back however the process ends.

    Raises OccupiedError where another has it, with what that one told of itself.
    """

    def __init__(self, folder: Path, cell: str) -> None:
        path = folder / "daemon.lock"
        self._descriptor: int | None = None
        try:
            folder.mkdir(mode=0o700, parents=True, exist_ok=True)
            flags = os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK
            self._descriptor = os.open(path, flags, 0o600)
            if not stat.S_ISREG(os.fstat(self._descriptor).st_mode):
                raise OSError(errno.EINVAL, "no regular file")
            fcntl.flock(self._descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            which = _told(self._descriptor)
            self.close()
            raise OccupiedError(
                f"cell {cell} is served already on this machine ({which}; {path} is locked): stop that daemon, or give "
                "this one another --cell, or [files] state"
            ) from None
        except OSError as error:
            log.warning("%s: %s; a second daemon of this cell is only noticed by Zenoh", path, error.strerror)
            self.close()
        else:
            self.tell(())

    def tell(self, endpoints: Iterable[str]) -> None:
        """Where this process listens, for those who are refused."""
        if self._descriptor is not None:
            said = json.dumps({"pid": os.getpid(), "endpoints": list(endpoints)}).encode()
            with contextlib.suppress(OSError):
                os.ftruncate(self._descriptor, 0)
                os.pwrite(self._descriptor, said, 0)

    def close(self) -> None:
        """Gives it back."""
        if self._descriptor is not None:
            os.close(self._descriptor)
            self._descriptor = None


def _told(descriptor: int | None) -> str:
    """What the holder of a lock says of itself."""
    with contextlib.suppress(OSError, ValueError, KeyError, TypeError):
        said = json.loads(os.pread(descriptor, MOST_TOLD, 0))  # type: ignore[arg-type]
        where = f"listening on {', '.join(said['endpoints'])}" if said["endpoints"] else "not listening, or not yet"
        return f"process {said['pid']}, {where}"
    return "a process that did not say which"


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
    own = channels.presence(cell, str(session.zid()))
    token = session.liveliness().declare_token(own)
    others = [
        str(reply.ok.key_expr)
        for reply in session.liveliness().get(channels.presence(cell), timeout=NEIGHBOURS_TIMEOUT_S)
        if reply.ok is not None and str(reply.ok.key_expr) != own
    ]
    if not others:
        return token
    token.undeclare()  # type: ignore[no-untyped-call]
    which = f"Zenoh session {others[0].rsplit('/', 1)[1]}"
    with contextlib.suppress(UnreachableError, RefusedError):
        found = Client(session, cell, timeout_s=2.0).status()
        which += f", version {found.version}, listening on {', '.join(found.endpoints) or 'nothing'}"
    raise OccupiedError(f"cell {cell} is served already ({which}): stop that daemon, or give this one another --cell")
