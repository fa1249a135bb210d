"""The websocket by which a page sends hands, and receives the cell's status.

A page sends messages of hands and pings as bytes (`hand_message`), and orders as text: `hold`,
`resume` or `reset` of its buttons, `hold by hands` or `resume by hands` of a sign. A resume by
hands ends a hold by hands alone: the daemon refuses it while anybody else holds the arm. A page
receives pongs as bytes, and as text ten times a second the status and the objects on the bench
(`{"status": ..., "objects": ...}`), and the answers to its orders (`{"order": ..., "answer": ...,
"done": ...}`). A message that is wrong closes the page's own websocket with a reason, and no other
one.
"""

from __future__ import annotations

import asyncio
import contextlib
import functools
import json
import re
import secrets
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

from aiohttp import WSMsgType, web

from thirdhand.client import Client, Tracker
from thirdhand.contract.incidents import ORDERS
from thirdhand.contract.messages import WireError
from thirdhand.workbench.trackers import web_server
from thirdhand.workbench.trackers.cell_view import Latest, carried_out, corrected
from thirdhand.workbench.trackers.hand_message import PageHands, decode_hands, is_ping, pong
from thirdhand.workbench.trackers.lead import Lead
from thirdhand.workbench.trackers.pinch import Pinches

MAX_PAGES = 8  # pages that are open at once: headset, phone, screens beside the bench
# a page that sends nothing for this long is disconnected: it pings five times a second
PAGE_SILENCE_S = 10.0
OWNER_S = 1.0  # after this time without hands of a page, another page may send hands
MAX_HELD_UP_S = 0.5  # hands with a longer delay are dropped, as they show a past position
MAX_PINCH_GAP_S = 0.3  # a pinch that was not seen for longer has ended
PAGE_STATUS_S = 0.1  # interval of the status
BY_HANDS = {f"{order} by hands": order for order in ("hold", "resume")}
CORRECTION = re.compile(r"correct (undo|(?:-?\d{1,2}(?:\.\d{1,6})?(?: |$)){3})")
FULL = f"There are {MAX_PAGES} pages open already: close one of them."
TAKEN = "Hands of another page are followed: end it there first, then start here."
NOT_FOLLOWED = "resume was NOT carried out: the hands of this page are not followed."
NO_TOKEN = "Open the address that `thirdhand hands` printed: with its token."
Refusal = tuple[int, str]  # status of HTTP and reason with which a websocket is closed
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
        lead: Lead | None = None,
    ) -> None:
        self._tracker = tracker
        self._client = client
        self._latest = latest
        self._frame = frame
        self._has_token = has_token
        self._pinches = pinches
        self._lead = lead
        self._name = f"hands {secrets.token_hex(4)}"  # name of the person who holds by a sign
        self._pages: set[web.WebSocketResponse] = set()
        self._owner: web.WebSocketResponse | None = None
        self._owned_s = 0.0
        # messages of hands: published, missing between others, dropped
        self.published = self.lost = self.delayed = 0
        self._number: int | None = None
        # each page may wait for two orders; the hold of one must not wait for those of others
        self._ordering = ThreadPoolExecutor(2 * MAX_PAGES, thread_name_prefix="order")

    async def socket(self, request: web.Request) -> web.StreamResponse:
        """Serve a page until it leaves, or is refused."""
        if not self._has_token(request.query.get("token", "")):
            return await web_server.refused(request, 403, NO_TOKEN)
        if len(self._pages) >= MAX_PAGES:
            return await web_server.refused(request, 429, FULL)
        page = web_server.page_socket()
        if not page.can_prepare(request).ok:
            return web_server.answer(426, "A websocket is needed here.")
        self._pages.add(page)
        try:
            await page.prepare(request)
            telling = asyncio.create_task(self._tell(page))
            try:
                await self._receive(page)
            finally:
                telling.cancel()
        finally:
            self._pages.discard(page)
            if self._owner is page:
                self._owner = None
                self._release()
        return page

    async def _receive(self, page: web.WebSocketResponse) -> None:
        """Take in messages until the page leaves. While an order waits for its answer, others are
        ignored, except for a hold.
        """
        orders: dict[str, asyncio.Task[None]] = {}
        while True:
            try:
                message = await page.receive(PAGE_SILENCE_S)
            except TimeoutError:
                return await web_server.close(page, 408, SILENT)
            if message.type == WSMsgType.BINARY:
                refusal = await self._take_bytes(page, message.data)
            elif message.type == WSMsgType.TEXT:
                refusal = self._take_order(page, message.data, orders)
            else:
                return None  # it left, or aiohttp closed it for invalid data
            if refusal is not None:
                return await web_server.close(page, *refusal)

    async def _take_bytes(self, page: web.WebSocketResponse, data: bytes) -> Refusal | None:
        """Answer a ping, or publish hands; the refusal of others."""
        if is_ping(data):
            await page.send_bytes(pong(data, time.time_ns()))
            return None
        try:
            hands = decode_hands(data, time.time_ns())
        except WireError as error:
            return 400, f"Refused: {error}"
        return None if self._publish(page, hands) else (409, TAKEN)

    def _take_order(
        self, page: web.WebSocketResponse, order: str, orders: dict[str, asyncio.Task[None]]
    ) -> Refusal | None:
        """Begin an order, unless others of the page wait for their answers; the refusal of another
        text.
        """
        is_order = order in ORDERS or order in BY_HANDS
        if not is_order and not CORRECTION.fullmatch(order):
            needed = f"{' or '.join(ORDERS)}, or correct with undo or three numbers,"
            return 400, f"Refused: {needed} needed as text"
        for name in [name for name, task in orders.items() if task.done()]:
            del orders[name]
        is_new_hold = order.startswith("hold") and order not in orders
        if not orders or is_new_hold:
            orders[order] = asyncio.create_task(self._order(page, order))
        return None

    def _publish(self, page: web.WebSocketResponse, hands: PageHands) -> bool:
        """Publish a page's hands; False if those of another page are followed."""
        now_s = time.monotonic()
        if self._owner is not page:
            if self._owner is not None and now_s - self._owned_s < OWNER_S:
                return False
            self._owner = page
            self._number = None
            self._release()
        if self._number is not None:
            self.lost += (hands.number - self._number - 1) & 0xFFFF
        if now_s - self._owned_s > MAX_PINCH_GAP_S:
            self._release()
        self._number = hands.number
        self._owned_s = now_s
        if time.time_ns() - hands.stamp_ns > 1e9 * MAX_HELD_UP_S:
            self.delayed += 1
            return True
        frame_id = f"{self._frame}{hands.epoch or ''}"
        for hand in hands.hands:
            if self._lead is not None and hand.side == self._lead.side:
                self._lead.follow(hand, frame_id, hands.stamp_ns)
                continue
            self._tracker.publish(
                hand.side,
                hand.position,
                hand.orientation,
                stamp_ns=hands.stamp_ns,
                frame_id=frame_id,
            )
        if self._pinches is not None:
            self._pinches.publish({hand.side: hand.pinch_m for hand in hands.hands}, hands.stamp_ns)
        self.published += 1
        return True

    def _release(self) -> None:
        """End a pinch: a pinch of another page, or from before a pause, does not press the
        clutch.
        """
        if self._pinches is not None:
            self._pinches.release()
        if self._lead is not None:
            self._lead.release()

    async def _tell(self, page: web.WebSocketResponse) -> None:
        """Send the status until the page leaves. A page that does not read it is disconnected."""
        with contextlib.suppress(ConnectionError):
            while True:
                await page.send_str(
                    json.dumps(
                        {"status": self._latest.summary(), "objects": self._latest.objects()}
                    )
                )
                await asyncio.sleep(PAGE_STATUS_S)

    async def _order(self, page: web.WebSocketResponse, order: str) -> None:
        """Carry out an order or a correction, even if the page disconnects meanwhile."""
        if order == "resume by hands" and self._owner is not page:
            is_done = False
            text = NOT_FOLLOWED
        else:
            name = self._name if order in BY_HANDS else ""
            carry_out = functools.partial(
                carried_out, self._client, BY_HANDS.get(order, order), by=name
            )
            if match := CORRECTION.fullmatch(order):
                carry_out = functools.partial(corrected, self._client, match[1])
            is_done, text = await asyncio.get_running_loop().run_in_executor(
                self._ordering, carry_out
            )
        with contextlib.suppress(ConnectionError):
            await page.send_str(json.dumps({"order": order, "answer": text, "done": is_done}))
