"""The running daemon in a browser: mode and reason at once, the arm held by a button, the scene
drawn; and nobody but the page may ask.
"""

from __future__ import annotations

import contextlib
import http.client
import json
import os
import re
import signal
import socket
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import numpy as np
import psutil
import pytest
from PIL import Image

from service.cli.live_page import A_PICTURE, PATIENCE_S, SAMPLES, STREAM, UNKNOWN
from service.cli.view import FRESH_S, screenshot
from service.daemon.launch import free_port
from service.settings import palette
from support import chromium
from support.cell import Daemon, Tracker, serving
from support.paths import ROOT

TIMEOUT_S = 90
EMPTY_GRPC = b"\0\0\0\0\0"  # a message without fields


class Page:
    """The page of a running daemon, and requests to it."""

    def __init__(self, daemon: Daemon, url: str) -> None:
        self.daemon, self.url = daemon, url
        self.host = urlsplit(url).netloc

    def ask(self, method: str, path: str, body: bytes = b"", **headers: str) -> tuple[int, str]:
        """The code and the text of an answer."""
        connection = http.client.HTTPConnection(self.host, timeout=TIMEOUT_S)
        try:
            connection.request(method, path, body or None, {name.replace("_", "-"): v for name, v in headers.items()})
            answer = connection.getresponse()
            return answer.status, answer.read().decode(errors="replace")
        finally:
            connection.close()


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Page]:
    """A page beside a daemon that has a live view and sees two hands; slow, for both are drawn
    tick by tick.
    """
    arguments = ("--joints", "assumed", "--live", "0", "--rate", "100")
    with serving(tmp_path_factory.mktemp("cell"), *arguments) as daemon, Tracker(daemon.session):
        daemon.until(lambda status: status["mode"] == "follow" and status["scribe"]["live"], TIMEOUT_S)
        with served(daemon) as url:
            yield Page(daemon, url)


FROZEN = """
import sys
from service.__main__ import main
from service.trackers import web_server
web_server.FROZEN_S = 2.0
sys.exit(main())
"""


@contextlib.contextmanager
def server_of(
    daemon: Daemon, address: str = "127.0.0.1:0", *, program: tuple[str, ...] = ("-m", "service")
) -> Iterator[tuple[str, subprocess.Popen[str]]]:
    """The URL and the process of a page that `thirdhand view live --web` serves; it must end
    without a word on standard error.
    """
    command = [sys.executable, *program, "view", "live", "--web", address, "--connect", daemon.endpoint]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=ROOT) as server:
        clock = threading.Timer(TIMEOUT_S, server.kill)
        clock.start()
        try:
            assert server.stdout is not None
            assert server.stderr is not None
            assert server.stderr.readline() == "thirdhand: follow\n"  # said before all else
            url = server.stdout.readline().strip()
            clock.cancel()
            yield url, server
            server.terminate()
            assert server.wait(TIMEOUT_S) == 0
            assert server.stderr.read() == ""
        finally:
            clock.cancel()
            server.kill()


@contextlib.contextmanager
def served(daemon: Daemon, address: str = "127.0.0.1:0") -> Iterator[str]:
    """The URL of such a page."""
    with server_of(daemon, address) as (url, _):
        yield url


def token_in(text: str) -> str:
    """The token that a page holds."""
    return text.split('const token = "')[1].split('"', maxsplit=1)[0]


def test_only_the_page_itself_may_hold_the_arm(page: Page) -> None:
    code, text = page.ask("GET", "/")
    assert code == 200
    assert page.ask("POST", "/hold")[0] == 403
    assert page.ask("POST", "/hold", X_Thirdhand_Token="guessed")[0] == 403
    assert page.ask("POST", "/hold", X_Thirdhand_Token="gü\xff")[0] == 403
    token = token_in(text)
    assert page.ask("POST", "/hold", X_Thirdhand_Token=token, Origin="http://elsewhere.example")[0] == 403
    for origin in ("null", "http://[", f"http://{page.host}.example"):
        assert page.ask("POST", "/hold", X_Thirdhand_Token=token, Origin=origin)[0] == 403
    for host in ("elsewhere.example", '"@127.0.0.1', "[", ""):  # the first is a name that was made to point here
        assert page.ask("GET", "/", Host=host)[0] == 403
    for method, path in (("POST", "/shutdown"), ("GET", "/favicon.ico"), ("GET", "/hold"), ("DELETE", "/status")):
        expected = 405 if path in ("/hold", "/status") else 404
        assert page.ask(method, path, X_Thirdhand_Token=token) == (expected, UNKNOWN)
    assert page.ask("POST", "/hold", bytes(10_000), X_Thirdhand_Token=token)[0] == 413
    assert page.daemon.client.ask("status")["mode"] == "follow"
    code, text = page.ask("POST", "/hold", X_Thirdhand_Token=token)
    assert code == 200
    assert re.fullmatch(r"hold carried out at tick \d+; mode then: hold \(operator\)", text)
    held = page.daemon.until(lambda status: status["mode"] == "hold")
    assert (held["reason"], held["remedy"]) == ("operator", "thirdhand resume")
    told = json.loads(page.ask("GET", "/status")[1])
    assert (told["because"], told["remedy"]) == (held["because"], "press Resume")
    assert page.ask("POST", "/resume", X_Thirdhand_Token=token)[0] == 200
    page.daemon.until(lambda status: status["mode"] == "follow")


@pytest.mark.thorough
def test_clients_that_are_slow_or_leave_cost_no_thread_and_no_traceback(page: Page) -> None:
    stream = f"POST {STREAM} HTTP/1.1\r\nHost: {{}}\r\nContent-Type: application/grpc-web+proto\r\n"
    stream += "Content-Length: 5\r\n\r\n\0\0\0\0\0"
    with server_of(page.daemon, program=("-c", FROZEN)) as (url, process), contextlib.ExitStack() as closing:
        slow, parts, server = Page(page.daemon, url), urlsplit(url), psutil.Process(process.pid)

        def client(sends: str, *, reads: int = 0) -> socket.socket:
            connection = closing.enter_context(socket.create_connection((parts.hostname, parts.port), TIMEOUT_S))
            connection.sendall(sends.format(parts.netloc).encode())
            if reads:
                assert connection.recv(reads)
            return connection

        assert slow.ask("GET", "/status")[0] == 200
        before = server.num_threads()
        unfinished = [client("GET / HTTP/1.1\r\nHost: {}\r\n") for _ in range(160)]
        file = "GET /viewer/re_viewer_bg.wasm HTTP/1.1\r\nHost: {}\r\n\r\n"
        unread = [*(client(stream) for _ in range(30)), *(client(file) for _ in range(10))]
        for sends in (stream, file):
            for _ in range(20):
                leaving = client(sends, reads=100)
                leaving.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))  # by a reset
                leaving.close()
        assert slow.ask("GET", "/status")[0] == 200
        assert server.num_threads() <= before + 2
        assert all(connection.recv(100) == b"" for connection in unfinished)
        with contextlib.suppress(ConnectionResetError):
            while rest := unread[-1].recv(1 << 20):
                assert not rest.endswith(b"0\r\n\r\n")  # the file is cut off before its end


def test_viewer_and_stream_come_from_the_same_address_and_nothing_from_elsewhere(page: Page) -> None:
    code, text = page.ask("GET", "/viewer/?0.5")
    assert code == 200
    assert "re_viewer.js" in text
    assert "https:" not in text
    assert page.ask("GET", "/viewer/re_viewer.js")[0] == 200
    for path in ("/", "/viewer/", "/nowhere"):  # whatever a script in them asks for, a browser fetches nothing else
        connection = http.client.HTTPConnection(page.host, timeout=TIMEOUT_S)
        connection.request("GET", path)
        policy = connection.getresponse().headers["Content-Security-Policy"].split("; ")
        assert policy[0] == "default-src 'none'"
        hosts = {source for part in policy for source in part.split(" ")[1:] if ":" in source and "//" in source}
        assert hosts <= {
            f"http://localhost:{page.host.split(':')[1]}",
            f"http://localhost:{page.host.split(':')[1]}/viewer/",
        }
        connection.close()
    connection = http.client.HTTPConnection(page.host, timeout=TIMEOUT_S)
    connection.request("POST", STREAM, EMPTY_GRPC, {"Content-Type": "application/grpc-web+proto", "X-Grpc-Web": "1"})
    answer = connection.getresponse()
    assert answer.status == 200
    assert len(answer.read(200_000)) == 200_000  # what was drawn before this client came
    connection.close()


def test_the_page_follows_the_live_view_where_the_scribe_is_started_again(page: Page) -> None:
    before = json.loads(page.ask("GET", "/status")[1])["live"]
    os.kill(page.daemon.client.ask("status")["scribe"]["pid"], signal.SIGKILL)
    until = time.monotonic() + TIMEOUT_S
    while (now := json.loads(page.ask("GET", "/status")[1])["live"]) == before or now.startswith("127.0.0.1:0 "):
        assert time.monotonic() < until
        time.sleep(0.2)
    connection = http.client.HTTPConnection(page.host, timeout=TIMEOUT_S)
    connection.request("POST", STREAM, EMPTY_GRPC, {"Content-Type": "application/grpc-web+proto", "X-Grpc-Web": "1"})
    assert len(connection.getresponse().read(200_000)) == 200_000
    connection.close()


@pytest.mark.thorough
def test_a_viewer_is_sent_little_more_than_it_has_drawn(page: Page) -> None:
    connection = http.client.HTTPConnection(page.host, timeout=TIMEOUT_S)
    known = {"Content-Type": "application/grpc-web+proto", "X-Grpc-Web": "1", "Referer": f"{page.url}viewer/?0.5"}
    connection.request("POST", STREAM, EMPTY_GRPC, known)
    answer, came = connection.getresponse(), threading.Semaphore(0)

    def read() -> None:
        with contextlib.suppress(OSError, http.client.HTTPException, ValueError):  # it is closed
            while len(header := answer.read(5)) == 5:
                if SAMPLES.fullmatch(answer.read(int.from_bytes(header[1:], "big"))):
                    came.release()

    def tell_shown(at_s: float) -> None:
        assert page.ask("POST", "/viewer/shown", str(1000 * at_s).encode(), Referer=known["Referer"])[0] == 200

    reader = threading.Thread(target=read)
    reader.start()
    for _ in range(A_PICTURE):
        assert came.acquire(timeout=PATIENCE_S)
    assert not came.acquire(timeout=PATIENCE_S / 3)  # what was drawn before, and since, is some thousands
    tell_shown(time.time() - PATIENCE_S)
    assert not came.acquire(timeout=1.0)  # it is far behind
    tell_shown(time.time())
    assert came.acquire(timeout=PATIENCE_S / 3)
    assert connection.sock is not None
    connection.sock.shutdown(socket.SHUT_RDWR)
    reader.join(TIMEOUT_S)
    connection.close()


@pytest.mark.usefixtures("drawing")
def test_a_picture_of_the_live_view_is_recent_or_says_its_age_and_shows_the_scene_to_who_comes_late(
    page: Page, tmp_path: Path
) -> None:
    age_s = screenshot(page.daemon.client.ask("status")["scribe"]["live"], tmp_path / "live.png")
    assert age_s is not None
    assert age_s > 0
    assert FRESH_S == 1.0
    with Image.open(tmp_path / "live.png") as image:
        pixels = np.asarray(image.convert("RGB")).reshape(-1, 3).astype(int)
    follow = np.abs(pixels - (0, 158, 115)).max(axis=1) < 12  # the banner
    assert follow.sum() > 2000


@pytest.mark.skipif(chromium.PROGRAM is None, reason="needs Chromium: on Debian, apt install chromium")
def test_a_browser_shows_mode_and_reason_and_its_buttons_hold_and_resume(page: Page, tmp_path: Path) -> None:
    with chromium.opened(page.url, tmp_path, size=(1200, 600), timeout_s=TIMEOUT_S) as tab:

        def click(name: str, *, until: str) -> Any:
            tab.ask(f"document.getElementById('{name}').click()")
            return tab.until(f"document.getElementById('mode').textContent == '{until}'")

        def grey() -> list[str]:
            found: list[str] = json.loads(
                tab.ask("JSON.stringify([...document.querySelectorAll('button:disabled')].map(one => one.id))")
            )
            return found

        assert tab.until("document.getElementById('mode').className == 'follow'")
        assert grey() == ["resume", "reset"]
        tab.picture(tmp_path / "follow.png")
        click("hold", until="hold: operator request")
        tab.until("document.getElementById('answer').textContent != 'hold ...'")
        assert tab.ask("document.getElementById('answer').textContent").startswith("hold carried out at tick ")
        assert grey() == ["reset"]
        tab.picture(tmp_path / "hold.png")
        assert "What to do: press Resume" in tab.until("document.getElementById('why').textContent")
        click("resume", until="follow")
        assert grey() == ["resume", "reset"]
        tab.until("document.getElementById('answer').textContent == ''")  # the answer does not stay
        assert "/viewer/" in tab.ask("document.querySelector('iframe').src")
        tab.until("/^picture [0-9.]+ s old/.test(document.getElementById('picture').textContent)")
        tab.picture(tmp_path / "page.png")
    with Image.open(tmp_path / "page.png") as image:
        assert image.convert("RGB").getpixel((30, 20)) == (0, 158, 115)  # beside the word


@pytest.mark.skipif(chromium.PROGRAM is None, reason="needs Chromium: on Debian, apt install chromium")
@pytest.mark.thorough
def test_a_phone_shows_hands_and_tool_from_above_and_goes_on_where_the_page_is_served_anew(
    page: Page, tmp_path: Path
) -> None:
    address = f"127.0.0.1:{free_port()}"

    def shown(name: str) -> str:
        return f"getComputedStyle(document.querySelector('{name}')).display != 'none'"

    with contextlib.ExitStack() as first:
        url = first.enter_context(served(page.daemon, address))
        with chromium.opened(url, tmp_path, timeout_s=TIMEOUT_S) as tab:
            tab.hold_as_phone(390, 844)
            assert tab.until(f"document.getElementById('mode').className == 'follow' && {shown('svg')}")
            assert tab.ask(shown("iframe")) is False
            assert tab.until("document.querySelector('iframe').src") == "about:blank"
            assert tab.until("document.querySelector('#left text').textContent") == "left hand, 6 cm up"
            assert tab.ask("document.getElementById('left').getAttribute('transform')").startswith("translate(0.9")
            assert tab.until("document.querySelector('#tool text').textContent").startswith("tool, ")
            assert tab.ask("document.documentElement.scrollWidth") == 390
            tab.picture(tmp_path / "phone.png")
            first.close()
            assert tab.until("document.getElementById('mode').textContent == \"this page's server has ended\"")
            assert tab.ask("document.querySelectorAll('button:enabled').length") == 0
            with served(page.daemon, address):
                tab.until(f"token != '{tab.ask('token')}' && document.getElementById('mode').className == 'follow'")
                tab.ask("document.getElementById('hold').click()")
                assert tab.until("document.getElementById('mode').textContent == 'hold: operator request'")
                tab.ask("document.getElementById('resume').click()")
                assert tab.until("document.getElementById('mode').textContent == 'follow'")
    with Image.open(tmp_path / "phone.png") as image:
        assert image.size == (780, 1688)
        pixels = np.asarray(image.convert("RGB")).reshape(-1, 3).astype(int)
    for colour in (palette.LEFT, palette.RIGHT, palette.TOOL, palette.ARM_BODY):
        assert (np.abs(pixels - colour).max(axis=1) < 12).sum() > 100
