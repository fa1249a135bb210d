"""Hands that a person drags on a page: a real browser with mouse and wheel, the command that serves
the page, a running daemon, and corrections.
"""

from __future__ import annotations

import contextlib
import json
import math
import re
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from support import chromium
from support.cell import Daemon, serving, until
from support.cell_commands import started
from support.chromium import Tab
from support.dragging import Person
from support.page_hands import Heard
from thirdhand.client import RefusedError, UnreachableError
from thirdhand.contract.messages import BASE
from thirdhand.workbench.trackers.browser_hands import NO_TOKEN
from thirdhand_sim.scene import HAND_ORIENTATION

TIMEOUT_S = 90
MAX_SPEED_M_S = 0.6
pytestmark = pytest.mark.skipif(
    chromium.PROGRAM is None, reason="needs Chromium: on Debian, apt install chromium"
)


@pytest.fixture(scope="module")
def daemon(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Daemon]:
    with serving(
        tmp_path_factory.mktemp("cell"), "--joints", "assumed", "--rate", "100"
    ) as running:
        yield running


@pytest.fixture(scope="module")
def url(daemon: Daemon) -> Iterator[str]:
    """The address that `thirdhand hands --mouse` prints; SIGTERM ends the command without an
    error.
    """
    arguments = ("hands", "--mouse", "--listen", "127.0.0.1:0", "--connect", daemon.endpoint)
    with started(*arguments, within_s=5 * TIMEOUT_S) as server:
        yield server.stdout.readline().strip()
        server.terminate()
        assert server.wait(TIMEOUT_S) == 0
        assert re.search(
            r"\d+ messages with hands published, \d+ lost, 0 too late", server.stderr.read()
        )


@contextlib.contextmanager
def person_at(url: str, folder: Path, *, timeout_s: float = TIMEOUT_S) -> Iterator[Person]:
    """A person at the page, once it shows the hands."""
    with chromium.opened(url, folder, size=(1200, 800), timeout_s=timeout_s) as tab:
        tab.until("typeof hands !== 'undefined' && !!hands.left")
        yield Person(tab)


def until_arrived(
    received: Heard, side: str, to: tuple[float, float, float], within_m: float
) -> None:
    until(
        lambda: math.dist(received.poses[side][-1].position, to) <= within_m,
        f"the {side} hand is not at {to}",
    )


@pytest.mark.thorough
def test_hands_begin_at_the_first_via_point(daemon: Daemon, url: str, tmp_path: Path) -> None:
    """The hands are published at the positions at which they are drawn."""
    received = Heard(daemon.session)
    with person_at(url, tmp_path) as person:
        status = daemon.until(lambda status: status["mode"] == "follow")
        assert list(status["hands_at_m"]) == ["start", "handover", "glass", "soldering"]
        for i, side in enumerate(("left", "right")):
            assert (
                math.dist(received.poses[side][-1].position, status["hands_at_m"]["start"][i])
                < 1e-3
            )
        goal = tuple(status["hands_at_m"]["handover"][0])
        resting = received.poses["right"][-1].position
        begun = len(received.poses["left"])
        person.drag("left", goal)
        person.arrive("left", goal)
        person.arrive("left", person.hand("left", "aim"), within_m=1e-4)
        for side in ("left", "right"):
            until_arrived(received, side, person.hand(side), 1e-3)
        assert received.poses["right"][-1].position == resting
        newest = received.poses["left"][-1]
        assert (newest.frame_id, newest.orientation) == (BASE, HAND_ORIENTATION)
        assert abs(time.time_ns() - newest.stamp_ns) < 1e9
        # The mouse moved too fast, within half a second; the hand did not.
        path = np.array(
            [[pose.stamp_ns / 1e9, *pose.position] for pose in received.poses["left"][begun:]]
        )
        steps = np.diff(path, axis=0)
        moved = np.linalg.norm(steps[:, 1:], axis=1)
        assert moved.max() <= MAX_SPEED_M_S * 0.05 + 1e-6  # the page's longest step is 50 ms
        assert moved.sum() / (steps[:, 0].sum()) <= MAX_SPEED_M_S
        assert np.all(steps[:, 0] > 0)
        daemon.until(
            lambda status: (
                status["mode"] == "follow" and math.dist(status["hands_m"]["left"], goal) < 0.02
            )
        )
        person.tab.ask("at('hold').click()")
        daemon.until(lambda status: status["reason"] == "operator")
        person.tab.until("at('mode').textContent.startsWith('hold')")
        person.tab.ask("at('resume').click()")
        daemon.until(lambda status: status["mode"] == "follow")


def pressed(tab: Tab, button: str) -> str:
    """The answer shown after a button is pressed."""
    tab.ask(f"at('{button}').click()")
    tab.until("!at('answer').textContent.endsWith(' ...') && at('answer').textContent !== ''")
    return str(tab.ask("at('answer').textContent"))


def corrected(tab: Tab) -> str:
    """The answer to the button for a correction, pressed again while a busy browser sends hands too
    late.
    """
    answers: list[str] = []

    def is_answered() -> bool:
        answers.append(pressed(tab, "correct"))
        return not answers[-1].endswith("but the hands are not seen now")

    until(is_answered, "the hands are not seen")
    return answers[-1]


def wait_for_the_skill_worker(daemon: Daemon) -> None:
    """Wait until the skill worker has finished its imports, which takes long on a busy machine."""
    for _ in range(5):
        with contextlib.suppress(RefusedError, UnreachableError):
            daemon.client.clear()
            return


def resting_tool(daemon: Daemon) -> tuple[float, float, float]:
    """The position of the tool [m], once an operator's hold has brought it to rest."""
    before: list[float] = []

    def is_at_rest(status: dict[str, Any]) -> bool:
        before.append(status["tool_m"])
        time.sleep(0.1)
        return status["reason"] == "operator" and before[-2:] == [before[-1]] * 2

    x, y, z = daemon.until(is_at_rest)["tool_m"]
    return x, y, z


@pytest.mark.thorough
def test_correction_by_dragging_is_made_and_undone(
    daemon: Daemon, url: str, tmp_path: Path
) -> None:
    """In a hold the tool is dragged to its right position; then the correction is undone."""
    with person_at(url, tmp_path, timeout_s=5 * TIMEOUT_S) as person:
        tab = person.tab
        wait_for_the_skill_worker(daemon)
        first, second, *_ = (pair[0] for pair in daemon.client.status().hands_at_m.values())
        halfway = tuple(np.mean([first, second], axis=0).tolist())
        person.drag("left", halfway)
        person.arrive("left", halfway)
        daemon.until(
            lambda status: status["mode"] == "follow" and "engaging" not in status["flags"]
        )
        assert tab.ask("at('correcting').hidden")
        tab.ask("at('hold').click()")
        tab.until("!at('correcting').hidden && at('correct').disabled && !!tool")
        x, y, z = resting_tool(daemon)
        tab.until(f"distance(tool, {[x, y, z]}) < 0.0005")
        person.along(person.pixel((x, y, z)), person.pixel((x + 0.02, y + 0.06, z)), tab.mouse)
        tab.ask("keys.add('w')")  # the tool is selected, and the keys lift it
        tab.until(f"dragged[2] > {z + 0.03}")
        tab.ask("keys.clear()")
        goal = tuple(json.loads(tab.ask("JSON.stringify(dragged)")))
        assert math.dist(goal[:2], (x + 0.02, y + 0.06)) < 0.005
        tab.picture(tmp_path / "dragged.png")
        assert corrected(tab).startswith("correction-1 in force: it moves the tool by ")
        (point,) = daemon.client.via_points()
        assert math.dist(point.tool, goal) < 1e-3
        assert math.dist(point.left, halfway) < 5e-3
        tab.ask("at('resume').click()")
        daemon.until(
            lambda status: status["mode"] == "follow" and math.dist(status["tool_m"], goal) < 5e-3
        )
        tab.until("at('correcting').hidden && dragged === null")
        tab.ask("at('hold').click()")
        tab.until("!at('correcting').hidden")
        assert pressed(tab, "undo").startswith(
            "correction-1 undone: it no longer moves the tool by "
        )
        assert daemon.client.via_points() == ()
        assert pressed(tab, "undo") == "correct was NOT carried out: no correction is in force"
        tab.ask("at('resume').click()")
        daemon.until(lambda status: status["mode"] == "follow")


def test_hidden_page_sends_nothing(daemon: Daemon, url: str, tmp_path: Path) -> None:
    """The hands stay where they are."""
    received = Heard(daemon.session)
    with person_at(url, tmp_path) as person:
        daemon.until(lambda status: status["mode"] == "follow")
        person.tab.cover()
        person.tab.until("document.hidden")
        held = daemon.until(lambda status: status["mode"] == "hold")
        assert held["reason"] in ("stale_hand", "no_hands")
        before = received.poses["left"][-1].position
        count = len(received.poses["left"])
        time.sleep(0.5)
        assert len(received.poses["left"]) == count
        person.tab.uncover()
        person.tab.until("!document.hidden")
        daemon.until(lambda status: status["mode"] == "follow")
        assert math.dist(received.poses["left"][-1].position, before) < 1e-3
    daemon.until(lambda status: status["mode"] == "hold")  # the page was closed


def test_the_page_and_its_hands_need_the_token(url: str, tmp_path: Path) -> None:
    for query in ("", "?token=guessed"):
        with pytest.raises(urllib.error.HTTPError, match="403"):
            urllib.request.urlopen(url.partition("?")[0] + query, timeout=TIMEOUT_S)
    # a page with an old token: its socket is refused, and it shows the reason
    stale = "history.replaceState(null, '', '?token=guessed')"
    with chromium.opened(url, tmp_path, size=(1200, 800), timeout_s=TIMEOUT_S) as tab:
        tab.until("typeof link !== 'undefined'")
        tab.ask(f"{stale}; link.connect()")
        tab.until(f"at('why').textContent === {json.dumps(NO_TOKEN)}")
