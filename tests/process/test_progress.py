"""Progress: no output for quick steps, lines without a terminal, a bar on a terminal."""

from __future__ import annotations

import os
import pty
import threading

import pytest

from thirdhand.process.progress import progress, steps


def until_said(capsys: pytest.CaptureFixture[str], words: str) -> str:
    """Standard error up to these words."""
    text = ""
    wait = threading.Event()
    for _ in range(500):
        text += capsys.readouterr().err
        if words in text:
            return text
        wait.wait(0.01)
    raise AssertionError(text)


def test_what_is_quick_says_nothing(capsys: pytest.CaptureFixture[str]) -> None:
    with progress("reading", total=10, after_s=60) as done:
        done(10)
    assert capsys.readouterr().err == ""


def test_where_nobody_watches_it_says_a_line_now_and_then(
    capsys: pytest.CaptureFixture[str],
) -> None:
    with progress("reading", total=200, after_s=0.01, every_s=0.01) as done:
        done(50)
        assert "reading: 25 % of 200 ticks, 0 s\n" in until_said(capsys, "25 %")
        done(100)
        assert "\r" not in until_said(capsys, "50 %")
    with progress("reading", after_s=0.01, every_s=0.01) as done:
        done(7)
        until_said(capsys, "reading: 7 ticks, 0 s\n")


def test_steps_are_named_as_they_begin_and_again_where_they_last(
    capsys: pytest.CaptureFixture[str],
) -> None:
    with steps("learning", after_s=0.01, every_s=0.01) as doing:
        doing("choosing")
        assert until_said(capsys, "choosing: 0 s\n").startswith(
            ("choosing\n", "learning: 0 s\nchoosing\n")
        )
        doing("fitting")
        until_said(capsys, "fitting: 0 s\n")


def test_on_a_terminal_a_bar_is_drawn_and_the_cursor_left_alone(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Ctrl-C ends a command at once, so that a hidden cursor would stay hidden."""
    ours, theirs = pty.openpty()
    drawn = b""
    with os.fdopen(theirs, "w") as terminal:
        monkeypatch.setattr("sys.stderr", terminal)
        monkeypatch.setenv("TERM", "xterm")
        with progress("reading", total=200, after_s=0.0) as done:
            done(100)
            while b"50 %" not in drawn:
                drawn += os.read(ours, 4096)
    while True:
        try:
            drawn += os.read(ours, 4096)
        except OSError:  # the other end of the terminal is closed
            break
    os.close(ours)
    assert b"reading" in drawn
    assert b"\x1b[?25l" not in drawn
