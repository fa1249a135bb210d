"""Files and folders that are written completely or not at all."""

from __future__ import annotations

import os
import stat
from pathlib import Path

import pytest

from thirdhand.settings.whole_file import whole


def test_a_file_and_a_folder_appear_once_they_are_complete(tmp_path: Path) -> None:
    file = tmp_path / "a.txt"
    folder = tmp_path / "data"
    link = tmp_path / "link"
    file.write_text("before")
    file.chmod(0o600)
    link.symlink_to(file)
    with whole(link) as part:
        part.write_text("after")
        assert file.read_text() == "before"
    assert (file.read_text(), link.is_symlink(), stat.S_IMODE(file.stat().st_mode)) == (
        "after",
        True,
        0o600,
    )
    with whole(folder) as part:
        (part / "meta").mkdir(parents=True)
        assert not folder.exists()
    assert [path.name for path in sorted(tmp_path.rglob("*"))] == ["a.txt", "data", "meta", "link"]


def _write_half(path: Path, error: BaseException) -> None:
    path.parent.mkdir(exist_ok=True)
    path.write_text("half")
    raise error


@pytest.mark.parametrize(
    "error", [OSError(28, "Detail: [errno 28]"), KeyboardInterrupt()], ids=["full", "interrupt"]
)
@pytest.mark.parametrize("kind", ["file", "folder"])
def test_a_failure_leaves_nothing_and_names_the_path(
    kind: str, error: BaseException, tmp_path: Path
) -> None:
    (tmp_path / "earlier").write_text("before")
    (tmp_path / ".new.part").mkdir()  # left by a killed process
    for name in ("new", "earlier"):
        with pytest.raises(type(error)) as raised, whole(tmp_path / name) as part:
            _write_half(part if kind == "file" else part / "inside", error)
        if isinstance(error, OSError):
            expected = OSError(28, os.strerror(28), str(tmp_path / name))
            assert str(raised.value) == str(expected)
    assert [path.name for path in tmp_path.iterdir()] == ["earlier"]
    assert (tmp_path / "earlier").read_text() == "before"


def test_a_pipe_is_written_directly(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    with whole(tmp_path / "pipe") as part:
        assert part == tmp_path / "pipe"
