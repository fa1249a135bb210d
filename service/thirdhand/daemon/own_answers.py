"""Supervision of the daemon's network: does the daemon answer a client on its own endpoint?"""

from __future__ import annotations

import contextlib
import logging
import math
import threading
import time

from thirdhand.client import Client, RefusedError, UnreachableError, open_session
from thirdhand.daemon.cell_state import CellState

log = logging.getLogger("thirdhand")
ASK_EVERY_S = 1.0
DEAF_AFTER_S = 5.0  # an answer is missing for this time: the network's threads hang


class OwnAnswers:
    """A client of this process that asks for the cell's status each second.

    Until its first answer nothing is concluded: certificates may admit no such client.
    """

    def __init__(self, cell: CellState) -> None:
        self._cell = cell
        self._answered_s = math.inf
        self._was_deaf = False
        self._ended = threading.Event()

    def ask(self) -> None:
        """Ask until `close`; for a thread of its own, if the cell has endpoints."""
        settings = self._cell.settings
        network = settings.network
        with (
            contextlib.suppress(UnreachableError),
            open_session(
                connect=self._cell.endpoints[:1],
                certificate=network.certificate,
                zenoh_config=network.zenoh_config,
            ) as session,
        ):
            client = Client(session, settings.cell, timeout_s=ASK_EVERY_S)
            while not self._ended.wait(ASK_EVERY_S):
                with contextlib.suppress(UnreachableError, RefusedError):
                    client.status()
                    self._answered_s = time.monotonic()

    def is_deaf(self) -> bool:
        """True if there was no answer for DEAF_AFTER_S, which the log reports once."""
        silent_s = time.monotonic() - self._answered_s
        is_deaf = silent_s > DEAF_AFTER_S
        if is_deaf and not self._was_deaf:
            log.error(
                "the daemon has not answered on its own endpoint %s for %.0f s",
                self._cell.endpoints[0],
                silent_s,
            )
        self._was_deaf = is_deaf
        return is_deaf

    def close(self) -> None:
        """End `ask`."""
        self._ended.set()
