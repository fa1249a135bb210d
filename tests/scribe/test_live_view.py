"""The live view: frames for which it is too slow are a visible gap; nothing else is omitted."""

from __future__ import annotations

import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from support.pictures import grey
from support.recorded import TEXT, at_ns, drawn, ticks, values
from thirdhand.contract.images import CompressedImage, encode_image
from thirdhand.contract.records import Mode, Reason
from thirdhand.core.frame import Event, Tick
from thirdhand.core.skill.skill import Skill
from thirdhand.scribe.process import MAX_WAITING_FRAMES, LiveView
from thirdhand.scribe.protocol import ImageArrival, TickMessage
from thirdhand.settings.config import WAM, RecordingSettings, Settings
from thirdhand.viewer.stream import Viewer

HELD_AT = MAX_WAITING_FRAMES + 300  # a hold of one tick within the gap
END = MAX_WAITING_FRAMES + 600


def received(*, first: int, end: int, skill_at: int = -1, skill: bytes = b"") -> list[TickMessage]:
    """Ticks as the scribe receives them."""
    messages = []
    for tick, frame, timing in ticks(end - first, first=first):
        if tick.index == HELD_AT:
            frame["mode"] = Mode.HOLD
            frame["reason"] = Reason.OPERATOR
        inbox = (Event("skill", skill, None),) if tick.index == skill_at else ()
        messages.append(TickMessage(Tick(tick.index, inbox), frame, timing, None, None, 0))
    return messages


def shown(path: Path, feed: Callable[[LiveView], None]) -> dict[str, list[dict[str, Any]]]:
    """The rows that a live view draws; it is paused while it receives messages."""
    view = LiveView(
        lambda: Viewer(
            urdf=WAM, settings=Settings(recording=RecordingSettings(also=("lens",))), rrd=path
        )
    )
    feed(view)
    view.is_paused = False
    view.close()
    assert view.problems == []
    return drawn(path)


def test_omitted_frames_are_a_gap_and_nothing_else(tmp_path: Path, skill: Skill) -> None:
    """The gap is in curves and log."""

    def feed(view: LiveView) -> None:
        for message in received(first=0, end=END, skill_at=HELD_AT + 100, skill=skill.file):
            view.add(message)
            if message.tick.index == HELD_AT + 50:
                view.put(
                    lambda viewer: viewer.note(
                        "requests", 'via_points {"op": "clear"}', at_ns(HELD_AT + 50)
                    )
                )
                image = encode_image(CompressedImage(at_ns(0), "lens", "jpeg", grey(1)))
                view.image(ImageArrival("lens", at_ns(HELD_AT + 50), image))

    rows = shown(tmp_path / "a.rrd", feed)
    position = [row for row in rows["/joints/position"] if row.get("tick") is not None]
    drawn_ticks = [row["tick"] for row in position if np.isfinite(row["Scalars:scalars"]).all()]
    breaks = [row["tick"] for row in position if np.isnan(row["Scalars:scalars"]).all()]
    assert set(drawn_ticks[-2:]) == {HELD_AT, HELD_AT + 1}  # where mode and reason change
    assert drawn_ticks[:-2] == list(range(drawn_ticks[-3] + 1))
    left_out = HELD_AT - drawn_ticks[-3] - 1
    assert left_out > 100
    assert breaks == [drawn_ticks[-3] + 1]
    log = [text for (text,) in values(rows["/log"], TEXT)]
    assert (
        f"{left_out} frames and images before tick {HELD_AT} are left out: too slow to draw" in log
    )
    assert "All via-points were removed." in log
    modes = [mode for (mode,) in values(rows["/mode"], "StateChange:state")]
    assert modes == ["hold", "follow", "hold", "follow"]
    assert "/cameras/lens" not in rows
    assert values(rows["/about/skill"], "TextDocument:text")


def test_frames_are_drawn_again_after_the_backlog(tmp_path: Path) -> None:
    def feed(view: LiveView) -> None:
        for message in received(first=0, end=HELD_AT):
            view.add(message)
        is_drained = threading.Event()
        view.put(lambda viewer: is_drained.set())
        view.is_paused = False
        assert is_drained.wait(60)
        for message in received(first=HELD_AT + 1, end=END):
            view.add(message)

    drawn_ticks = values(shown(tmp_path / "a.rrd", feed)["/joints/velocity"], "tick")
    assert drawn_ticks[-1] == END - 1
    assert set(range(HELD_AT + 1, END)) <= set(drawn_ticks)
    assert len(set(drawn_ticks)) < END - 100
