"""The running daemon in a browser: mode and reason appear at once, a button holds the arm, the
scene is drawn; only the page itself may send requests.
"""

from __future__ import annotations

import contextlib
import http.client
import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import pytest
from PIL import Image

from support import chromium
from support.cell import Daemon, Tracker, serving
from support.cell_commands import started
from thirdhand.workbench.cli.live_page import NO_SUCH_PAGE

TIMEOUT_S = 90


class Page:
    """The page of a running daemon, and requests to it."""

    def __init__(self, daemon: Daemon, url: str) -> None:
        self.daemon = daemon
        self.url = url
        self.host = urlsplit(url).netloc

    def ask(self, method: str, path: str, body: bytes = b"", **headers: str) -> tuple[int, str]:
        """The code and the text of an answer."""
        connection = http.client.HTTPConnection(self.host, timeout=TIMEOUT_S)
        try:
            connection.request(
                method,
                path,
                body or None,
                {name.replace("_", "-"): v for name, v in headers.items()},
            )
            answer = connection.getresponse()
            return answer.status, answer.read().decode(errors="replace")
        finally:
            connection.close()


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Page]:
    """A page of a daemon with a live view and two hands, at a low rate: each tick is drawn."""
    arguments = ("--joints", "assumed", "--live", "0", "--rate", "100")
    with serving(tmp_path_factory.mktemp("cell"), *arguments) as daemon, Tracker(daemon.session):
        daemon.until(
            lambda status: status["mode"] == "follow" and status["scribe"]["live"], TIMEOUT_S
        )
        with served(daemon) as url:
            yield Page(daemon, url)


@contextlib.contextmanager
def served(daemon: Daemon) -> Iterator[str]:
    """The URL of a page that `thirdhand view live --web` serves; the command must end with nothing
    more on standard error.
    """
    arguments = ("view", "live", "--web", "127.0.0.1:0", "--connect", daemon.endpoint)
    with started(*arguments, within_s=5 * TIMEOUT_S) as server:
        assert server.stderr.readline() == "thirdhand: follow\n"  # the first line
        yield server.stdout.readline().strip()
        server.terminate()
        assert server.wait(TIMEOUT_S) == 0
        assert server.stderr.read() == ""


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
    assert (
        page.ask("POST", "/hold", X_Thirdhand_Token=token, Origin="http://elsewhere.example")[0]
        == 403
    )
    for origin in ("null", "http://[", f"http://{page.host}.example"):
        assert page.ask("POST", "/hold", X_Thirdhand_Token=token, Origin=origin)[0] == 403
    # the first one is a foreign name that resolves to this machine
    for host in ("elsewhere.example", '"@127.0.0.1', "[", ""):
        assert page.ask("GET", "/", Host=host)[0] == 403
    for method, path in (
        ("POST", "/shutdown"),
        ("GET", "/favicon.ico"),
        ("GET", "/hold"),
        ("DELETE", "/status"),
    ):
        expected = 405 if path in ("/hold", "/status") else 404
        assert page.ask(method, path, X_Thirdhand_Token=token) == (expected, NO_SUCH_PAGE)
    assert page.ask("POST", "/hold", bytes(10_000), X_Thirdhand_Token=token)[0] == 413
    assert page.daemon.client.ask("status")["mode"] == "follow"
    code, text = page.ask("POST", "/hold", X_Thirdhand_Token=token)
    assert code == 200
    assert re.fullmatch(r"hold carried out at tick \d+; mode then: hold \(operator\)", text)
    held = page.daemon.until(lambda status: status["mode"] == "hold")
    assert (held["reason"], held["remedy"]) == ("operator", "thirdhand resume")
    reply = json.loads(page.ask("GET", "/status")[1])
    assert (reply["because"], reply["remedy"]) == (held["because"], "press Resume")
    assert page.ask("POST", "/resume", X_Thirdhand_Token=token)[0] == 200
    page.daemon.until(lambda status: status["mode"] == "follow")


@pytest.mark.skipif(
    chromium.PROGRAM is None, reason="needs Chromium: on Debian, apt install chromium"
)
def test_browser_buttons_hold_and_resume(page: Page, tmp_path: Path) -> None:
    """The page shows mode and reason."""
    with chromium.opened(page.url, tmp_path, size=(1200, 600), timeout_s=TIMEOUT_S) as tab:

        def click(name: str, *, until: str) -> Any:
            tab.ask(f"document.getElementById('{name}').click()")
            return tab.until(f"document.getElementById('mode').textContent == '{until}'")

        def grey() -> list[str]:
            button_ids: list[str] = json.loads(
                tab.ask(
                    "JSON.stringify([...document.querySelectorAll('button:disabled')].map(one => "
                    "one.id))"
                )
            )
            return button_ids

        assert tab.until("document.getElementById('mode').className == 'follow'")
        assert grey() == ["resume", "reset"]
        tab.picture(tmp_path / "follow.png")
        click("hold", until="hold: operator request")
        tab.until("document.getElementById('answer').textContent != 'hold ...'")
        assert tab.ask("document.getElementById('answer').textContent").startswith(
            "hold carried out at tick "
        )
        assert grey() == ["reset"]
        tab.picture(tmp_path / "hold.png")
        assert "What to do: press Resume" in tab.until("document.getElementById('why').textContent")
        click("resume", until="follow")
        assert grey() == ["resume", "reset"]
        tab.until("document.getElementById('answer').textContent == ''")  # the answer disappears
        assert "/?url=rerun%2Bhttp" in tab.ask("document.querySelector('iframe').src")
        tab.picture(tmp_path / "page.png")
    with Image.open(tmp_path / "page.png") as image:
        assert image.convert("RGB").getpixel((30, 20)) == (0, 158, 115)  # the mode's colour
