"""The web server of the service's pages: refusals are answered, and orders do not wait for each
other.
"""

from __future__ import annotations

import asyncio
import html
import os
import re
import threading
from pathlib import Path
from typing import Any

import aiohttp
import pytest
import zenoh

from support.page_hands import PALM, hands_message, page_of_hands, serving_page
from thirdhand.client import Client, endpoints, open_session
from thirdhand.contract import cdr
from thirdhand.workbench.trackers import browser_hands, web_server
from thirdhand.workbench.trackers.pinch import Pinches
from thirdhand.workbench.trackers.web_server import FOREIGN, server_certificate
from trackers.test_browser_hands import opened, reason

REFUSED: dict[str, tuple[bytes, str]] = {  # requests, with HOST for the header, and their answers
    "a body without end": (
        b"POST / HTTP/1.1\r\nHOSTContent-Length: 99999999\r\n\r\n" + b"a" * 9000,
        "4096 bytes",
    ),
    "a folder above": (b"GET /../../../etc/passwd HTTP/1.1\r\nHOST\r\n", "There is no such page"),
    "a coded folder above": (
        b"GET /%2e%2e/%2e%2e/etc/passwd HTTP/1.1\r\nHOST\r\n",
        "There is no such page",
    ),
    "a host behind a name": (b"GET / HTTP/1.1\r\nHost: other@127.0.0.1\r\n\r\n", FOREIGN),
    "half a token": (b"GET /?token=%ED%A0%80 HTTP/1.1\r\nHOST\r\n", browser_hands.NO_TOKEN),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_is_refused_is_answered_in_words(name: str) -> None:
    sent, why = REFUSED[name]

    async def scenario() -> None:
        async with serving_page(page) as address:
            reader, writer = await asyncio.open_connection(*address.rsplit(":", 1))
            writer.write(sent.replace(b"HOST", f"Host: {address}\r\n".encode(), 1))
            answered = b""
            async with asyncio.timeout(10):
                while why.encode() not in answered:
                    answered += (piece := await reader.read(4096))
                    assert piece, answered
            assert answered.split()[1][:1] == b"4"
            writer.close()

    with page_of_hands() as (page, _):
        asyncio.run(scenario())


@pytest.mark.parametrize("scheme", ["http", "https"])
def test_silent_connections_take_no_more_than_their_share(
    scheme: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """An open page stays connected; once silent connections are closed, others are answered."""
    monkeypatch.setattr(web_server, "REQUEST_WITHIN_S", 0.5)
    certificate = server_certificate("localhost", tmp_path) if scheme == "https" else None

    async def scenario() -> None:
        async with serving_page(page) as address, opened(page, address, ssl=False) as socket:
            host, port = address.rsplit(":", 1)
            before = len(os.listdir("/proc/self/fd"))
            silent = [await asyncio.open_connection(host, port) for _ in range(600)]
            assert len(os.listdir("/proc/self/fd")) - before < 600 + web_server.MAX_CONNECTIONS + 10
            await socket.send_bytes(hands_message())
            async with asyncio.timeout(10):
                for reader, writer in silent:
                    await reader.read()
                    writer.close()
            async with opened(page, address, ssl=False) as second:
                await second.send_bytes(hands_message(number=1))
            await heard.until("left", 1)

    with page_of_hands(certificate=certificate) as (page, heard):
        asyncio.run(scenario())


@pytest.mark.parametrize(
    "cell", ["x`+alert(1)+`", "</title><script>", 'x"y', "${alert(1)}", "__TOKEN__"]
)
def test_a_cell_of_any_name_is_text_on_its_page(cell: str) -> None:
    async def scenario() -> None:
        async with serving_page(page) as address, aiohttp.ClientSession() as session:
            answered = await session.get(f"http://{address}/?token={page.server.token}")
            title, body = re.split("</title>", await answered.text(), maxsplit=1)
            assert title.endswith(f"thirdhand hands: {html.escape(cell)}")
            assert cell not in body

    with page_of_hands(cell=cell) as (page, _):
        asyncio.run(scenario())


def test_hold_is_carried_out_beside_another_answer(monkeypatch: pytest.MonkeyPatch) -> None:
    """A page waits for another answer meanwhile."""
    orders: list[str] = []
    slow = threading.Event()

    def order(_: Client, name: str, by: str = "") -> tuple[bool, str]:
        orders.append(name)
        return (True, name) if name == "hold" else (slow.wait(20), name)

    monkeypatch.setattr(browser_hands, "carried_out", order)

    async def answers(socket: Any, *wanted: str) -> None:
        received = set[str]()
        while received < set(wanted):
            message = await socket.receive_json(timeout=10)
            received |= {message["answer"]} if "answer" in message else set()

    async def scenario() -> None:
        async with (
            serving_page(page) as address,
            opened(page, address) as first,
            opened(page, address) as second,
        ):
            for socket in (first, second):
                for name in ("resume", "reset", "hold", "resume", "hold"):
                    await socket.send_str(name)
            await answers(first, "hold")
            await answers(second, "hold")
            assert "reset" not in orders
            slow.set()
            await answers(first, "resume")

    with page_of_hands() as (page, _):
        try:
            asyncio.run(scenario())
        finally:
            slow.set()
    assert sorted(set(orders)) == ["hold", "resume"]
    assert orders.count("resume") == 2


def test_a_pinch_ends_with_its_page_and_with_a_pause(monkeypatch: pytest.MonkeyPatch) -> None:
    """Between the two distances, a hand keeps the clutch pressed only if the same hand has
    pinched.
    """
    monkeypatch.setattr(browser_hands, "MAX_PINCH_GAP_S", 0.5)
    pressed: list[bool] = []
    # [m]
    pinched = 0.01
    between = 0.03

    async def says(value: bool, socket: Any = None, apart_m: float = 0.0) -> None:
        """Assert that the next received value is this one; a dropped message is sent again."""
        async with asyncio.timeout(10):
            while not pressed:
                if socket is not None:
                    await socket.send_bytes(hands_message(left=(*PALM[:10], apart_m, 0.0)))
                await asyncio.sleep(0.02)
        await asyncio.sleep(0.1)
        assert set(pressed) == {value}
        pressed.clear()

    async def scenario() -> None:
        async with serving_page(page) as address:
            async with opened(page, address) as first:
                await says(True, first, pinched)
                await says(True, first, between)
                await asyncio.sleep(0.6)
                await says(False, first, between)
                await says(True, first, pinched)
            await says(False)  # the page has left
            async with opened(page, address) as second:
                await says(False, second, between)
                await second.send_bytes(hands_message(left=(*PALM[:10], -1.0, 0.0)))
                assert await reason(second) == (
                    4400,
                    "Refused: left hand: a distance of -1 m, 0 or more accepted",
                )

    def hear(sample: zenoh.Sample) -> None:
        pressed.append(cdr.decode_bool(sample.payload.to_bytes()))

    with (
        open_session(listen=["tcp/127.0.0.1:0"]) as hearing,
        hearing.declare_subscriber("thirdhand/clutch", hear),
        open_session(connect=[endpoints(hearing)[0]]) as session,
        page_of_hands(pinches=Pinches(session, "thirdhand", clutch="left")) as (page, _),
    ):
        asyncio.run(scenario())
