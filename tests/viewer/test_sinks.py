"""The viewer's tap: content of drawings, failures of single parts, and drawings of recordings."""

from __future__ import annotations

import re
import socket
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from support.recorded import TEXT, at_ns, drawn, ticks, values, viewed, vise_taught, write
from support.wam import JOINT_NAMES
from thirdhand.command_line import main
from thirdhand.contract import cdr
from thirdhand.contract.messages import JointState, SceneObject
from thirdhand.contract.requests import encode_json
from thirdhand.core.frame import Record
from thirdhand.core.skill.model import REGION_95
from thirdhand.core.skill.pose import CLOSED
from thirdhand.core.skill.skill import Skill
from thirdhand.settings.config import WAM, Settings
from thirdhand.viewer.sentences import sentence
from thirdhand.viewer.stream import Viewer, ViewerError
from thirdhand.workbench.cli.view import convert


def measured(tick: int, joints: Record) -> tuple[str, bytes]:
    """The event of measured joints (7,) [rad] in a tick."""
    return "joints/state", cdr.encode_joints(
        JointState(at_ns(tick), JOINT_NAMES, tuple(joints), ())
    )


def test_recording_becomes_a_drawing_with_every_tick(tmp_path: Path) -> None:
    entries = write(tmp_path / "a.mcap", 1200)
    assert convert(tmp_path / "a.mcap", tmp_path / "a.rrd") == 1200
    rows = drawn(tmp_path / "a.rrd")
    position = rows["/joints/position"]
    assert values(position, "tick") == list(range(1200))
    assert values(position, "Scalars:scalars") == [
        frame["joints"].tolist() for _, frame, _ in entries
    ]
    last = values(position, "time")[-1]
    assert np.datetime64(last, "ns") == np.datetime64(at_ns(1199), "ns")
    (names,) = values(position, "SeriesLines:names")
    assert len(names) == len(JOINT_NAMES)
    work = np.ravel(values(rows["/timing/work"], "Scalars:scalars"))
    assert work == pytest.approx([timing["work_us"] for *_, timing in entries])


def test_hands_and_target_are_drawn_once_they_are_known(tmp_path: Path) -> None:
    """Hands are known once they are seen, the target once the arm moves."""
    entries = list(ticks(600))

    def change(one: Viewer, k: int, _: Record) -> None:
        if k == 300:
            one.log("handover taught", "INFO", at_ns(k))

    rows = viewed(tmp_path / "a.rrd", 600, change)
    by_path = {path: values(table, "tick") for path, table in rows.items()}
    every = list(range(0, 600, 5))
    assert by_path["/scene/tool"] == by_path["/arm/joints/3"] == every
    assert (
        by_path["/scene/left_hand"]
        == by_path["/scene/target"]
        == [tick for tick in every if tick >= 10]
    )
    assert len(by_path["/scene/tool_trail"]) == 600 // 25 - 1
    (position,) = values(rows["/scene/left_hand"], "Points3D:positions")[-1]
    assert position == pytest.approx(entries[595][1]["hands"][0])
    (half,) = values(rows["/scene/target"], "Ellipsoids3D:half_sizes")[-1]
    assert sorted(half) == pytest.approx(
        sorted(np.sqrt(REGION_95 * np.array([4e-4, 1e-4, 2e-4]))), rel=1e-4
    )
    assert values(rows["/mode"], "StateChange:state") == [["hold"], ["follow"]]
    assert Counter(text for (text,) in values(rows["/log"], TEXT)) == {
        "hold: no hands yet: a hand has not been seen since the start": 1,
        "follow": 1,
        "handover taught": 1,
    }
    links = {path.split("/")[4] for path in rows if path.startswith("/arm/wam/visual_geometries/")}
    assert {"base", "upper_arm", "palm"} <= links
    assert not [path for path in rows if "collision" in path]


def test_every_curve_names_its_unit(tmp_path: Path) -> None:
    rows = viewed(tmp_path / "a.rrd", 300)
    names = {path: values(entity_rows, "SeriesLines:names") for path, entity_rows in rows.items()}
    labels = [name for entity_rows in names.values() for several in entity_rows for name in several]
    assert len(labels) > 30
    assert all(re.search(r" \[(mm|ms|µs|m/s|m|rad|rad/s|rad/s²|°|%|1)\]$", name) for name in labels)


def test_trail_begins_anew_where_the_hand_reappears(tmp_path: Path) -> None:
    """The first trail begins where the hand was first seen."""

    def change(_: Viewer, k: int, frame: Record) -> None:
        if 300 <= k < 600:  # the hand disappears, and reappears elsewhere
            frame["hand_ages"][0] = k - 300
        if k >= 600:
            frame["hands"][0] += 0.5

    rows = viewed(tmp_path / "a.rrd", 900, change)
    strips = [strips[0] for strips in values(rows["/scene/left_trail"], "LineStrips3D:strips")]
    corners = np.concatenate([np.array(strip).reshape(-1, 3) for strip in strips])
    assert (np.linalg.norm(corners, axis=1) > 0.5).all()  # no corner is at the origin
    steps = [
        np.linalg.norm(np.diff(np.array(strip).reshape(-1, 3), axis=0), axis=1) for strip in strips
    ]
    assert max(step.max() for step in steps if len(step)) < 0.1
    assert any(len(strip) == 0 for strip in strips)


def test_the_measured_arm_is_drawn_beside_the_commanded_one(tmp_path: Path) -> None:
    def change(_: Viewer, k: int, frame: Record) -> list[tuple[str, bytes]]:
        frame["commanded"] = 1
        return [measured(k, frame["joints"] + 0.02), ("hold", b"")]

    rows = viewed(tmp_path / "a.rrd", 100, change)
    assert (
        len(values(rows["/measured/joints/3"], "tick"))
        == len(values(rows["/arm/joints/3"], "tick"))
        == 20
    )
    assert np.ravel(values(rows["/joints/error"], "Scalars:scalars")) == pytest.approx(
        np.full(100, 0.02)
    )
    assert {
        path.rsplit("/", 1)[1]
        for path in rows
        if path.startswith("/measured/wam/visual_geometries/palm")
    }


def test_shipped_skill_is_drawn_with_demonstrations(tmp_path: Path, skill: Skill) -> None:
    """The skill's via-points are drawn too."""
    taught = vise_taught(skill)
    rows = viewed(
        tmp_path / "a.rrd",
        40,
        lambda view, k, frame: view.learn(taught) if k == 20 else None,
        skill=skill.file,
    )
    lines = values(rows["/skill/demonstrations/tool"], "LineStrips3D:strips")[-1]
    assert len(lines) >= 5
    assert all(len(line) > 50 for line in lines)
    before, after = (
        rows["/skill/via_points/tool"][index].get("Points3D:labels") or [] for index in (0, -1)
    )
    assert "vise" not in before
    assert "vise" in after
    half = dict(
        zip(
            after,
            values(rows["/skill/via_points/left"], "Ellipsoids3D:half_sizes")[-1],
            strict=True,
        )
    )
    assert half["vise"] == pytest.approx([0.03] * 3)
    assert "vise" in values(rows["/about/skill"], "TextDocument:text")[-1][0]
    (gate,) = set(np.ravel(values(rows["/deviation/gate"], "Scalars:scalars")))
    assert gate == pytest.approx(1000 * skill.threshold)


def test_orientation_and_gripper_are_drawn(tmp_path: Path, skill: Skill) -> None:
    """Orientation and gripper are drawn if the skill has them."""
    turned = Rotation.from_euler("x", 3, degrees=True)

    def change(_: Viewer, k: int, frame: Record) -> None:
        if k >= 100:
            frame["closure"] = 0.7
            frame["gripper"] = CLOSED
            frame["orientation_covariance"] = np.radians(2.0) ** 2 * np.eye(3)
            frame["tool_orientation"] = (
                Rotation.from_quat(frame["orientation"]) * turned
            ).as_quat()

    rows = viewed(tmp_path / "a.rrd", 200, change, skill=skill.file)
    curves = {
        path: np.ravel(values(rows[path], "Scalars:scalars"))
        for path in rows
        if path.startswith(("/turn", "/grip"))
    }
    assert curves["/turn/target"][-50:] == pytest.approx(3.0, abs=1e-6)
    assert curves["/turn/std"] == pytest.approx([2.0] * 100)
    assert curves["/gripper/predicted"][-100:] == pytest.approx([70.0] * 100)
    assert curves["/gripper/commanded"] == pytest.approx([100.0] * 100)


def test_undrawable_skill_spares_the_scene(tmp_path: Path) -> None:
    """The log names the skill."""
    rows = viewed(tmp_path / "a.rrd", 30, skill=b"nonsense")
    assert len(values(rows["/joints/position"], "tick")) == 30
    assert any(
        text.startswith("a skill that cannot be drawn") for (text,) in values(rows["/log"], TEXT)
    )


def test_objects_are_drawn_where_they_are(tmp_path: Path) -> None:
    """Objects disappear from the drawing when they are no longer reported."""
    board = SceneObject(
        "board",
        "box",
        "tool_plate",
        (0, 0, 0.05),
        (0, 0, 0, 1),
        (0.08, 0.05, 0.002),
        (0, 0.5, 0, 1),
    )
    glass = SceneObject(
        "glass",
        "cylinder",
        "base",
        (0.5, 0.38, 0.16),
        (0, 0, 0, 1),
        (0.1, 0.1, 0.006),
        (0.7, 0.7, 0.7, 1),
    )

    def change(one: Viewer, k: int, _: Record) -> None:
        if k in (10, 40):
            objects = (board, glass)[: 1 if k == 40 else 2]
            one.note("objects", encode_json(objects).decode(), at_ns(k))
        if k == 50:
            one.note("requests", 'via_points {"op": "clear"}', at_ns(k))

    rows = viewed(tmp_path / "a.rrd", 60, change)
    assert set(np.ravel(values(rows["/scene/things/board"], "CoordinateFrame:frame"))) == {
        "tool_plate"
    }
    assert values(rows["/scene/things/board"], "Boxes3D:half_sizes")[0][0] == pytest.approx(
        [0.04, 0.025, 0.001]
    )
    assert values(rows["/scene/things/glass"], "Cylinders3D:radii")[0] == pytest.approx([0.05])
    assert values(rows["/scene/things/glass"], "Clear:is_recursive") == [[True]]
    for name, over in (("board", (0, 0, -0.01)), ("glass", (0.5, 0.38, 0.22))):
        assert values(rows[f"/scene/things/{name}/name"], "Points3D:labels")[0] == [name]
        assert values(rows[f"/scene/things/{name}/name"], "Points3D:positions")[0][
            0
        ] == pytest.approx(over)
    assert ["All via-points were removed."] in values(rows["/log"], "TextLog:text")


@pytest.mark.parametrize(
    ("note", "said"),
    [
        ('via_points {"op": "add", "points": [{"name": "a"}, {"name": "b"}]}', "Taught: a and b."),
        ('via_points {"op": "remove", "names": ["a"]}', "Removed: a."),
        ('skill {"name": "soldering"}', "Skill soldering is in force."),
        (
            "via_points refused: $.points[0].left: 2 numbers",
            "Teaching was refused: points, entry 1, left: 2 numbers",
        ),
        ("hold {}", "The operator stopped the arm, which holds until it is resumed."),
        ("reset failed: OSError()", "A request to reset failed: OSError()"),
        ("3 ticks before tick 7 are not recorded", "3 ticks before tick 7 are not recorded"),
    ],
)
def test_the_log_speaks_in_sentences(note: str, said: str) -> None:
    assert sentence(note) == said


def test_a_full_disk_is_told(tmp_path: Path) -> None:
    write(tmp_path / "a.mcap", 20)
    with pytest.raises(ViewerError, match=r"/dev/full.*No space left"):
        convert(tmp_path / "a.mcap", "/dev/full")


def test_live_view_listens_on_this_machine_only() -> None:
    """The live view ends when it is closed."""
    viewer = Viewer(urdf=WAM, settings=Settings(), live_port=0)
    assert viewer.url is not None
    port = int(viewer.url.rsplit(":", 1)[1].split("/")[0])
    for tick, frame, timing in ticks(300):
        viewer.add(frame, at_ns(tick.index), timing)
    with socket.create_connection(("127.0.0.1", port), timeout=5) as connection:
        assert connection.getpeername()[0] == "127.0.0.1"
    with (
        pytest.raises(OSError, match="refused"),
        socket.create_connection(("127.0.0.2", port), timeout=5),
    ):
        pass
    viewer.close()


@pytest.mark.parametrize(
    ("arguments", "error"),
    [
        (["a.rrd", "--screenshot", "."], "is a folder; the name of a file needed"),
        (["a.rrd", "--screenshot", "a.jpg"], r"a name that ends in \.png needed"),
        (
            ["a.rrd", "--screenshot", "a.png", "--time", "-1"],
            "from 0 on, together with --screenshot",
        ),
        (["a.rrd", "--time", "3"], "together with --screenshot, needed"),
        (["a.rrd", "--web"], "thirdhand view live --web"),
        (["live", "a.rrd"], "live and 1 files given; either live or files needed"),
        (["a.rrd", "--screenshot", "nowhere/a.png"], "there is no folder"),
        (["a.rrd", "--screenshot", "a.png"], r"no such file: .*a\.rrd"),
        ([".", "--screenshot", "a.png"], r"is a folder; an \.rrd or \.mcap file"),
        (["press.npz"], r"press\.npz is neither a recording \(\.mcap\) nor a drawing .*\(\.rrd\)"),
    ],
)
def test_what_cannot_be_shown_is_said_in_words(
    arguments: list[str],
    error: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("press.npz").write_bytes(b"PK")
    assert main(["view", *arguments]) in (1, 2)
    stderr = capsys.readouterr().err
    assert re.search(error, stderr)
    assert stderr.startswith("thirdhand view: ")
    assert len(stderr.splitlines()) == 1


def test_unmeasured_arm_is_drawn_too_small_to_see(tmp_path: Path) -> None:
    """Each link needs a pose, though the arm was not measured yet."""

    def change(_: Viewer, k: int, frame: Record) -> list[tuple[str, bytes]]:
        return [measured(k, frame["joints"])] if k > 50 else []

    rows = viewed(tmp_path / "a.rrd", 100, change)
    for number in range(len(JOINT_NAMES)):
        first, *later = sorted(rows[f"/measured/joints/{number}"], key=lambda row: row["seconds"])
        assert (first["seconds"].total_seconds(), len(later)) == (0.0, 9)
        assert np.max(first["Transform3D:scale"]) < 1e-3
        assert not any(row.get("Transform3D:scale") for row in later)


def test_hands_of_a_one_handed_skill_are_drawn(tmp_path: Path) -> None:
    """The right hand conducts; the left hand is not seen."""

    def change(_: Viewer, k: int, frame: Record) -> None:
        frame["hand_ages"][0] = -1
        frame["covariance"][:] *= k >= 10  # there is no prediction before
        frame["tool"] += [0.02, 0.0, 0.0]

    rows = viewed(tmp_path / "a.rrd", 200, change)
    followed = list(range(10, 200))
    assert values(rows["/scene/target"], "tick") == followed[::5]
    for path, expected in (("/error/target", 20.0), ("/deviation/target", 1e3 * np.sqrt(7e-4 / 3))):
        assert values(rows[path], "tick") == followed
        assert np.ravel(values(rows[path], "Scalars:scalars")) == pytest.approx(
            np.full(190, expected)
        ), path
    ages = np.array(values(rows["/age"], "Scalars:scalars"))
    assert (len(ages), ages[:, 1].min()) == (190, 0.0)
    assert np.isnan(ages[:, 0]).all()  # the left hand has no curve
