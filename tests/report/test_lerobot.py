"""A recording as a data set of LeRobot: the files that its loader reads, read back by its rules."""

from __future__ import annotations

import itertools
import json
import subprocess
from pathlib import Path

import numpy as np
import pytest
from pyarrow import parquet

from support.in_process import record, resting
from support.pictures import grey
from support.recorded import copied
from support.small_disk import small_disk
from support.wam import JOINT_NAMES, URDF
from thirdhand.command_line import main
from thirdhand.contract import cdr
from thirdhand.contract.images import CompressedImage, encode_image
from thirdhand.core.frame import Frame, Tick
from thirdhand.recordings.recording import Recording
from thirdhand.skills.skill_file import StoredSkill

FIRST = "chunk-000/file-000.parquet"
LOST = range(3000, 3100)


def converted(folder: Path, *arguments: str | Path) -> int:
    """The exit code of the command that writes a data set into a folder."""
    return main(["report", *map(str, arguments), "--lerobot", str(folder)])


@pytest.fixture(scope="module")
def gapped(golden: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Ten seconds of the golden session without 0.2 s of them."""
    path = tmp_path_factory.mktemp("gapped") / "gapped.mcap"
    with copied(Recording.open(golden), path) as (recorder, steps):
        for tick, step in itertools.islice(steps, 5000):
            if tick.index not in LOST:
                lost = len(LOST) * (tick.index == LOST.stop)
                recorder.write(tick, step.frame, time_ns=step.time_ns, lost=lost)
    return path


@pytest.fixture(scope="module")
def data_set(gapped: Path, golden: Path) -> Path:
    folder = gapped.parent / "data"
    options = ("--fps", "30", "--task", "Hold the board.")
    assert converted(folder, gapped, golden, *options) == 0
    return folder


def test_rows_are_what_was_seen_and_commanded_at_their_times(data_set: Path, golden: Path) -> None:
    table = parquet.read_table(data_set / "data" / FIRST)
    episode = table["episode_index"].to_numpy()
    last = table.filter(episode == 2).to_pydict()
    steps = [step for step in Recording.open(golden).steps() if step.frame is not None]
    ready = [
        step for step in steps if step.frame["commanded"] and (step.frame["hand_ages"] >= 0).all()
    ]
    measured = None
    frames = {}
    for step in steps:
        for kind, payload in step.events:
            measured = cdr.decode_joints(payload).position if kind == "joints/state" else measured
        frames[step.tick] = (measured, step.frame["hands"].ravel(), step.frame["joints"])
    assert len(last["index"]) == (steps[-1].tick - ready[0].tick) * 30 // 500 + 1 > 590
    for row in (0, 1, 7, 200, 400, len(last["index"]) - 1):
        newest = max(
            step.tick for step in ready if (step.tick - ready[0].tick) / 500 <= row / 30 + 1e-9
        )
        names = ("observation.state", "observation.environment_state", "action")
        for name, value in zip(names, frames[newest], strict=True):
            np.testing.assert_array_equal(last[name][row], np.float32(value))
    np.testing.assert_array_equal(
        last["timestamp"], (np.arange(len(last["index"])) / 30).astype(np.float32)
    )


def test_a_closure_that_never_changes_is_left_out(
    skill: StoredSkill, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A changing one is kept, also in the episodes where it is constant."""

    def close(frame: Frame) -> None:
        if frame["tick"] >= 300:
            frame["closure"] = 1.0

    still = record(tmp_path / "still.mcap", skill, resting(0, 600))
    closing = record(tmp_path / "closing.mcap", skill, resting(0, 600), change=close)
    for files, left_out in (([still], True), ([still, closing], False)):
        folder = tmp_path / f"{len(files)}"
        assert converted(folder, *files) == 0
        printed = " ".join(capsys.readouterr().out.split())
        is_said = "rows, without action.gripper, which is always -1" in printed
        columns = parquet.read_table(folder / "data" / FIRST).column_names
        features = json.loads((folder / "meta" / "info.json").read_text())["features"]
        assert is_said == left_out == ("action.gripper" not in columns)
        assert [*features] == columns


def test_episodes_end_at_gaps_and_follow_each_other(data_set: Path) -> None:
    table, about = (
        parquet.read_table(data_set / part / FIRST) for part in ("data", "meta/episodes")
    )
    assert table["index"].to_pylist() == list(range(len(table)))
    assert set(table["task_index"].to_pylist()) == {0}
    rows = about.to_pylist()
    assert [episode["episode_index"] for episode in rows] == [0, 1, 2]
    assert [episode["dataset_from_index"] for episode in rows[1:]] == [
        episode["dataset_to_index"] for episode in rows[:-1]
    ]
    assert 170 < rows[0]["length"] < 180  # since both hands were seen
    for episode in rows:
        part = table.slice(episode["dataset_from_index"], episode["length"])
        assert set(part["episode_index"].to_pylist()) == {episode["episode_index"]}
        assert part["frame_index"].to_pylist() == list(range(episode["length"]))
        assert episode["tasks"] == ["Hold the board."]
        assert {
            episode[f"{of}/{kind}_index"]
            for of in ("data", "meta/episodes")
            for kind in ("chunk", "file")
        } == {0}
        assert episode["stats/action/count"] == [episode["length"]]
    assert parquet.ParquetFile(data_set / "data" / FIRST).num_row_groups == 3


def test_what_tells_of_it_is_as_the_loader_wants_it(data_set: Path) -> None:
    info, stats = (
        json.loads((data_set / "meta" / f"{name}.json").read_text()) for name in ("info", "stats")
    )
    table = parquet.read_table(data_set / "data" / FIRST)
    assert (info["codebase_version"], info["fps"], info["robot_type"]) == ("v3.0", 30, "wam")
    assert (info["total_episodes"], info["total_frames"], info["splits"]) == (
        3,
        len(table),
        {"train": "0:3"},
    )
    assert (data_set / info["data_path"].format(chunk_index=0, file_index=0)).is_file()
    assert [*info["features"]] == [*stats] == table.column_names
    for name, feature in info["features"].items():
        values = np.array(table[name].to_pylist())
        assert "/" not in name
        assert feature["shape"] == ([values.shape[1]] if values.ndim == 2 else [1])
        stored = table.schema.field(name).type
        assert {"float": "float32"}.get(
            str(getattr(stored, "value_type", stored)), "int64"
        ) == feature["dtype"]
        np.testing.assert_allclose(
            stats[name]["mean"], np.atleast_1d(values.mean(0)), rtol=1e-5, atol=1e-6
        )
        np.testing.assert_allclose(
            stats[name]["q90"], np.atleast_1d(np.quantile(values, 0.9, axis=0)), rtol=1e-5
        )
        assert all(
            len(stats[name][kind]) == feature["shape"][0]
            for kind in ("min", "max", "std", "q01", "q99")
        )
    assert info["features"]["action"]["names"] == list(JOINT_NAMES)
    tasks = parquet.read_table(data_set / "meta" / "tasks.parquet")
    assert tasks.to_pylist() == [{"task_index": 0, "task": "Hold the board."}]
    assert tasks.schema.pandas_metadata["index_columns"] == ["task"]


@pytest.fixture(scope="module")
def filmed(golden: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A data set of the first six seconds of the golden session, twice, with a camera at 10 Hz
    whose pictures brighten with time. After three seconds the clock is set ahead by an hour.
    """
    pytest.importorskip("av", reason="videos need the extra `video`")
    path = tmp_path_factory.mktemp("filmed") / "filmed.mcap"
    with copied(Recording.open(golden), path) as (recorder, steps):
        for tick, step in itertools.islice(steps, 3000):
            time_ns = step.time_ns + 3_600_000_000_000 * (tick.index >= 1500)
            recorder.write(tick, step.frame, time_ns=time_ns)
            if tick.index % 50 == 0:
                image = encode_image(
                    CompressedImage(time_ns, "lens", "jpeg", grey(tick.index // 20))
                )
                recorder.image("camera/front", image, time_ns)
    folder = path.parent / "data"
    assert converted(folder, path, path, "--task", "Hold.") == 0
    return folder


def test_a_camera_is_a_video_with_a_picture_for_each_row(filmed: Path) -> None:
    av = pytest.importorskip("av")
    name = "observation.images.camera_front"
    info = json.loads((filmed / "meta" / "info.json").read_text())
    feature = info["features"][name]
    fps = info["fps"]
    assert (feature["dtype"], feature["shape"], feature["names"]) == (
        "video",
        [48, 64, 3],
        ["height", "width", "channels"],
    )
    rows = parquet.read_table(filmed / "data" / FIRST).to_pydict()
    assert name not in rows
    first, second = parquet.read_table(filmed / "meta" / "episodes" / FIRST).to_pylist()
    assert first[f"videos/{name}/from_timestamp"] == 0.0
    assert (
        first[f"videos/{name}/to_timestamp"]
        == second[f"videos/{name}/from_timestamp"]
        == first["length"] / fps
    )
    path = filmed / info["video_path"].format(video_key=name, chunk_index=0, file_index=0)
    with av.open(str(path)) as container:
        stream = container.streams.video[0]
        assert (stream.codec_context.name, stream.average_rate) == (
            feature["info"]["video.codec"],
            fps,
        )
        pictures = [
            (float(picture.pts * stream.time_base), picture.to_ndarray(format="rgb24").mean())
            for picture in container.decode(stream)
        ]
    assert len(pictures) == info["total_frames"] == len(rows["index"])
    np.testing.assert_allclose(
        [time_s for time_s, _ in pictures], np.arange(len(pictures)) / fps, atol=1e-4
    )
    # tick of the first row, accurate to half a row
    began = 3000 - 1 - round((first["length"] - 1) / fps * 500)
    expected = [(began + row / fps * 500) // 50 * 2.5 for row in rows["frame_index"]]
    assert np.abs(np.array([level for _, level in pictures]) - expected).max() < 5.0
    stats = json.loads((filmed / "meta" / "stats.json").read_text())[name]
    assert np.shape(stats["mean"]) == (3, 1, 1)
    assert stats["mean"][0][0][0] == pytest.approx(np.mean(expected) / 255, abs=0.02)


def test_lerobot_itself_loads_it(data_set: Path) -> None:
    loader = pytest.importorskip(
        "lerobot.datasets.lerobot_dataset", reason="lerobot brings PyTorch: not installed"
    )
    loaded = loader.LeRobotDataset(
        "local/thirdhand", root=data_set, delta_timestamps={"action": [0.0, 1 / 30]}
    )
    assert (loaded.num_episodes, loaded.fps) == (3, 30)
    item = loaded[loaded.meta.episodes["dataset_to_index"][0]]
    assert item["task"] == "Hold the board."
    assert (int(item["episode_index"]), int(item["frame_index"]), tuple(item["action"].shape)) == (
        1,
        0,
        (2, 7),
    )
    rows = parquet.read_table(data_set / "data" / FIRST)
    assert len(loaded) == len(rows)
    for i in range(0, len(loaded), 50):
        assert loaded[i]["action"][0].tolist() == rows["action"][i].as_py()
        assert loaded[i]["observation.state"].tolist() == rows["observation.state"][i].as_py()


def test_full_disk_leaves_nothing_behind(
    skill: StoredSkill, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The next attempt succeeds."""
    path = record(tmp_path / "a.mcap", skill, resting(0, 100))
    with small_disk(tmp_path / "disk", "24k") as disk:
        assert converted(disk / "data", path) == 1
        assert (
            f"{disk}/data: No space left on device; room on that disk needed"
            in capsys.readouterr().err
        )
        assert list(disk.iterdir()) == []
        subprocess.run(["mount", "-o", "remount,size=4m", disk], check=True)
        assert converted(disk / "data", path) == 0


def test_there_are_no_data_sets_of_two_arms_or_of_nothing(
    skill: StoredSkill, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    followed = record(tmp_path / "a.mcap", skill, resting(0, 100))
    puma = URDF.replace('"wam"', '"puma"', 1)
    of_another = record(tmp_path / "b.mcap", skill, resting(0, 100), urdf=puma)
    alone = record(tmp_path / "c.mcap", skill, [Tick(k) for k in range(100)])
    for files, why in (
        ([followed, of_another], "one arm is needed"),
        ([alone], "nothing was commanded after both hands had been seen"),
    ):
        assert converted(tmp_path / "data", *files) == 1
        assert why in capsys.readouterr().err
        assert not (tmp_path / "data").exists()


@pytest.mark.parametrize(
    ("options", "code", "says"),
    [
        (["--lerobot", "."], 2, "--lerobot . exists already; a new folder needed"),
        (["--lerobot", "{}", "--fps", "0"], 2, "--fps"),
    ],
)
def test_what_makes_no_data_set_is_said(
    options: list[str],
    code: int,
    says: str,
    gapped: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    folder = tmp_path / "data"
    try:
        done = main(["report", str(gapped), *(option.format(folder) for option in options)])
    except SystemExit as end:
        done = int(str(end.code))
    assert (done, says in capsys.readouterr().err, folder.exists()) == (code, True, False)
