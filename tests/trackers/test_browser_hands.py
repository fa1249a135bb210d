"""The server of hands from a browser, without a browser: it publishes hands, and refuses bad
messages with a reason while it accepts the hands of another page.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import math
import ssl
import stat
import struct
import time
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

import aiohttp
import pytest

from support.page_hands import PALM, hands_message, page_of_hands, serving_page
from thirdhand.contract.explain import ExplainedError
from thirdhand.workbench.trackers import browser_hands
from thirdhand.workbench.trackers.browser_hands import FULL, MAX_PAGES, NO_TOKEN, TAKEN
from thirdhand.workbench.trackers.hand_message import PING, PING_MAGIC
from thirdhand.workbench.trackers.hands_page import WORKER, HeadsetPage
from thirdhand.workbench.trackers.web_server import FOREIGN, server_certificate

NAN_PALM = (math.nan, *PALM[1:])
NO_ROTATION = (*PALM[:3], 0.0, 0.0, 0.0, 0.5, *PALM[7:])
DAY_MS = 86_400_000.0
REFUSED: dict[str, tuple[Any, str]] = {  # a page's message, and the reason of its refusal
    "too short": (lambda: hands_message()[:-1], "119 bytes, 120 needed"),
    "too long for a websocket here": (lambda: bytes(300), ""),
    "another magic number": (lambda: hands_message(magic=1), "not a message of hands"),
    "no hand": (lambda: hands_message(seen=0), "not a message of hands"),
    "a third hand": (lambda: hands_message(seen=5), "not a message of hands"),
    "NaN": (lambda: hands_message(left=NAN_PALM), "left hand: a number that is not finite"),
    "infinity": (
        lambda: hands_message(right=(math.inf, *PALM[1:])),
        "right hand: a number that is not finite",
    ),
    "no rotation": (lambda: hands_message(left=NO_ROTATION), "left hand: a quaternion of norm 0.5"),
    "yesterday": (
        lambda: hands_message(at_ms=time.time() * 1e3 - DAY_MS),
        "hands of 8.64e+04 s ago: the page's clock",
    ),
    "far future": (
        lambda: hands_message(at_ms=time.time() * 1e3 + DAY_MS),
        "s ahead: the page's clock is wrong",
    ),
    "no time": (lambda: hands_message(at_ms=math.nan), "hands of no time"),
    "predicted for tomorrow": (
        lambda: hands_message(ahead_ms=DAY_MS),
        "ms ahead, 0 to 200 accepted",
    ),
    "predicted for NaN": (lambda: hands_message(ahead_ms=math.nan), "predicted nan ms ahead"),
    "text that is no order": (
        lambda: "open",
        "hold or resume or reset, or correct with undo or three numbers, needed as",
    ),
    "a correction that is no position": (
        lambda: "correct 0.5 high 0.3",
        "or correct with undo or three numbers, needed as",
    ),
}


@contextlib.asynccontextmanager
async def opened(
    page: HeadsetPage, at: str, *, token: str | None = None, **more: Any
) -> AsyncIterator[aiohttp.ClientWebSocketResponse]:
    """A websocket to the server of a page."""
    url = f"{page.server.scheme}://{at}/hands?token={page.server.token if token is None else token}"
    async with aiohttp.ClientSession() as session, session.ws_connect(url, **more) as socket:
        yield socket


async def reason(socket: aiohttp.ClientWebSocketResponse) -> tuple[int | None, str]:
    """Close code and reason with which the server closes a websocket."""
    async with asyncio.timeout(10):
        while not socket.closed:
            message = await socket.receive()
            if message.type == aiohttp.WSMsgType.CLOSE:
                return message.data, message.extra or ""
    return socket.close_code, ""


def test_hands_are_published_as_sent() -> None:
    """Predicted hands get the present time as their stamp."""

    async def scenario() -> None:
        async with serving_page(page) as address, opened(page, address) as socket:
            before_ns = time.time_ns()
            await socket.send_bytes(hands_message(seen=1, at_ms=before_ns / 1e6 - 20))
            (first,) = await heard.until("left", 1)
            assert abs(first.stamp_ns - (before_ns - 20_000_000)) < 1000
            assert first.frame_id == "webxr"
            assert first.position == pytest.approx(PALM[:3], abs=1e-7)
            assert first.orientation == pytest.approx(PALM[3:7], abs=1e-7)
            assert math.isclose(math.hypot(*first.orientation), 1.0, abs_tol=1e-12)
            before_ns = time.time_ns()
            await socket.send_bytes(hands_message(seen=1, number=1, ahead_ms=150.0))
            second = (await heard.until("left", 2))[1]
            assert before_ns <= second.stamp_ns <= time.time_ns()
            await socket.send_bytes(hands_message(epoch=3, number=5))
            assert (await heard.until("left", 3))[2].frame_id == "webxr3"
            assert len(await heard.until("right", 1)) == 1  # the right hand was visible once
            assert (page.hands.published, page.hands.lost) == (3, 3)
            held_up = time.time() * 1e3 - 2000
            await socket.send_bytes(hands_message(number=6, at_ms=held_up))
            await socket.send_bytes(hands_message(number=7))
            await heard.until("left", 4)
            assert page.hands.delayed == 1

    with page_of_hands() as (page, heard):
        asyncio.run(scenario())


def test_clocks_are_compared_by_pings_and_orders_are_answered() -> None:
    async def scenario() -> None:
        async with serving_page(page) as address, opened(page, address) as socket:
            await socket.send_bytes(PING.pack(PING_MAGIC, 12.5))
            while (answer := await socket.receive(10)).type != aiohttp.WSMsgType.BINARY:
                # no daemon runs
                assert json.loads(answer.data) == {
                    "status": {},
                    "objects": [],
                }
            magic, sent, server_ms = struct.unpack("<I4xdd", answer.data)
            assert (magic, sent) == (PING_MAGIC, 12.5)
            assert abs(server_ms - time.time() * 1e3) < 5000
            await socket.send_str("hold")
            while "answer" not in (message := await socket.receive_json(timeout=20)):
                pass
            assert message["done"] is False
            assert message["answer"].startswith("hold was NOT carried out: nobody answers")

    with page_of_hands() as (page, _):
        asyncio.run(scenario())


def test_refusals_have_a_reason() -> None:
    """Meanwhile the hands of another page are published."""

    async def scenario() -> None:
        async with serving_page(page) as address, opened(page, address) as good:

            async def go_on() -> None:
                count = len(heard.poses["left"])
                await good.send_bytes(hands_message(number=count))
                await heard.until("left", count + 1)

            await go_on()
            for name, (bad, why) in REFUSED.items():
                async with opened(page, address) as socket:
                    sent = bad()
                    await (
                        socket.send_str(sent) if isinstance(sent, str) else socket.send_bytes(sent)
                    )
                    code, text = await reason(socket)
                    assert (code, why in text) == (4400 if why else 1009, True), (name, code, text)
                await go_on()
            async with opened(page, address) as other:
                await other.send_bytes(hands_message())
                assert await reason(other) == (4409, TAKEN)
            for token in ("", "guessed", "gü\udcff"):
                async with opened(
                    page, address, token=token.encode(errors="replace").decode()
                ) as socket:
                    assert await reason(socket) == (4403, NO_TOKEN)
            for headers in (
                {"Origin": "https://elsewhere.example"},
                {"Origin": "null"},
                {"Host": "rebound.example"},
            ):
                async with opened(page, address, headers=headers) as socket:
                    assert await reason(socket) == (4403, FOREIGN)
            await go_on()
            assert len(heard.poses["left"]) == len(REFUSED) + 2

    with page_of_hands() as (page, heard):
        asyncio.run(scenario())


def test_hands_pass_to_another_page(monkeypatch: pytest.MonkeyPatch) -> None:
    """The first page has left or is silent."""
    monkeypatch.setattr(browser_hands, "OWNER_S", 0.2)
    monkeypatch.setattr(browser_hands, "PAGE_SILENCE_S", 0.6)

    async def scenario() -> None:
        async with serving_page(page) as address, opened(page, address) as silent:
            async with opened(page, address) as leaving:
                await leaving.send_bytes(hands_message())
                await heard.until("left", 1)
            await silent.send_bytes(hands_message())
            await heard.until("left", 2)
            await asyncio.sleep(0.3)
            async with opened(page, address) as next_one:
                await next_one.send_bytes(hands_message())
                await heard.until("left", 3)
                assert (await reason(silent))[0] == 4408

    with page_of_hands() as (page, heard):
        asyncio.run(scenario())


def test_the_page_needs_the_token_and_names_nothing_elsewhere() -> None:
    async def scenario() -> None:
        async with (
            serving_page(page) as address,
            aiohttp.ClientSession(f"http://{address}") as session,
        ):
            for part in ("/", f"/{WORKER}"):
                async with session.get(part) as answer:
                    assert (answer.status, await answer.text()) == (403, NO_TOKEN)
                async with session.get(part, params={"token": page.server.token}) as answer:
                    text = await answer.text()
                    assert answer.status == 200
                    assert page.server.token not in text
                    assert "__" not in text
                    assert "https:" not in text.replace('"https:"', "")
                    policy = answer.headers["Content-Security-Policy"].split("; ")
                    assert policy[:2] == [
                        "default-src 'none'",
                        f"connect-src 'self' ws://{address}",
                    ]
            async with session.get("/hands", params={"token": page.server.token}) as answer:
                assert answer.status == 426
            for part in ("/", f"/{WORKER}"):
                async with session.get(part, headers={"Host": "rebound.example"}) as answer:
                    assert (answer.status, await answer.text()) == (403, FOREIGN)

    with page_of_hands() as (page, _):
        asyncio.run(scenario())


def test_self_signed_certificate_serves_https(tmp_path: Path) -> None:
    """HTTPS works under the certificate's name only."""
    certificate = server_certificate("Localhost", tmp_path / "state")
    (file,) = (tmp_path / "state").iterdir()
    assert stat.S_IMODE(file.stat().st_mode) == 0o600
    trusted = ssl.create_default_context(cafile=file)
    trusted.check_hostname = False  # the client connects by address, not by name

    async def scenario() -> None:
        async with serving_page(page) as address:
            for name in ("127.0.0.1", "localhost"):
                host = f"{name}:{address.rpartition(':')[2]}"
                headers = {"Host": host, "Origin": f"https://{host}"}
                async with opened(page, address, ssl=trusted, headers=headers) as socket:
                    await socket.send_bytes(hands_message())
                    await heard.until("left", 1)
                    await socket.close()
            async with opened(
                page, address, ssl=trusted, headers={"Host": "rebound.example"}
            ) as socket:
                assert await reason(socket) == (4403, FOREIGN)
            with pytest.raises(aiohttp.ClientError):  # HTTP to an HTTPS server
                async with aiohttp.ClientSession() as session, session.get(f"http://{address}/"):
                    pass

    with page_of_hands(certificate=certificate) as (page, heard):
        asyncio.run(scenario())
    file.write_text("nothing")
    with pytest.raises(ExplainedError, match=r"localhost\.pem: .*; delete the file for a new one"):
        server_certificate("localhost", tmp_path / "state")
    with pytest.raises(ExplainedError, match="a name in plain letters, or an address, needed"):
        server_certificate("not plain", tmp_path / "state")


def test_a_hundred_pages_at_once_leave_the_first_its_hands() -> None:
    async def scenario() -> None:
        async with serving_page(page) as address, contextlib.AsyncExitStack() as stack:
            first = await stack.enter_async_context(opened(page, address))
            await first.send_bytes(hands_message())
            await heard.until("left", 1)
            others = [await stack.enter_async_context(opened(page, address)) for _ in range(100)]
            refused = [await reason(socket) for socket in others[MAX_PAGES - 1 :]]
            assert set(refused) == {(4429, FULL)}
            assert len(refused) == 101 - MAX_PAGES
            await first.send_bytes(hands_message(number=1))
            await heard.until("left", 2)
            await others[0].close()
            async with opened(page, address) as late:  # a connection is free again
                await late.send_bytes(PING.pack(PING_MAGIC, 0.0))
                while (await late.receive(10)).type != aiohttp.WSMsgType.BINARY:
                    pass

    with page_of_hands() as (page, heard):
        asyncio.run(scenario())
