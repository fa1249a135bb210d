"""The address of a page that a command serves, from its option, and the serving until Ctrl-C."""

from __future__ import annotations

import asyncio
import os
from collections.abc import Callable

from service.cli.usage import UsageError
from service.trackers.web_server import Address, WebServer


def web_address(option: str, given: str) -> Address:
    """Host and port of `PORT` or `HOST:PORT`. Raises UsageError with the name of the option."""
    host, _, port = given.rpartition(":")
    if not port.isdecimal() or int(port) > 65535:
        raise UsageError(f"{option} {given}: PORT or HOST:PORT needed, like 8080 or 127.0.0.1:0")
    return Address(host.strip("[]") or "127.0.0.1", int(port))


def serve_page(server: WebServer, option: str, listen: Address, listening: Callable[[Address], object]) -> None:
    """Serve until SIGTERM or Ctrl-C; call `listening` with the address taken. Raises UsageError if
    it is not available.
    """
    try:
        asyncio.run(server.serve(listen, listening))
    except OSError as error:
        why = os.strerror(error.errno) if error.errno else error
        raise UsageError(f"{option} {listen}: {why}; another port, or 0 for any, needed") from None
