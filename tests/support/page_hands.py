"""Messages of hands as a page sends them, and a page's server in the test's event loop."""

from __future__ import annotations

import asyncio
import contextlib
import os
import signal
import time
from collections.abc import AsyncIterator, Iterator
from typing import Any

import zenoh

from thirdhand.client import Client, Tracker, endpoints, open_session
from thirdhand.contract.cdr import decode_pose
from thirdhand.contract.messages import PoseStamped
from thirdhand.workbench.trackers.address import Address
from thirdhand.workbench.trackers.cell_view import Latest
from thirdhand.workbench.trackers.hand_message import HANDS_LAYOUT, HANDS_MAGIC
from thirdhand.workbench.trackers.hands_page import HeadsetPage

PALM = (0.1, 1.0, -0.4, 0.0, 0.0, 0.6, 0.8, 0.12, 1.02, -0.5, 0.03, 0.0)


def hands_message(**given: Any) -> bytes:
    """A message of both hands with the present time, unless other values are given."""
    values = {
        "magic": HANDS_MAGIC,
        "seen": 3,
        "epoch": 0,
        "number": 0,
        "ahead_ms": 0.0,
        "left": PALM,
        "right": PALM,
    }
    values |= {"at_ms": time.time_ns() / 1e6, **given}
    order = ("magic", "seen", "epoch", "number", "at_ms", "ahead_ms")
    return HANDS_LAYOUT.pack(*(values[name] for name in order), *values["left"], *values["right"])


class Heard:
    """The poses of hands that a subscriber with its own session receives."""

    def __init__(self, session: zenoh.Session, cell: str = "thirdhand") -> None:
        self.poses: dict[str, list[PoseStamped]] = {"left": [], "right": []}
        self.arrived_ns: dict[str, list[int]] = {"left": [], "right": []}
        self._subscriber = session.declare_subscriber(f"{cell}/hands/*", self._take)

    def _take(self, sample: zenoh.Sample) -> None:
        side = str(sample.key_expr).rpartition("/")[2]
        self.arrived_ns[side].append(time.time_ns())
        self.poses[side].append(decode_pose(sample.payload.to_bytes()))

    async def until(self, side: str, count: int, within_s: float = 10.0) -> list[PoseStamped]:
        """The poses of a hand, once this number has arrived."""
        async with asyncio.timeout(within_s):
            while len(self.poses[side]) < count:
                await asyncio.sleep(0.005)
        return self.poses[side]


@contextlib.contextmanager
def page_of_hands(**more: Any) -> Iterator[tuple[HeadsetPage, Heard]]:
    """A page and a subscriber of its hands, without a daemon."""
    with (
        open_session(listen=["tcp/127.0.0.1:0"]) as hearing,
        open_session(connect=[endpoints(hearing)[0]]) as session,
    ):
        heard = Heard(hearing)
        with Tracker(session) as tracker:
            client = Client(session, timeout_s=1.0)
            yield (
                HeadsetPage(
                    tracker, client, Latest(session, "thirdhand"), **({"cell": "thirdhand"} | more)
                ),
                heard,
            )


@contextlib.asynccontextmanager
async def serving_page(page: HeadsetPage, host: str = "127.0.0.1") -> AsyncIterator[str]:
    """Host and port of a page that is served during the context, ended by SIGTERM."""
    listening: asyncio.Future[Address] = asyncio.get_running_loop().create_future()
    handlers = {number: signal.getsignal(number) for number in (signal.SIGTERM, signal.SIGHUP)}
    server = asyncio.create_task(page.server.serve(Address(host, 0), listening.set_result))
    try:
        yield str(await listening)
        os.kill(os.getpid(), signal.SIGTERM)
        await asyncio.wait_for(server, 10)
    finally:
        server.cancel()
        for number, handler in handlers.items():
            signal.signal(number, handler)
