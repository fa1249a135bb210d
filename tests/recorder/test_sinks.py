"""The viewer's tap: what is drawn is in the file, failures spare the rest, a recording becomes a
drawing.
"""

from __future__ import annotations

import socket
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rerun as rr
from test_recording import at_ns, ticks, write
from wam import JOINT_NAMES

from service.cli.view import convert, screenshot
from service.config import WAM, Settings
from service.recorder.mcap_file import RecordingError
from service.recorder.sinks import Viewer, ViewerError


def drawn(path: Path) -> dict[str, list[dict[str, Any]]]:
    """The rows of every entity in a Rerun file."""
    rows: dict[str, list[dict[str, Any]]] = {}
    for chunk in rr.chunk.RrdReader(path).stream():
        rows.setdefault(chunk.entity_path, []).extend(chunk.to_record_batch().to_pylist())
    return rows


def viewer(**where: Any) -> Viewer:
    """A viewer of the shipped arm."""
    return Viewer(urdf=WAM, settings=Settings(), **where)


def test_a_recording_becomes_a_drawing_with_every_tick_in_the_curves(tmp_path: Path) -> None:
    told = write(tmp_path / "a.mcap", 1200)
    assert convert(tmp_path / "a.mcap", tmp_path / "a.rrd") == 1200
    rows = drawn(tmp_path / "a.rrd")
    position = [row for row in rows["/joints/position"] if "tick" in row]
    assert [row["tick"] for row in position] == list(range(1200))
    assert [row["Scalars:scalars"] for row in position] == [frame["joints"].tolist() for _, frame, _ in told]
    assert np.datetime64(position[-1]["time"], "ns") == np.datetime64(at_ns(1199), "ns")
    names = next(row["SeriesLines:names"] for row in rows["/joints/position"] if row.get("SeriesLines:names"))
    assert len(names) == len(JOINT_NAMES)
    work = [row["Scalars:scalars"][0] for row in rows["/timing/work"] if "tick" in row]
    assert work == pytest.approx([timing["work_us"] for *_, timing in told])


def test_hands_and_target_are_drawn_once_there_are_hands_and_the_arm_moves(tmp_path: Path) -> None:
    one = viewer(rrd=tmp_path / "a.rrd")
    told = list(ticks(600))
    for tick, frame, timing in told:
        one.add(frame, at_ns(tick.index), timing)
    one.log("handover taught", "INFO", at_ns(300))
    one.close()
    assert one.problems == []
    rows = drawn(tmp_path / "a.rrd")
    at = {path: [row["tick"] for row in found if row.get("tick") is not None] for path, found in rows.items()}
    every = list(range(0, 600, 5))
    assert at["/scene/tool"] == at["/arm/joints/3"] == every
    assert at["/scene/left_hand"] == at["/scene/target"] == [tick for tick in every if tick >= 10]
    assert len(at["/scene/tool_trail"]) == 600 // 25 - 1
    assert [row["Points3D:positions"][0] for row in rows["/scene/left_hand"] if "tick" in row][-1] == pytest.approx(
        told[595][1]["hands"][0]
    )
    half = [row["Ellipsoids3D:half_sizes"][0] for row in rows["/scene/target"] if "tick" in row][-1]
    assert sorted(half) == pytest.approx(sorted(2 * np.sqrt([4e-4, 1e-4, 2e-4])), rel=1e-4)
    assert [row["StateChange:state"] for row in rows["/mode/mode"] if row.get("tick") is not None] == [
        ["hold"],
        ["follow"],
    ]
    assert Counter(row["TextLog:text"][0] for row in rows["/log"]) == {
        "hold: no hands": 1,
        "follow": 1,
        "handover taught": 1,
    }
    links = {path.split("/")[4] for path in rows if path.startswith("/arm/wam/visual_geometries/")}
    assert {"base", "upper_arm", "palm"} <= links
    assert not [path for path in rows if "collision" in path]


def test_missed_deadlines_stand_in_the_log(tmp_path: Path) -> None:
    one = viewer(rrd=tmp_path / "a.rrd")
    for tick, frame, timing in ticks(20):
        timing["missed"] = 3 if tick.index > 10 else 0
        one.add(frame, at_ns(tick.index), timing)
    one.close()
    assert "3 deadlines missed before tick 19" in [row["TextLog:text"][0] for row in drawn(tmp_path / "a.rrd")["/log"]]


def test_a_destination_that_fails_is_named_and_spares_the_other(tmp_path: Path) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        one = viewer(rrd=tmp_path / "a.rrd", live_port=port)
        assert one.url is None
        assert one.problems == [
            f"the live view ended: port {port} on 127.0.0.1: Address already in use; choose another, or 0 for any"
        ]
        for tick, frame, timing in ticks(30):
            one.add(frame, at_ns(tick.index), timing)
        one.close()
    assert len(one.problems) == 1
    assert len(drawn(tmp_path / "a.rrd")["/joints/position"]) == 31


def test_a_full_disk_is_told(tmp_path: Path) -> None:
    one = viewer(rrd=Path("/dev/full"))
    for tick, frame, timing in ticks(30):
        one.add(frame, at_ns(tick.index), timing)
    one.close()
    assert any("/dev/full" in problem and "No space left" in problem for problem in one.problems)
    write(tmp_path / "a.mcap", 20)
    with pytest.raises(ViewerError, match="No space left"):
        convert(tmp_path / "a.mcap", "/dev/full")


def test_the_live_view_listens_on_this_machine_only_and_ends_when_it_is_closed() -> None:
    one = viewer(live_port=0)
    assert one.problems == []
    assert one.url is not None
    port = int(one.url.rsplit(":", 1)[1].split("/")[0])
    for tick, frame, timing in ticks(300):
        one.add(frame, at_ns(tick.index), timing)
    with socket.create_connection(("127.0.0.1", port), timeout=5) as connection:
        assert connection.getpeername()[0] == "127.0.0.1"
    with pytest.raises(OSError, match="refused"), socket.create_connection(("127.0.0.2", port), timeout=5):
        pass
    one.close()
    assert one.problems == []


def test_errors_say_what_is_missing(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match=r"no recording .*a\.mcap"):
        convert(tmp_path / "a.mcap", tmp_path / "a.rrd")
    with pytest.raises(ViewerError, match=r"there is no .*a\.rrd"):
        screenshot(tmp_path / "a.rrd", tmp_path / "a.png")
