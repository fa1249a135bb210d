"""The web server of this machine's pages on a hostile network: what cannot be parsed is answered,
what is not read is closed, idle connections leave room for others, and the hands of a page go on.
"""

from __future__ import annotations

import asyncio
import datetime
import json
import logging
import socket
import threading
import time
from pathlib import Path
from typing import Any

import pytest
import zenoh
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import NameOID

from service.client import Client, endpoints, open_session
from service.contract import cdr
from service.contract.explain import ExplainedError
from service.contract.incidents import ORDERS
from service.trackers import browser_hands, cell_view, web_server
from service.trackers.cell_view import Latest, carried_out
from service.trackers.pinch import Pinches
from service.trackers.web_server import FOREIGN, UNREADABLE, server_certificate
from support.page_hands import PALM, hands_message, page_of_hands, serving_page
from trackers.test_browser_hands import opened, reason

UNPARSED: dict[str, tuple[bytes, str]] = {  # a request, with HOST for the header, and the answer to it
    "TLS where HTTP is spoken": (b"\x16\x03\x01\x02\x00\x01\x00\x01\xfc\x03\x03" * 20, UNREADABLE),
    "another protocol": (b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n", UNREADABLE),
    "no host": (b"GET / HTTP/1.1\r\n\r\n", UNREADABLE),
    "two hosts": (b"GET / HTTP/1.1\r\nHOSTHost: other\r\n\r\n", UNREADABLE),
    "a long address": (b"GET /?token=" + b"a" * 20_000 + b" HTTP/1.1\r\nHOST\r\n", UNREADABLE),
    "many headers": (b"GET / HTTP/1.1\r\nHOST" + b"X: a\r\n" * 40_000 + b"\r\n", UNREADABLE),
    "bytes in the token": (b"GET /?token=\xff\xfe HTTP/1.1\r\nHOST\r\n", UNREADABLE),
    "an address without end": (b"GET http://[::1/ HTTP/1.1\r\nHOST\r\n", UNREADABLE),
    "a negative length": (b"POST / HTTP/1.1\r\nHOSTContent-Length: -5\r\n\r\n", UNREADABLE),
    "a piece without length": (b"POST / HTTP/1.1\r\nHOSTTransfer-Encoding: chunked\r\n\r\nZZ\r\n", UNREADABLE),
    "a body that is not packed": (
        b"POST / HTTP/1.1\r\nHOSTContent-Encoding: gzip\r\nContent-Length: 10\r\n\r\n0123456789",
        UNREADABLE,
    ),
    "a body without end": (b"POST / HTTP/1.1\r\nHOSTContent-Length: 99999999\r\n\r\n" + b"a" * 9000, "4096 bytes"),
    "a folder above": (b"GET /../../../etc/passwd HTTP/1.1\r\nHOST\r\n", "There is no such page"),
    "a coded folder above": (b"GET /%2e%2e/%2e%2e/etc/passwd HTTP/1.1\r\nHOST\r\n", "There is no such page"),
    "a host behind a name": (b"GET / HTTP/1.1\r\nHost: other@127.0.0.1\r\n\r\n", FOREIGN),
    "half a token": (b"GET /?token=%ED%A0%80 HTTP/1.1\r\nHOST\r\n", browser_hands.NO_TOKEN),
}


def tcp(at: str) -> socket.socket:
    """A connection that hardly buffers what it does not read."""
    host, port = at.rsplit(":", 1)
    connection = socket.socket()
    connection.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 2048)
    connection.connect((host, int(port)))
    connection.setblocking(False)
    return connection


async def read_to_end(connection: socket.socket, within_s: float = 20.0) -> bytes:
    """All that arrives until the server ends the connection."""
    found, loop = bytearray(), asyncio.get_running_loop()
    async with asyncio.timeout(within_s):
        try:
            while piece := await loop.sock_recv(connection, 65_536):
                found += piece
        except ConnectionError:
            pass
    return bytes(found)


def test_what_cannot_be_parsed_is_answered_and_logged_nowhere(caplog: pytest.LogCaptureFixture) -> None:
    async def scenario() -> None:
        async with serving_page(page) as at, opened(page, at) as good:
            for number, (name, (sent, why)) in enumerate(UNPARSED.items()):
                reader, writer = await asyncio.open_connection(*at.rsplit(":", 1))
                writer.write(sent.replace(b"HOST", f"Host: {at}\r\n".encode(), 1))
                answered = b""
                async with asyncio.timeout(10):
                    while why.encode() not in answered:
                        answered += (piece := await reader.read(4096))
                        assert piece, (name, answered)
                status, _, headers = answered.partition(b"\r\n")
                assert status.split()[1][:1] == b"4", (name, status)
                assert b"Server: thirdhand" in headers, name
                writer.close()
                await good.send_bytes(hands_message(number=number))
                await heard.until("left", number + 1)

    with caplog.at_level(logging.WARNING), page_of_hands() as (page, heard):
        asyncio.run(scenario())
    assert not [record for record in caplog.records if record.name.startswith(("aiohttp", "asyncio"))]


def test_a_browser_that_reads_nothing_is_disconnected(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(web_server, "FROZEN_S", 0.5)
    count = 400

    async def scenario() -> None:
        async with serving_page(page) as at:
            request = f"GET /?token={page.server.token} HTTP/1.1\r\nHost: {at}\r\n\r\n".encode()
            connection, loop = tcp(at), asyncio.get_running_loop()
            await asyncio.wait_for(loop.sock_sendall(connection, request * count), 10)
            async with opened(page, at) as good:
                begun = time.monotonic()
                while time.monotonic() - begun < 3:
                    await good.send_bytes(hands_message())
                    await asyncio.sleep(0.1)
            answered = await read_to_end(connection)
            connection.close()
            assert 0 < answered.count(b"HTTP/1.1 200 OK") < count
            assert len(heard.poses["left"]) > 10

    with page_of_hands() as (page, heard):
        asyncio.run(scenario())


def test_idle_connections_make_room_for_others(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(web_server, "MAX_CONNECTIONS", 20)

    async def scenario() -> None:
        async with serving_page(page) as at, opened(page, at) as first:
            await first.send_bytes(hands_message())
            await heard.until("left", 1)
            idle = []
            for _ in range(60):
                idle.append(tcp(at))
                await asyncio.sleep(0)
            for connection in idle[:30]:  # the oldest are closed; without the limit, after 30 s
                assert await read_to_end(connection, 10) == b""
            async with opened(page, at) as late:
                await late.send_bytes(hands_message())
                assert (await reason(late))[0] == 4409
            await first.send_bytes(hands_message(number=1))
            await heard.until("left", 2)
            for connection in idle:
                connection.close()

    with page_of_hands() as (page, heard):
        asyncio.run(scenario())


def test_a_hold_is_carried_out_while_a_page_waits_for_another_answer(monkeypatch: pytest.MonkeyPatch) -> None:
    given: list[str] = []
    slow = threading.Event()

    def order(_: Client, name: str, by: str = "") -> tuple[bool, str]:
        given.append(name)
        return (True, name) if name == "hold" else (slow.wait(20), name)

    monkeypatch.setattr(browser_hands, "carried_out", order)

    async def answers(socket: Any, *wanted: str) -> None:
        found = set[str]()
        while found < set(wanted):
            message = await socket.receive_json(timeout=10)
            found |= {message["answer"]} if "answer" in message else set()

    async def scenario() -> None:
        async with serving_page(page) as at, opened(page, at) as first, opened(page, at) as second:
            for socket in (first, second):
                for name in ("resume", "reset", "hold", "resume", "hold"):
                    await socket.send_str(name)
            await answers(first, "hold")
            await answers(second, "hold")
            assert "reset" not in given
            slow.set()
            await answers(first, "resume")

    with page_of_hands() as (page, _):
        try:
            asyncio.run(scenario())
        finally:
            slow.set()
    assert sorted(set(given)) == ["hold", "resume"]
    assert given.count("resume") == 2


def test_a_pinch_ends_with_its_page_and_with_a_pause(monkeypatch: pytest.MonkeyPatch) -> None:
    """Between the two distances, a hand keeps the clutch pressed only if it has pinched itself."""
    monkeypatch.setattr(browser_hands, "MAX_PINCH_GAP_S", 0.5)
    pressed: list[bool] = []
    pinched, between = 0.01, 0.03  # [m]

    async def says(value: bool, socket: Any = None, apart_m: float = 0.0) -> None:
        """The first thing that is heard next; a message is sent again if it was dropped."""
        async with asyncio.timeout(10):
            while not pressed:
                if socket is not None:
                    await socket.send_bytes(hands_message(left=(*PALM[:10], apart_m, 0.0)))
                await asyncio.sleep(0.02)
        await asyncio.sleep(0.1)
        assert set(pressed) == {value}
        pressed.clear()

    async def scenario() -> None:
        async with serving_page(page) as at:
            async with opened(page, at) as first:
                await says(True, first, pinched)
                await says(True, first, between)
                await asyncio.sleep(0.6)
                await says(False, first, between)
                await says(True, first, pinched)
            await says(False)  # the page has left
            async with opened(page, at) as second:
                await says(False, second, between)
                await second.send_bytes(hands_message(left=(*PALM[:10], -1.0, 0.0)))
                assert await reason(second) == (4400, "Refused: left hand: a distance of -1 m, 0 or more accepted")

    def hear(sample: zenoh.Sample) -> None:
        pressed.append(cdr.decode_bool(sample.payload.to_bytes()))

    with (
        open_session(listen=["tcp/127.0.0.1:0"]) as hearing,
        hearing.declare_subscriber("thirdhand/clutch", hear),
        open_session(connect=[endpoints(hearing)[0]]) as session,
        page_of_hands(pinches=Pinches(session, "thirdhand", clutch="left")) as (page, _),
    ):
        asyncio.run(scenario())


STATUS: dict[str, Any] = {
    **dict.fromkeys(("cell", "mode", "reason", "skill", "version"), "x"),
    **dict.fromkeys(("tick", "rate_hz", "missed", "hand_distance_m", "hand_limit_m_s"), 1),
    **dict.fromkeys(("realtime", "memory_locked"), True),
    **dict.fromkeys(("flags", "places", "endpoints"), ()),
    **{name: {} for name in ("rejected", "hand_age_ms", "scribe")},
    **{name: {"p50": 0, "p99": 0, "max": 0} for name in ("lateness_us", "work_us", "latency_ms")},
}
STRANGE: dict[str, bytes] = {  # anybody may publish a status in an open network
    "no JSON": b"\xff" * 100,
    "another type": b"[" * 10_000,
    "an address without end": json.dumps(STATUS | {"scribe": {"live": "rerun+http://[x/"}}).encode(),
    "a port that is none": json.dumps(STATUS | {"scribe": {"live": "rerun+http://x:999999"}}).encode(),
    "a long text": json.dumps(STATUS | {"because": "x" * 1_000_000}).encode(),
}
REPLIES = (b"", b"{}", b"[]", b'{"tick": {}, "mode": 5}', b'{"tick": 1, "mode": null}', b"\xff", b"[" * 9000)


def test_strange_statuses_and_replies_leave_pages_their_status_and_an_answer() -> None:
    with (
        open_session(listen=["tcp/127.0.0.1:0"]) as daemon,
        open_session(connect=[endpoints(daemon)[0]]) as session,
        daemon.liveliness().declare_token(f"thirdhand/daemon/{daemon.zid()}"),
    ):
        latest = Latest(session, "thirdhand")
        deadline = time.monotonic() + 10
        for name, strange in STRANGE.items():
            mode = f"after {name}"
            daemon.put("thirdhand/status", strange)
            while (shown := latest.summary()).get("mode") != mode:
                assert time.monotonic() < deadline, name
                daemon.put("thirdhand/status", strange)
                assert len(json.dumps(latest.summary())) < cell_view.MAX_STATUS_BYTES
                daemon.put("thirdhand/status", json.dumps(STATUS | {"mode": mode}).encode())
                time.sleep(0.02)
            assert latest.stream.host
            assert shown["facts"]
        client, reply = Client(session, timeout_s=5), b""
        queryables = [
            daemon.declare_queryable(f"thirdhand/{name}", lambda query: query.reply(query.key_expr, reply))
            for name in ORDERS
        ]
        for reply in REPLIES:
            for name in ORDERS:
                is_done, text = carried_out(client, name)
                assert (is_done, text.startswith(f"{name} was NOT carried out: ")) == (False, True), (reply, text)
        for one in queryables:
            one.undeclare()  # type: ignore[no-untyped-call]
        session.close()  # type: ignore[no-untyped-call]
        assert carried_out(client, "hold")[0] is False


def certified(folder: Path, begin_days: float, end_days: float) -> Path:
    """A certificate of this machine and its key, valid between two days from now."""
    key, now = ec.generate_private_key(ec.SECP256R1()), datetime.datetime.now(datetime.UTC)
    name = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, "bench")])
    made = x509.CertificateBuilder(name, name, key.public_key(), x509.random_serial_number())
    made = made.not_valid_before(now + datetime.timedelta(begin_days)).not_valid_after(
        now + datetime.timedelta(end_days)
    )
    made = made.add_extension(x509.SubjectAlternativeName([x509.DNSName("bench")]), critical=False)
    folder.mkdir()
    (folder / "certificate.pem").write_bytes(made.sign(key, hashes.SHA256()).public_bytes(serialization.Encoding.PEM))
    (folder / "key.pem").write_bytes(
        key.private_bytes(serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption())
    )
    return folder


def test_a_certificate_is_served_only_while_it_is_valid(tmp_path: Path) -> None:
    assert server_certificate(certified(tmp_path / "now", -1, 1)).names == {"bench"}
    with pytest.raises(ExplainedError, match=r"certificate\.pem expired on .*: a new certificate needed"):
        server_certificate(certified(tmp_path / "past", -9, -1))
    with pytest.raises(ExplainedError, match=r"certificate\.pem is valid from .* on, but the clock here shows"):
        server_certificate(certified(tmp_path / "future", 1, 9))
