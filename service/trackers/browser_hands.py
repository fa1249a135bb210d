"""The websocket by which a page sends hands, and receives what the cell does.

A page sends messages of hands and pings as bytes (`hand_message`), and orders as text, `hold`,
`resume` or `reset`. It receives pongs as bytes, and as text ten times a second the status and the
objects on the bench (`{"status": ..., "objects": ...}`), and the answers to its orders
(`{"answer": ..., "done": ...}`). What is wrong closes the page's own websocket with a reason, and
no other one.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import re
import time
from collections.abc import Callable

from aiohttp import WSMsgType, web

from service.client import Client, Tracker
from service.contract.incidents import ORDERS
from service.contract.messages import WireError
from service.trackers import web_server
from service.trackers.cell_view import Latest, carried_out, corrected
from service.trackers.hand_message import PageHands, decode_hands, is_ping, pong
from service.trackers.pinch import Pinches

MAX_PAGES = 8  # pages that are open at once: headset, phone, screens beside the bench
MAX_PAGE_MESSAGE_BYTES = 256
PAGE_SILENCE_S = 10.0  # a page that sends nothing for this long is disconnected: it pings five times a second
OWNER_S = 1.0  # after this time without hands of a page, another page may send hands
MAX_HELD_UP_S = 0.5  # hands that were held up for longer are dropped: they show where a hand was
PAGE_STATUS_S = 0.1  # interval of the status
CORRECTION = re.compile(r"correct (undo|(?:-?\d{1,2}(?:\.\d{1,6})?(?: |$)){3})")
FULL = f"There are {MAX_PAGES} pages open already: close one of them."
TAKEN = "Hands of another page are followed: end it there first, then start here."
NO_TOKEN = "Open the address that `thirdhand hands` printed: with its token."
SILENT = f"This page has sent nothing for {PAGE_SILENCE_S:g} s."


class BrowserHands:
    """Publishes the hands of pages: of one page at a time, the first that sends hands.

    The poses are published in a frame named `frame`; where a page's frame has moved, the name ends
    in the number of its epoch, so that a daemon that knows the first one refuses them.
    """

    def __init__(
        self,
        tracker: Tracker,
        client: Client,
        latest: Latest,
        *,
        frame: str,
        has_token: Callable[[str], bool],
        pinches: Pinches | None = None,
    ) -> None:
        self._tracker, self._client, self._latest, self._frame = tracker, client, latest, frame
        self._has_token, self._pinches = has_token, pinches
        self._pages: set[web.WebSocketResponse] = set()
        self._owner: web.WebSocketResponse | None = None
        self._owned_s = 0.0
        self.published = self.lost = self.delayed = 0  # messages of hands: published, missing between others, dropped
        self._number: int | None = None

    async def socket(self, request: web.Request) -> web.StreamResponse:
        """Serve a page until it leaves, or is refused."""
        if not self._has_token(request.query.get("token", "")):
            return await web_server.refused(request, 403, NO_TOKEN)
        if len(self._pages) >= MAX_PAGES:
            return await web_server.refused(request, 429, FULL)
        page = web.WebSocketResponse(max_msg_size=MAX_PAGE_MESSAGE_BYTES, compress=False, timeout=1.0)
        if not page.can_prepare(request).ok:
            return web_server.answer(426, "A websocket is needed here.")
        self._pages.add(page)
        orders: set[asyncio.Task[None]] = set()
        try:
            await page.prepare(request)
            telling = asyncio.create_task(self._tell(page, request.transport))
            try:
                await self._receive(page, orders)
            finally:
                telling.cancel()
        finally:
            self._pages.discard(page)
            if self._owner is page:
                self._owner = None
        return page

    async def _receive(self, page: web.WebSocketResponse, orders: set[asyncio.Task[None]]) -> None:
        while True:
            try:
                message = await page.receive(PAGE_SILENCE_S)
            except TimeoutError:
                return await web_server.close(page, 408, SILENT)
            if message.type == WSMsgType.BINARY:
                data: bytes = message.data
                if is_ping(data):
                    await page.send_bytes(pong(data, time.time_ns()))
                    continue
                try:
                    hands = decode_hands(data, time.time_ns())
                except WireError as error:
                    return await web_server.close(page, 400, f"Refused: {error}")
                if not self._publish(page, hands):
                    return await web_server.close(page, 409, TAKEN)
            elif message.type == WSMsgType.TEXT:
                if message.data not in ORDERS and not CORRECTION.fullmatch(message.data):
                    needed = f"{' or '.join(ORDERS)}, or correct with undo or three numbers,"
                    return await web_server.close(page, 400, f"Refused: {needed} needed as text")
                if not orders:  # a page waits for the answer to its last order
                    orders.add(order := asyncio.create_task(self._order(page, message.data)))
                    order.add_done_callback(orders.discard)
            else:
                return None  # it left, or sent what is no message, for which aiohttp has closed it

    def _publish(self, page: web.WebSocketResponse, hands: PageHands) -> bool:
        """Publish a page's hands; False if those of another page are followed."""
        now_s = time.monotonic()
        if self._owner is not page:
            if self._owner is not None and now_s - self._owned_s < OWNER_S:
                return False
            self._owner, self._number = page, None
        if self._number is not None:
            self.lost += (hands.number - self._number - 1) & 0xFFFF
        self._number, self._owned_s = hands.number, now_s
        if time.time_ns() - hands.stamp_ns > 1e9 * MAX_HELD_UP_S:
            self.delayed += 1
            return True
        frame_id = f"{self._frame}{hands.epoch or ''}"
        for hand in hands.hands:
            self._tracker.publish(
                hand.side, hand.position, hand.orientation, stamp_ns=hands.stamp_ns, frame_id=frame_id
            )
        if self._pinches is not None:
            self._pinches.publish({hand.side: hand.pinch_m for hand in hands.hands}, hands.stamp_ns)
        self.published += 1
        return True

    async def _tell(self, page: web.WebSocketResponse, transport: asyncio.Transport | None) -> None:
        """Send the status until the page leaves. A page that does not read it is disconnected."""
        with contextlib.suppress(ConnectionError):
            while True:
                status = json.dumps({"status": self._latest.summary(), "objects": self._latest.objects()})
                try:
                    async with asyncio.timeout(web_server.FROZEN_S):
                        await page.send_str(status)
                except TimeoutError:
                    if transport is not None:
                        transport.abort()
                    return
                await asyncio.sleep(PAGE_STATUS_S)

    async def _order(self, page: web.WebSocketResponse, order: str) -> None:
        """Carry out an order or a correction, even if the page disconnects meanwhile."""
        found = CORRECTION.fullmatch(order)
        work, given = (corrected, found[1]) if found else (carried_out, order)
        is_done, text = await asyncio.to_thread(work, self._client, given)
        with contextlib.suppress(ConnectionError):
            await page.send_str(json.dumps({"answer": text, "done": is_done}))
