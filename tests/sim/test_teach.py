"""Demonstrations: files that are reproducible to the byte, and their content."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader

from thirdhand.cli.usage import via_points_in
from thirdhand.contract import cdr, messages
from thirdhand.core.skill.segments import NONE
from thirdhand.workbench.learning.division import off_via_point
from thirdhand_sim import teach
from thirdhand_sim.scene import Scene


def test_file_of_a_demonstration(tmp_path: Path) -> None:
    """A file holds hands and tool at a hundred hertz in frame base."""
    assert (
        teach.main(
            ["--output", str(tmp_path), "--count", "1", "--seed", "3", "--cell", "lab/bench2"]
        )
        == 0
    )
    taught = teach.demonstrations(Scene(), count=1, seed=3)[0]
    with (tmp_path / "demonstration-1.mcap").open("rb") as stream:
        reader = make_reader(stream)
        assert reader.get_header().profile == "ros2"
        by_topic: dict[str, list[messages.PoseStamped]] = {}
        for schema, channel, message in reader.iter_messages():
            assert schema is not None
            assert (schema.name, schema.encoding, channel.message_encoding) == (
                "geometry_msgs/msg/PoseStamped",
                "ros2msg",
                "cdr",
            )
            by_topic.setdefault(channel.topic, []).append(cdr.decode_pose(message.data))
    assert set(by_topic) == {
        "/lab/bench2/hands/left",
        "/lab/bench2/hands/right",
        "/lab/bench2/tool/pose",
    }
    for topic, poses in (
        ("hands/left", taught.left),
        ("hands/right", taught.right),
        ("tool/pose", taught.tool),
    ):
        messages = by_topic[f"/lab/bench2/{topic}"]
        assert {message.frame_id for message in messages} == {"base"}
        np.testing.assert_array_equal([message.stamp_ns for message in messages], taught.stamps_ns)
        np.testing.assert_array_equal(
            [(*message.position, *message.orientation) for message in messages], poses
        )
    assert set(np.diff(taught.stamps_ns)) == {10_000_000}


def test_exit_codes(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Exit codes of bad usage and failure."""
    with pytest.raises(SystemExit, match="2"):
        teach.main(["--output", str(tmp_path), "--count", "0"])
    (tmp_path / "scene.toml").write_text("glas = [0, 0, 0]")
    assert teach.main(["--output", str(tmp_path), "--scene", str(tmp_path / "scene.toml")]) == 1
    assert "glas" in capsys.readouterr().err


def test_tutorial_task_visits_tray_twice(tmp_path: Path) -> None:
    """The tutorial's task visits the tray twice, and its via-points are stored."""
    file = tmp_path / "via-points.json"
    assert teach.main(["--visits", "--via-points", str(file)]) == 0
    via_points = via_points_in(file)
    assert [place.name for place in via_points] == ["start", "tray", "work", "tray again", "done"]
    assert via_points[1].left == via_points[3].left
    assert np.linalg.norm(np.subtract(via_points[1].tool, via_points[3].tool)) > 0.1
    first = teach.visits(1)
    other = teach.visits(2)
    for take in (first, other):
        for place in via_points:
            assert off_via_point(take, place, NONE).min() < 0.02
    assert len(first.tool) != len(other.tool)
