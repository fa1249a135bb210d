"""The address of a page that a command serves, from its option; a server until Ctrl-C; and the
address of a live view.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import queue
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from typing import TYPE_CHECKING, Any

from thirdhand.cli.usage import UsageError
from thirdhand.process.progress import progress
from thirdhand.workbench.trackers.address import Address

if TYPE_CHECKING:
    from thirdhand.workbench.trackers.web_server import WebServer  # not all commands have aiohttp

STARTING_POLL_S = 0.2
END_TIMEOUT_S = 5.0  # a page's server ends within this time


def web_address(option: str, given: str) -> Address:
    """Host and port of `PORT` or `HOST:PORT`. Raises UsageError with the name of the option."""
    host, _, port = given.rpartition(":")
    if not port.isdecimal() or int(port) > 65535:
        raise UsageError(
            f"{option} {given}: PORT or HOST:PORT needed, like 8080 or 127.0.0.1:0, up to 65535"
        )
    return Address(host.strip("[]") or "127.0.0.1", int(port))


@contextlib.contextmanager
def page_served(server: WebServer, option: str, listen: Address) -> Iterator[Address]:
    """The address of a page that another thread serves while the context lasts. Raises UsageError
    if it is not available.
    """
    listening: queue.SimpleQueue[Address | UsageError] = queue.SimpleQueue()

    def serve() -> None:
        try:
            serve_page(server, option, listen, listening.put)
        except UsageError as error:
            listening.put(error)

    thread = threading.Thread(target=serve, name="page", daemon=True)
    thread.start()
    try:
        outcome = listening.get()
        if isinstance(outcome, UsageError):
            raise outcome
        yield outcome
    finally:
        server.end()
        thread.join(END_TIMEOUT_S)


def serve_page(
    server: WebServer, option: str, listen: Address, listening: Callable[[Address], object]
) -> None:
    """Serve until SIGTERM, Ctrl-C or the server's `end`; call `listening` with the address taken.

    Raises UsageError if it is not available.
    """
    try:
        asyncio.run(server.serve(listen, listening))
    except OSError as error:
        why = os.strerror(error.errno) if error.errno else error
        raise UsageError(f"{option} {listen}: {why}; another port, or 0 for any, needed") from None


def live_url(scribe: Callable[[], Mapping[str, Any]]) -> str:
    """The address of a live view, which is waited for while it starts; `scribe` is the part of the
    status. Raises UsageError for a daemon without one.
    """
    scribe_status = scribe()
    with progress("the live view is starting"):
        while scribe_status.get("live") == "":
            time.sleep(STARTING_POLL_S)
            scribe_status = scribe()
    if url := scribe_status.get("live"):
        return str(url)
    errors = "; ".join(error for error in scribe_status["errors"] if "live view" in error)
    raise UsageError(errors or "this daemon serves no live view; start it with --live PORT")
