"""Takes in other formats: ROS 1 and compressed messages in MCAP, CSV of Motive, C3D, and arrays as
documented. Other files are refused with a remedy.
"""

from __future__ import annotations

import csv
import re
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import ezc3d
import numpy as np
import pytest
import zstandard
from mcap.writer import Writer
from rosbags.typesys import Stores, get_typestore

from support.circling import circling
from support.paths import ROOT
from thirdhand.command_line import parser
from thirdhand.contract import cdr
from thirdhand.contract.channels import POSE
from thirdhand.contract.explain import ExplainedError
from thirdhand.contract.messages import PoseStamped
from thirdhand.contract.ros2msg import schema
from thirdhand.recordings.mcap_file import RecordingError
from thirdhand.settings.arm_description import description
from thirdhand.settings.config import HandSettings, Settings
from thirdhand.skills.demonstration import Demonstration
from thirdhand.skills.skill_file import skill_in
from thirdhand.workbench.cli.hands import hands
from thirdhand.workbench.cli.view import view
from thirdhand.workbench.takes.demonstration_reader import read_demonstration
from thirdhand.workbench.takes.pose_streams import PoseTopic

NAMES = {"left": "LeftHand", "right": "RightHand", "tool": "Tool"}
ROS_1 = get_typestore(Stores.ROS1_NOETIC)
CAPTURE = Settings(hands=HandSettings(frame="motive", unit="mm"))


@pytest.fixture
def take() -> Demonstration:
    return circling(0)


def same(got: Demonstration, take: Demonstration) -> None:
    for side in NAMES:
        np.testing.assert_allclose(getattr(got, side)[:, :3], getattr(take, side)[:, :3], atol=1e-5)


def of_ros_1(stamp_ns: int, row: list[float]) -> bytes:
    types = ROS_1.types
    header = types["std_msgs/msg/Header"](
        seq=0, stamp=types["builtin_interfaces/msg/Time"](*divmod(stamp_ns, 10**9)), frame_id="base"
    )
    pose = types["geometry_msgs/msg/Pose"](
        types["geometry_msgs/msg/Point"](*row[:3]), types["geometry_msgs/msg/Quaternion"](*row[3:])
    )
    message = types["geometry_msgs/msg/PoseStamped"](header, pose)
    return bytes(ROS_1.serialize_ros1(message, message.__msgtype__))


def compressed(stamp_ns: int, row: list[float]) -> bytes:
    pose = PoseStamped(stamp_ns, "base", tuple(row[:3]), tuple(row[3:]))  # type: ignore[arg-type]
    return zstandard.ZstdCompressor().compress(cdr.encode_pose(pose))


@pytest.mark.parametrize(
    ("encoding", "kind", "encoded"),
    [("ros1", "geometry_msgs/PoseStamped", of_ros_1), ("cdr", POSE.type, compressed)],
)
def test_ros_1_and_compressed_messages_are_read(
    encoding: str,
    kind: str,
    encoded: Callable[[int, list[float]], bytes],
    take: Demonstration,
    tmp_path: Path,
) -> None:
    """Both are read from MCAP files."""
    path = tmp_path / "a.mcap"
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start(profile=encoding)
        pose = writer.register_schema(
            kind, "ros1msg" if encoding == "ros1" else "ros2msg", schema(POSE.type).encode()
        )
        for side, topic in (
            ("left", "/a/hands/left"),
            ("right", "/a/hands/right"),
            ("tool", "/a/tool/pose"),
        ):
            channel = writer.register_channel(topic, encoding, pose)
            for stamp, row in zip(
                take.stamps_ns.tolist(), getattr(take, side).tolist(), strict=True
            ):
                writer.add_message(channel, stamp + 1000, encoded(stamp + 1000, row), stamp + 1000)
        writer.finish()
    same(read_demonstration(path), take)


def motive(
    path: Path, take: Demonstration, *, unit: str = "Millimeters", rotation: str = "Quaternion"
) -> Path:
    """A take as Motive exports it: rotation, position and a marker of each body."""
    types, names, kinds, axes = [["", label] for label in ("Type", "Name", "", "")]
    axes[:] = ["Frame", "Time (Seconds)"]
    columns = []
    for side, name in NAMES.items():
        types += ["Rigid Body"] * 8 + ["Rigid Body Marker"] * 3
        names += [name] * 8 + [f"{name}:Marker1"] * 3
        kinds += ["Rotation"] * 4 + ["Position"] * 3 + ["Mean Marker Error"] + ["Position"] * 3
        axes += [*"XYZW", *"XYZ", "", *"XYZ"]
        poses = getattr(take, side)
        scaled = 1000.0 * poses[:, :3]
        columns += [poses[:, 3:], scaled, np.zeros((len(poses), 1)), scaled]
    numbers = np.hstack([np.arange(len(take.tool))[:, None], take.seconds[:, None], *columns])
    with path.open("w", newline="", encoding="utf-8") as stream:
        out = csv.writer(stream)
        out.writerow(
            [
                "Format Version",
                "1.23",
                "Take Name",
                "a",
                "Rotation Type",
                rotation,
                "Length Units",
                unit,
            ]
        )
        out.writerow([])
        out.writerows([types, names, ["", "ID"], kinds, axes])
        for row in numbers.tolist():
            is_lost = 200 <= row[0] < 260
            out.writerow(["" if is_lost and 2 <= i < 10 else f"{x:.6f}" for i, x in enumerate(row)])
    return path


def test_bodies_and_gaps_of_motive_are_read(take: Demonstration, tmp_path: Path) -> None:
    """The gaps are those of the file."""
    path = motive(tmp_path / "a.csv", take)
    remarks = list[str]()
    got = read_demonstration(path, settings=CAPTURE, say=remarks.append)
    assert got.begins == (200,)
    left_in = np.r_[0:200, 260 : len(take.tool)]
    same(got, take._replace(**{side: getattr(take, side)[left_in] for side in NAMES}))
    assert "left is LeftHand; right is RightHand; tool is Tool" in " ".join(remarks)
    assert "hands/left 3.98 to 5.20 s: not seen" in " ".join(remarks)
    with pytest.raises(
        RecordingError, match=r"frame 'motion capture': 'base' needed, or a configuration"
    ):
        read_demonstration(path)
    for wrong, words in (
        ({"unit": "Feet"}, "Length Units 'Feet'"),
        ({"rotation": "XYZ"}, "Rotation Type 'XYZ'; export"),
    ):
        with pytest.raises(RecordingError, match=words):
            read_demonstration(motive(tmp_path / "b.csv", take, **wrong), settings=CAPTURE)


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (lambda rows: rows[:0], "holds no frame, 2 needed: export"),
        (
            lambda rows: [[row[0], "inf", *row[2:]] for row in rows],
            "frame 1 of 20 is at inf s, up to 1e.09 s needed",
        ),
        (lambda rows: [[row[0], "nan", *row[2:]] for row in rows], "frame 1 of 20 is at nan s"),
        (
            lambda rows: rows[::-1],
            "frame 2 of 20 is at .* s, and the one before at .* s; times that grow needed",
        ),
        (
            lambda rows: [[*row[:2], *(f"{x}e3" for x in row[2:])] for row in rows],
            "mm; the unit in the file",
        ),
    ],
)
def test_wrong_frames_of_motive_are_refused(
    spoil: Callable[[list[list[str]]], list[list[str]]],
    words: str,
    take: Demonstration,
    tmp_path: Path,
) -> None:
    """Invalid numbers of frames are refused with a remedy."""
    path = motive(tmp_path / "a.csv", take)
    rows = [line.split(",") for line in path.read_text(encoding="utf-8").splitlines()]
    head = next(i for i, row in enumerate(rows) if row[0] == "Frame") + 1
    path.write_text(
        "\n".join(map(",".join, [*rows[:head], *spoil(rows[head : head + 20])])), encoding="utf-8"
    )
    with pytest.raises(RecordingError, match=words):
        read_demonstration(path, settings=CAPTURE)


def test_markers_of_c3d_are_read_as_unturned(take: Demonstration, tmp_path: Path) -> None:
    file: Any = ezc3d.c3d()
    points = np.ones((4, 3, len(take.tool)))
    for i, side in enumerate(NAMES):
        points[:3, i] = 1000.0 * getattr(take, side)[:, :3].T
    points[:3, 0, 100:110] = np.nan
    file["parameters"]["POINT"]["RATE"]["value"] = [50.0]
    file["parameters"]["POINT"]["UNITS"]["value"] = ["mm"]
    file["parameters"]["POINT"]["LABELS"]["value"] = list(NAMES.values())
    file["data"]["points"] = points
    file.write(str(tmp_path / "a.c3d"))
    got = read_demonstration(tmp_path / "a.c3d", settings=CAPTURE)
    assert (got.begins, len(got.tool)) == ((), len(take.tool))
    np.testing.assert_allclose(got.hands, take.hands, atol=0.01)
    np.testing.assert_allclose(got.tool[:, 3:], np.tile([0.0, 0.0, 0.0, 1.0], (len(take.tool), 1)))
    one_handed = read_demonstration(
        tmp_path / "a.c3d", settings=CAPTURE, topics={"left": PoseTopic("RightHand")}
    )
    assert one_handed.conducts == "right"


def test_damaged_c3d_file_is_refused(take: Demonstration, tmp_path: Path) -> None:
    """The file is cut, or has two markers of the same name."""
    for labels, words in (
        (list(NAMES.values()), "was cut: it holds .* of .* frames"),
        (["RightHand"] * 3, "RightHand 2"),
    ):
        file: Any = ezc3d.c3d()
        file["parameters"]["POINT"]["RATE"]["value"] = [50.0]
        file["parameters"]["POINT"]["UNITS"]["value"] = ["m"]
        file["parameters"]["POINT"]["LABELS"]["value"] = labels
        file["data"]["points"] = np.ones((4, 3, len(take.tool)))
        file.write(str(tmp_path / "a.c3d"))
        data = (tmp_path / "a.c3d").read_bytes()
        (tmp_path / "a.c3d").write_bytes(data[: len(data) // 2] if "cut" in words else data)
        with pytest.raises(RecordingError, match=words):
            read_demonstration(tmp_path / "a.c3d", settings=CAPTURE)


POINTERS = ["a.mcap", "a.csv", "a.c3d", "a.bag", "a.db3", "bag/a.db3", "a.npz", "a.urdf", "a.stl"]
POINTERS += ["a.rrd", "a.task", "a.whl", "a.mp4"]


@pytest.mark.parametrize("name", POINTERS)
def test_pointers_of_git_lfs_are_named_whatever_they_stand_for(name: str, tmp_path: Path) -> None:
    path = tmp_path / name
    path.parent.mkdir(exist_ok=True)
    path.write_bytes(b"version https://git-lfs.github.com/spec/v1\noid sha256:0a1b\nsize 284184\n")
    shape = (
        '<link name="a"><collision><geometry><mesh filename="a.stl"/></geometry></collision></link>'
    )
    (tmp_path / "b.urdf").write_text(f"<robot>{shape}</robot>")
    read: Callable[[], object] = {
        ".npz": lambda: skill_in(path),
        ".urdf": lambda: description(path),
        ".stl": lambda: description(tmp_path / "b.urdf"),
        ".rrd": lambda: run("view", str(path)),
        ".task": lambda: run("hands", "--camera", "--model", str(path)),
        ".whl": lambda: run("hands", "--camera", "--model", str(path)),
        ".mp4": lambda: run("hands", "--camera", str(path)),
    }.get(path.suffix, lambda: read_demonstration(path.parent if "/" in name else path))
    with pytest.raises(
        ExplainedError,
        match="it is a pointer of Git LFS and not the file itself; `git lfs pull` fetches",
    ):
        read()


def run(*arguments: str) -> object:
    args = parser().parse_args(arguments)
    return {"view": view, "hands": hands}[args.command](args)


def lerobot(path: Path) -> None:
    (path / "meta").mkdir(parents=True)
    (path / "meta" / "info.json").write_text("{}")


@pytest.mark.parametrize(
    ("name", "made", "words"),
    [
        ("set", lerobot, r"set is a data set of LeRobot, .*docs/arrays\.md"),
        (
            "a.csv",
            lambda path: path.write_text("t,x\n0,1\n"),
            r"is not a CSV file as Motive exports it .*docs/arrays",
        ),
        ("a.c3d", lambda path: path.write_bytes(b"nothing"), "is not a C3D file that can be read"),
        (
            "a.mcap.zst",
            lambda path: path.write_bytes(b"x"),
            "is not read: decompress it first, or give the folder",
        ),
        (
            "a.parquet",
            lambda path: path.write_bytes(b"x"),
            r"has a format that is not read: A few lines of Python .*docs/arrays\.md",
        ),
    ],
)
def test_what_is_not_read_is_refused_with_what_to_do(
    name: str, made: Callable[[Path], object], words: str, tmp_path: Path
) -> None:
    made(tmp_path / name)
    with pytest.raises(RecordingError, match=words):
        read_demonstration(tmp_path / name)


def test_the_lines_of_the_page_make_a_take(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (block,) = re.findall(
        r"```python\n(.*?)```", (ROOT / "docs" / "arrays.md").read_text(encoding="utf-8"), re.S
    )
    assert len(block.split("\n\n")[1].splitlines()) + len(block.split("\n\n")[2].splitlines()) <= 10
    monkeypatch.chdir(tmp_path)
    namespace: dict[str, Any] = {}
    exec(block, namespace)
    variables = SimpleNamespace(**namespace)
    got = read_demonstration(tmp_path / "take-1.mcap")
    np.testing.assert_array_equal(got.left, variables.left)
    np.testing.assert_array_equal(got.stamps_ns, variables.take.stamps_ns)
