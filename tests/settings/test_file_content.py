"""Files given by users are read completely, or refused at once with the cause, whatever is at the
path.
"""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest

from thirdhand.contract.explain import in_words
from thirdhand.settings.file_content import UnusableError, content

LARGEST = 1000


@pytest.fixture(autouse=True)
def at_once() -> Iterator[None]:
    """Fail tests in which a reader waits for a pipe or reads without end."""

    def fail(*_: object) -> None:
        raise AssertionError("it waits for what no file holds")

    before = signal.signal(signal.SIGALRM, fail)
    signal.alarm(30)
    yield
    signal.alarm(0)
    signal.signal(signal.SIGALRM, before)


def odd(folder: Path, kind: str) -> Path:
    """A path of something that has no content to read."""
    path = folder / "odd"
    if kind == "a pipe":
        os.mkfifo(path)
    elif kind == "a folder":
        path.mkdir()
    return {"a device without end": Path("/dev/zero"), "a full device": Path("/dev/full")}.get(
        kind, path
    )


KINDS = ("a device without end", "a full device", "a pipe", "a folder", "nothing")


@pytest.mark.parametrize("kind", KINDS)
def test_what_is_no_file_is_refused_with_the_cause(tmp_path: Path, kind: str) -> None:
    with pytest.raises((OSError, UnusableError)) as refused:
        content(odd(tmp_path, kind), LARGEST)
    reasons = {
        "a folder": "Is a directory; a file needed, and that is a folder",
        "nothing": "No such file or directory",
    }
    assert in_words(refused.value, named=False) == reasons.get(kind, "it is not a file")


@pytest.mark.parametrize("size", [0, 1, LARGEST - 1, LARGEST, LARGEST + 1, 50 * LARGEST])
@pytest.mark.parametrize("is_pipe", [True, False])
def test_a_file_or_pipe_is_read_whole_up_to_what_is_accepted(
    tmp_path: Path, size: int, is_pipe: bool
) -> None:
    path = tmp_path / "file"
    data = os.urandom(size)
    if is_pipe:
        ends = os.pipe()
        path = Path(f"/dev/fd/{ends[0]}")
        writer = threading.Thread(target=lambda: (os.write(ends[1], data), os.close(ends[1])))
        writer.start()
    else:
        path.write_bytes(data)
    try:
        if size > LARGEST:
            with pytest.raises(UnusableError, match=f"{LARGEST}"):
                content(path, LARGEST, accepts_pipes=True)
        else:
            assert content(path, LARGEST, accepts_pipes=True) == data
    finally:
        if is_pipe:
            writer.join()
            os.close(ends[0])
