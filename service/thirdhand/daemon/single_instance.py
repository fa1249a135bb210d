"""The lock by which a cell has one daemon, and the bounds on its network connections."""

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

from thirdhand.client import Client, RefusedError, UnreachableError
from thirdhand.client.presence import living
from thirdhand.contract import channels
from thirdhand.contract.explain import ExplainedError
from thirdhand.settings.config import Settings
from thirdhand.settings.file_content import content
from thirdhand.settings.user_folder import HomelessError, user_folder

MAX_SESSIONS = 64
# with fewer, Zenoh ends while the daemon runs on, deaf
LEAST_DESCRIPTORS = 256
MAX_DESCRIPTORS = 65536
# pending handshakes: those that time out are closed together, which delays others
MAX_HANDSHAKES = 16
HANDSHAKE_TIMEOUT_MS = 2000
ENVELOPE_BYTES = 1024  # key, attachment and Zenoh's headers around the largest request

NETWORK_BOUNDS: dict[str, Any] = {
    "transport/unicast/max_sessions": MAX_SESSIONS,
    "transport/unicast/accept_pending": MAX_HANDSHAKES,
    "transport/unicast/accept_timeout": HANDSHAKE_TIMEOUT_MS,
    "transport/link/rx/max_message_size": channels.LARGEST_REQUEST + ENVELOPE_BYTES,
    # A reply takes this from its query: it is dropped if the client does not read.
    "qos/network": [
        {
            "messages": ["query"],
            "key_exprs": ["**"],
            "flows": ["ingress"],
            "overwrite": {"congestion_control": "drop"},
        }
    ],
}
MAX_HOLDER_BYTES = 4096  # limit of what is read from a lock file
log = logging.getLogger("thirdhand")


def state_folder(settings: Settings) -> Path:
    """The folder of the files that a cell keeps over a restart. Raises ExplainedError."""
    try:
        return (
            Path(settings.files.state) if settings.files.state else user_folder("state")
        ) / settings.cell
    except HomelessError as error:
        raise ExplainedError(f"no folder for the cell's state: {error}, or [files] state") from None


class OccupiedError(ExplainedError, RuntimeError):
    """Another daemon already serves the cell."""


class Lock:
    """The lock of a cell's state folder, which one daemon holds at a time, also if two daemons do
    not see each other through Zenoh. The operating system releases it at the end of the process.

    Raises OccupiedError if another process holds it; the message describes that process.
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
                f"cell {cell} is already served on this machine ({holder}; {path} is locked): stop "
                "that daemon, or give this one another --cell or [files] state"
            ) from None
        except OSError as error:
            log.warning(
                "%s: %s; a second daemon of this cell is only detected through Zenoh",
                path,
                error.strerror,
            )
            self.close()
        else:
            self.announce(())

    def announce(self, endpoints: Iterable[str]) -> None:
        """Write the endpoints of this process, for the error message of a second daemon."""
        if self._descriptor is not None:
            content = json.dumps({"pid": os.getpid(), "endpoints": list(endpoints)}).encode()
            with contextlib.suppress(OSError):
                os.ftruncate(self._descriptor, 0)
                os.pwrite(self._descriptor, content, 0)

    def close(self) -> None:
        """Release the lock."""
        if self._descriptor is not None:
            os.close(self._descriptor)
            self._descriptor = None


def holder_of(settings: Settings) -> tuple[int, frozenset[str]] | None:
    """The process that serves a cell, and its endpoints; None: none here, or another user's."""
    import psutil  # no start needs it

    path = state_folder(settings) / "daemon.lock"
    with contextlib.suppress(OSError, ValueError, KeyError, TypeError, psutil.Error):
        record = json.loads(content(path, MAX_HOLDER_BYTES))
        if any(file.path == str(path) for file in psutil.Process(int(record["pid"])).open_files()):
            return int(record["pid"]), frozenset(record["endpoints"])
    return None


def _holder(descriptor: int | None) -> str:
    """A description of the holder of a lock, from the lock file."""
    with contextlib.suppress(OSError, ValueError, KeyError, TypeError, RecursionError):
        record = json.loads(os.pread(descriptor, MAX_HOLDER_BYTES, 0))  # type: ignore[arg-type]
        where = (
            f"listening on {', '.join(record['endpoints'])}"
            if record["endpoints"]
            else "not listening, or not yet"
        )
        return f"process {record['pid']}, {where}"
    return "a process that did not write its number"


def allow_descriptors() -> int:
    """Raise the limit of open files, so that a burst of connections does not reach it, and return
    it. Raises ExplainedError for fewer than LEAST_DESCRIPTORS.
    """
    _, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    target = MAX_DESCRIPTORS if hard == resource.RLIM_INFINITY else min(hard, MAX_DESCRIPTORS)
    with contextlib.suppress(OSError, ValueError):
        resource.setrlimit(resource.RLIMIT_NOFILE, (target, hard))
    limit, _ = resource.getrlimit(resource.RLIMIT_NOFILE)
    if limit < LEAST_DESCRIPTORS:
        raise ExplainedError(
            f"this process may open {limit} files, {LEAST_DESCRIPTORS} or more needed: raise its "
            "limit with `ulimit -Hn`, or with LimitNOFILE= in the unit"
        )
    return limit


def occupy(session: zenoh.Session, cell: str) -> zenoh.LivelinessToken:
    """The liveliness token by which this session's daemon serves the cell.

    Raises OccupiedError if another daemon on this network serves it. If two daemons start at once,
    both may be refused.
    """
    session_id = str(session.zid())
    token = session.liveliness().declare_token(channels.presence(cell, session_id))
    others = living(session, cell) - {session_id}
    if not others:
        return token
    token.undeclare()  # type: ignore[no-untyped-call]
    holder = f"Zenoh session {min(others)}"
    with contextlib.suppress(UnreachableError, RefusedError):
        status = Client(session, cell, timeout_s=2.0).status()
        holder += (
            f", version {status.version}, listening on {', '.join(status.endpoints) or 'nothing'}"
        )
    raise OccupiedError(
        f"cell {cell} is already served ({holder}): stop that daemon, or give this one another "
        "--cell"
    )
