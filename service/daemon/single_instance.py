"""One daemon to a cell, and bounds on what it accepts from the network."""

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
from service.client.presence import living
from service.contract import channels
from service.contract.explain import ExplainedError
from service.settings.config import Settings

MOST_SESSIONS = 64
MOST_DESCRIPTORS = 65536
MOST_HANDSHAKES = 16  # at once: those that time out are closed together, which delays the others
HANDSHAKE_TIMEOUT_MS = 2000
ENVELOPE = 1024  # bytes of key, attachment and Zenoh's headers around the largest request

BOUNDS: dict[str, Any] = {
    "transport/unicast/max_sessions": MOST_SESSIONS,
    "transport/unicast/accept_pending": MOST_HANDSHAKES,
    "transport/unicast/accept_timeout": HANDSHAKE_TIMEOUT_MS,
    "transport/link/rx/max_message_size": channels.LARGEST_REQUEST + ENVELOPE,
    # an answer takes this from its query: to a client that does not read, it is dropped
    "qos/network": [
        {
            "messages": ["query"],
            "key_exprs": ["**"],
            "flows": ["ingress"],
            "overwrite": {"congestion_control": "drop"},
        }
    ],
}
MOST_READ = 4096  # bytes of what a lock's holder wrote
log = logging.getLogger("thirdhand")


def state_folder(settings: Settings) -> Path:
    """The folder of what a cell keeps over a restart."""
    return Path(settings.files.state).expanduser() / settings.cell


class OccupiedError(ExplainedError, RuntimeError):
    """Another daemon serves the cell already."""


class Lock:
    """The lock of a cell's state folder, held by one daemon at a time, also of two that do not see
    each other by Zenoh. The operating system releases it however the process ends.

    Raises OccupiedError where another process holds it, with what that one wrote of itself.
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
            holder = _holder(self._descriptor)
            self.close()
            raise OccupiedError(
                f"cell {cell} is served already on this machine ({holder}; {path} is locked): stop that daemon, or "
                "give this one another --cell, or [files] state"
            ) from None
        except OSError as error:
            log.warning("%s: %s; a second daemon of this cell is only noticed by Zenoh", path, error.strerror)
            self.close()
        else:
            self.announce(())

    def announce(self, endpoints: Iterable[str]) -> None:
        """Writes where this process listens, for the error of a second daemon."""
        if self._descriptor is not None:
            content = json.dumps({"pid": os.getpid(), "endpoints": list(endpoints)}).encode()
            with contextlib.suppress(OSError):
                os.ftruncate(self._descriptor, 0)
                os.pwrite(self._descriptor, content, 0)

    def close(self) -> None:
        """Releases it."""
        if self._descriptor is not None:
            os.close(self._descriptor)
            self._descriptor = None


def _holder(descriptor: int | None) -> str:
    """The holder of a lock, by what it wrote of itself."""
    with contextlib.suppress(OSError, ValueError, KeyError, TypeError, RecursionError):
        found = json.loads(os.pread(descriptor, MOST_READ, 0))  # type: ignore[arg-type]
        where = f"listening on {', '.join(found['endpoints'])}" if found["endpoints"] else "not listening, or not yet"
        return f"process {found['pid']}, {where}"
    return "a process that did not write its number"


def allow_descriptors() -> None:
    """Raises the limit of open files, so that a burst of connections does not reach it."""
    _, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    wanted = MOST_DESCRIPTORS if hard == resource.RLIM_INFINITY else min(hard, MOST_DESCRIPTORS)
    with contextlib.suppress(OSError, ValueError):
        resource.setrlimit(resource.RLIMIT_NOFILE, (wanted, hard))


def occupy(session: zenoh.Session, cell: str) -> zenoh.LivelinessToken:
    """The liveliness token by which this session's daemon serves the cell.

    Raises OccupiedError where another daemon on this network does. Of two that start at once, both
    may be refused.
    """
    own = str(session.zid())
    token = session.liveliness().declare_token(channels.presence(cell, own))
    others = living(session, cell) - {own}
    if not others:
        return token
    token.undeclare()  # type: ignore[no-untyped-call]
    holder = f"Zenoh session {min(others)}"
    with contextlib.suppress(UnreachableError, RefusedError):
        found = Client(session, cell, timeout_s=2.0).status()
        holder += f", version {found.version}, listening on {', '.join(found.endpoints) or 'nothing'}"
    raise OccupiedError(f"cell {cell} is served already ({holder}): stop that daemon, or give this one another --cell")
