"""A headless Chromium, driven over its debugging pipe: opens a page, evaluates JavaScript, takes
pictures.
"""

from __future__ import annotations

import base64
import contextlib
import json
import os
import select
import shutil
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

PROGRAM = shutil.which("chromium") or shutil.which("chromium-browser")
_OPTIONS = (
    "--headless=new --no-sandbox --disable-dev-shm-usage --use-angle=swiftshader "
    "--enable-unsafe-swiftshader --ignore-gpu-blocklist --no-first-run --remote-debugging-pipe "
    "--ignore-certificate-errors"
)


class Tab:
    """A page in a browser."""

    def __init__(self, to: int, source: int, url: str, timeout_s: float, before: str) -> None:
        self._to = to
        self._source = source
        self._rest = b""
        self._number = 0
        self._until = time.monotonic() + timeout_s
        target = self._call("Target.createTarget", {"url": "about:blank" if before else url})[
            "targetId"
        ]
        self._session = self._call("Target.attachToTarget", {"targetId": target, "flatten": True})[
            "sessionId"
        ]
        if before:
            self._call("Page.enable", {}, self._session)
            self._call("Page.addScriptToEvaluateOnNewDocument", {"source": before}, self._session)
            self._call("Page.navigate", {"url": url}, self._session)

    def _post(self, method: str, params: dict[str, Any], session: str = "") -> None:
        """Call a method without waiting for its answer."""
        self._number += 1
        message = {
            "id": self._number,
            "method": method,
            "params": params,
            **({"sessionId": session} if session else {}),
        }
        os.write(self._to, json.dumps(message).encode() + b"\0")

    def _call(self, method: str, params: dict[str, Any], session: str = "") -> Any:
        self._post(method, params, session)
        while True:
            while b"\0" not in self._rest:
                left_s = self._until - time.monotonic()
                assert left_s > 0, f"no answer to {method}"
                assert select.select([self._source], [], [], left_s)[0], f"no answer to {method}"
                self._rest += os.read(self._source, 1 << 20)
            message, _, self._rest = self._rest.partition(b"\0")
            answer = json.loads(message)
            if answer.get("id") == self._number:
                return answer.get("result", {})  # empty if the page is not loaded yet

    def ask(self, expression: str) -> Any:
        """The value of an expression of JavaScript in the page."""
        reply = self._call(
            "Runtime.evaluate", {"expression": expression, "awaitPromise": True}, self._session
        )
        return reply.get("result", {}).get("value")

    def until(self, expression: str) -> Any:
        """The first value of an expression that is true."""
        while not (value := self.ask(expression)):
            assert time.monotonic() < self._until, expression
            time.sleep(0.1)
        return value

    def mouse(self, kind: str, x: float, y: float, **more: Any) -> None:
        """Send a mouse event at a pixel: `Pressed`, `Moved`, `Released` or `Wheel`.

        The answer is not awaited: it comes with the next picture, which may be late.
        """
        button = {
            "button": "none" if kind == "Wheel" else "left",
            "buttons": int(kind in ("Pressed", "Moved")),
        }
        self._post(
            "Input.dispatchMouseEvent",
            {"type": f"mouse{kind}", "x": x, "y": y, "clickCount": 1} | button | more,
            self._session,
        )

    def cover(self) -> None:
        """Hide the page behind another one."""
        self._call("Target.createTarget", {"url": "about:blank"})

    def uncover(self) -> None:
        """Show the page again."""
        self._call("Page.bringToFront", {}, self._session)

    def picture(self, path: Path) -> None:
        """Save a picture of the page as PNG."""
        reply = self._call("Page.captureScreenshot", {"format": "png"}, self._session)
        path.write_bytes(base64.b64decode(reply["data"]))


@contextlib.contextmanager
def opened(
    url: str,
    folder: Path,
    *,
    size: tuple[int, int] = (1600, 1000),
    timeout_s: float = 60.0,
    before: str = "",
) -> Iterator[Tab]:
    """A page in a browser of its own, whose files are in a folder; the script `before` runs before
    the page's own scripts, also after a reload.
    """
    reader, to = os.pipe()
    source, tell = os.pipe()
    arguments = [str(PROGRAM), str(folder / "profile")]
    command = (
        f'exec "$0" {_OPTIONS} --window-size={size[0]},{size[1]} "--user-data-dir=$1" 3<&{reader} '
        f"4>&{tell}"
    )
    with (folder / "chromium.log").open("wb") as log:
        browser = subprocess.Popen(
            ["bash", "-c", command, *arguments],
            pass_fds=(reader, tell),
            stderr=log,
            stdout=log,
        )
    os.close(reader)
    os.close(tell)
    try:
        yield Tab(to, source, url, timeout_s, before)
    finally:
        browser.kill()
        browser.wait()
        os.close(to)
        os.close(source)
