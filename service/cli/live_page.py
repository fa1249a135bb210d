"""The page of `thirdhand view live --web`: mode and reason, buttons for hold, resume and reset, and
Rerun's web viewer, on a phone a plain view from above, all at one address.

It is a proxy for the viewer's server and the daemon's stream on this machine: it leaves out
what a browser does not draw. A request that changes something needs the token in the page, which
no other site can read.
"""

from __future__ import annotations

import contextlib
import hmac
import html
import http.client
import http.server
import ipaddress
import json
import re
import secrets
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import urlsplit

import zenoh

from service.client import Client
from service.contract import channels
from service.contract.explain import ExplainedError

ORDERS = ("hold", "resume", "reset")
STREAM = "/rerun.sdk_comms.v1alpha1.MessageProxyService/ReadMessages"  # the path at which viewers request the stream
PIECE = 64 * 1024
MOST_BODY = 4096  # bytes of a request
TIMEOUT_S = 10.0
START_S = 15.0
HTML = "text/html; charset=utf-8"
FROZEN_S = 30.0  # of a browser that reads nothing, for which others would wait
A_PICTURE = 130  # messages that are sent ahead of a picture: 0.6 s, in which all comes that is repeated often
BEHIND_MS, PATIENCE_S = 1000.0, 15.0  # of what is sent ahead, and without word of a picture
HISTORY_S = 2.0  # in which what was drawn before comes, and is left out
# of gRPC-Web, after its header of 5 bytes: rows of a recording, not static
SAMPLES = re.compile(rb"\n[\x80-\xff]*.\x12[\x80-\xff]*.\n.\x08\x01.*8\0", re.DOTALL)
_COMMAND = re.compile(rf"(by |before )?thirdhand ({'|'.join(ORDERS)})")
_DROPPED = {"connection", "keep-alive", "transfer-encoding", "content-length", "date", "server"}


class Address(NamedTuple):
    """Host and port of a server."""

    host: str
    port: int

    def __str__(self) -> str:
        return f"[{self.host}]:{self.port}" if ":" in self.host else f"{self.host}:{self.port}"


class Latest:
    """The newest status of the daemon, and its age."""

    def __init__(self, session: zenoh.Session, cell: str, first: dict[str, Any]) -> None:
        self._status, self._at = first, time.monotonic()
        self._subscriber = session.declare_subscriber(channels.key(cell, "status"), self._take)

    def _take(self, sample: zenoh.Sample) -> None:
        with contextlib.suppress(ValueError):
            self._status, self._at = json.loads(sample.payload.to_bytes()), time.monotonic()

    @property
    def stream(self) -> Address:
        """The server of the live view: another one once the scribe was started again."""
        parts = urlsplit((self._status["scribe"].get("live") or "").removeprefix("rerun+"))
        return Address(parts.hostname or "127.0.0.1", parts.port or 0)

    def summary(self) -> dict[str, Any]:
        """Mode, reason, cause, remedy by the page's buttons, places [m], age [s], the daemon's time
        [ms], which live view it serves, and further facts in one line.
        """
        now, age_s = self._status, time.monotonic() - self._at
        hands = ", ".join(f"{side} hand {age:.0f} ms old" for side, age in now["hand_age_ms"].items())
        near = f"{100 * now['hand_distance_m']:.0f} cm to the nearest, " if hands else ""
        facts = (
            f"{hands or 'no hands seen'}; {near}{now['rate_hz']:.0f} Hz, {now['missed']} missed; skill {now['skill']}"
        )
        told = {name: now[name] for name in ("mode", "reason", "because", "hands_m", "tool_m", "target_m", "std_m")}
        remedy = _COMMAND.sub(
            lambda found: f"{found[1]}pressing {found[2].title()}" if found[1] else f"press {found[2].title()}",
            now["remedy"],
        )
        now_ms, live = now["time_ns"] / 1e6 + 1000 * age_s, f"{self.stream} {now['scribe'].get('pid')}"
        return told | {"remedy": remedy, "age_s": age_s, "now_ms": now_ms, "live": live, "facts": facts}


class Room:
    """What a viewer has room for: samples are sent little ahead of its picture, or left out."""

    def __init__(self) -> None:
        self._left, self._sent_ms, self._due = 0, 0.0, time.monotonic() + HISTORY_S

    def _fill(self) -> None:
        self._left, self._due = A_PICTURE, time.monotonic() + PATIENCE_S

    def shown(self, at_ms: float) -> None:
        """Makes room, as the picture of this time is shown [ms]; not where that is far behind."""
        if not self._sent_ms - at_ms > BEHIND_MS:
            self._fill()

    def take(self) -> bool:
        """Whether there is room for one more message."""
        if time.monotonic() > self._due:
            self._fill()
        self._left -= 1
        if self._left >= 0:
            self._sent_ms = 1000 * time.time()
        return self._left >= 0


class _Handler(http.server.BaseHTTPRequestHandler):
    """One request to the page's server."""

    protocol_version = "HTTP/1.1"
    timeout = FROZEN_S
    server_version, sys_version = "thirdhand", ""
    server: LivePage

    def log_message(self, format: str, *args: Any) -> None:  # noqa: A002
        """Logs nothing."""

    def do_GET(self) -> None:
        if self._is_foreign():
            return self._respond(403, "This page is for this machine's own address, not for another name.")
        path = urlsplit(self.path).path
        if path == "/":
            return self._respond(200, self.server.html(self.headers["Host"]), kind=HTML)
        if path == "/status":
            told = self.server.latest.summary() | {"page": self.server.page}
            return self._respond(200, json.dumps(told), kind="application/json")
        if path == "/viewer/":
            within = f"http://{_other_name(self.headers['Host'])}"
            return self._respond(200, _text("live_viewer.html"), kind=HTML, within=within)
        if path.startswith("/viewer/"):
            return self._pass_on(self.server.viewer, "GET", path.removeprefix("/viewer"), None)
        return self._respond(404, "There is nothing of this name.")

    def do_POST(self) -> None:
        size = self.headers.get("Content-Length", "0")
        body = self.rfile.read(int(size)) if size.isdecimal() and int(size) <= MOST_BODY else None
        if body is None:
            self.close_connection = True
            return self._respond(413, f"A body of at most {MOST_BODY} bytes is accepted.")
        if self._is_foreign():
            return self._respond(403, "This page is for this machine's own address, not for another name.")
        if self.path == STREAM:
            return self._pass_on(self.server.latest.stream, "POST", self.path, body)
        if self.path == "/viewer/shown":
            with contextlib.suppress(KeyError, ValueError):
                self.server.rooms[self.headers.get("Referer", "")].shown(float(body))
            return self._respond(200, "")
        name = self.path.removeprefix("/")
        if name not in ORDERS:
            return self._respond(404, "There is nothing of this name.")
        if not hmac.compare_digest(self.headers.get("X-Thirdhand-Token", ""), self.server.token):
            return self._respond(403, "The token of the page is needed: reload it.")
        try:
            reply = self.server.client.ask(name)
        except ExplainedError as error:
            return self._respond(502, f"{name} was NOT carried out: {error}")
        return self._respond(200, f"{name} in force since tick {reply['tick']}")

    def _is_foreign(self) -> bool:
        """Whether the request is from another site, or to another host's name."""
        host, origin = self.headers.get("Host", ""), self.headers.get("Origin")
        if origin is not None and urlsplit(origin).netloc != host:
            return True
        try:
            name = urlsplit(f"//{host}").hostname or ""
            return name not in ("localhost", self.server.address.host) and not ipaddress.ip_address(name)
        except ValueError:
            return True

    def _respond(
        self, code: int, text: str, *, kind: str = "text/plain; charset=utf-8", within: str = "'none'"
    ) -> None:
        data = text.encode()
        self.send_response(code)
        for name, value in (
            ("Content-Type", kind),
            ("Content-Length", str(len(data))),
            ("Cache-Control", "no-store"),
            ("X-Content-Type-Options", "nosniff"),
            ("Content-Security-Policy", f"frame-ancestors {within}"),
        ):
            self.send_header(name, value)
        self.end_headers()
        self.wfile.write(data)

    def _pass_on(self, to: Address, method: str, path: str, body: bytes | None) -> None:
        """Passes on the answer of another server of this machine, piece by piece."""
        headers = {name: value for name, value in self.headers.items() if name.lower() not in ("host", "origin")}
        connection = http.client.HTTPConnection(to.host, to.port, timeout=None if body else TIMEOUT_S)
        try:
            connection.request(method, path, body, headers)
            answer = connection.getresponse()
        except OSError as error:
            connection.close()
            return self._respond(502, f"{to} does not answer: {error}")
        with contextlib.closing(connection), contextlib.suppress(OSError, http.client.HTTPException):
            self.send_response(answer.status)
            for name, value in answer.getheaders():
                if name.lower() not in _DROPPED:
                    self.send_header(name, value)
            self.send_header("Transfer-Encoding", "chunked")
            self.end_headers()
            for piece in iter(lambda: answer.read1(PIECE), b"") if body is None else self._drawn(answer):
                self.wfile.write(f"{len(piece):x}\r\n".encode() + piece + b"\r\n")
            self.wfile.write(b"0\r\n\r\n")
        self.close_connection = True
        return None

    def _drawn(self, answer: http.client.HTTPResponse) -> Iterator[bytes]:
        """The messages of a stream, but for samples that the page's viewer has no room for."""
        page = self.headers.get("Referer", "")
        room = self.server.rooms[page] = Room()
        try:
            while len(header := answer.read(5)) == 5:
                message = header + answer.read(int.from_bytes(header[1:], "big"))
                if not SAMPLES.fullmatch(message, 5) or room.take():
                    yield message
        finally:
            self.server.rooms.pop(page, None)


def _text(name: str) -> str:
    return Path(__file__).with_name(name).read_text(encoding="utf-8")


def _other_name(host: str) -> str:
    """The host with this machine's other name, `localhost` or 127.0.0.1."""
    name, _, port = host.rpartition(":")
    other = {"127.0.0.1": "localhost", "localhost": "127.0.0.1"}.get(name)
    return f"{other}:{port}" if other else host


class LivePage(http.server.ThreadingHTTPServer):
    """The page's server, which listens at `address`. Raises OSError where it cannot."""

    def __init__(self, listen: Address, *, client: Client, latest: Latest, cell: str, viewer: Address) -> None:
        super().__init__(listen, _Handler)
        self.address = Address(listen.host, self.server_port)
        self.client, self.latest, self._cell = client, latest, cell
        self.viewer, self.token, self.page = viewer, secrets.token_urlsafe(24), secrets.token_hex(4)
        self.rooms: dict[str, Room] = {}  # by the viewer's address, each with a number of its own

    def html(self, host: str) -> str:
        """The page, for a browser that reaches it by this host and port.

        The viewer is loaded under this machine's other name if it has one. For the browser that is
        another site, which runs in a process of its own, so that the buttons always respond.
        """
        fields = {"__CELL__": html.escape(self._cell), "__TOKEN__": self.token, "__PAGE__": self.page}
        fields["__VIEWER__"] = f"http://{_other_name(host)}/viewer/"
        text = _text("live.html")
        for name, value in fields.items():
            text = text.replace(name, value)
        return text


@contextlib.contextmanager
def web_viewer(program: Path, stream: str, port: int) -> Iterator[Address]:
    """The address of Rerun's web viewer, served by its own program on a port of this machine while
    the context lasts. Raises OSError where it does not start.
    """
    command = [str(program), "--serve-web", "--bind", "127.0.0.1", "--web-viewer-port", str(port), stream]
    quiet = subprocess.DEVNULL
    with subprocess.Popen(command, stdin=quiet, stdout=quiet, stderr=quiet) as viewer:
        try:
            until, connection = (
                time.monotonic() + START_S,
                http.client.HTTPConnection("127.0.0.1", port, timeout=TIMEOUT_S),
            )
            while True:
                with contextlib.closing(connection):
                    try:
                        connection.request("HEAD", "/")
                        connection.getresponse()
                        break
                    except OSError as error:
                        if viewer.poll() is not None or time.monotonic() > until:
                            raise OSError(f"the web viewer did not start on port {port}: {error}") from None
                time.sleep(0.1)
            yield Address("127.0.0.1", port)
        finally:
            viewer.terminate()
            with contextlib.suppress(subprocess.TimeoutExpired):
                viewer.wait(TIMEOUT_S)
            viewer.kill()
