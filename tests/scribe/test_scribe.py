"""The scribe: messages of the loop are recorded whatever happens to the scribe's process, and the
loop is not disturbed.
"""

from __future__ import annotations

import os
import shutil
import signal
import socket
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import msgspec
import pytest

from support.cell import is_running, until
from support.pictures import grey
from support.recorded import SKILL, at_ns, state_after, tell, ticks
from thirdhand.contract.images import CompressedImage, encode_image
from thirdhand.core.frame import Event, Tick, encode
from thirdhand.process import child
from thirdhand.process.child import Child, Progress
from thirdhand.recordings.recording import Recording
from thirdhand.scribe.protocol import pack, unpack
from thirdhand.scribe.scribe import Scribe
from thirdhand.settings.config import RecordingSettings, Settings

WHOLE = RecordingSettings(frames_hz=0)
SETTINGS = Settings(cell="hall/bench-1", rate_hz=50, recording=WHOLE)


@contextmanager
def scribe(settings: Settings = SETTINGS, **where: Any) -> Iterator[Scribe]:
    """A running scribe that is ended in any case."""
    writer = Scribe(settings, **where)
    try:
        writer.start(skill=SKILL, state=state_after(-1))
        assert writer.ready(60.0) == bool(where)
        yield writer
    finally:
        writer.close(10)


@pytest.mark.parametrize(
    "every", [{"state": None, "with_skill": False}, {"state": state_after(3), "with_skill": True}]
)
def test_a_message_tells_of_a_tick_all_there_is(every: dict[str, Any]) -> None:
    for tick, frame, timing in ticks(60):
        skills = [event.payload for event in tick.inbox if event.kind == "skill"] + [SKILL] * every[
            "with_skill"
        ]
        message = unpack(pack(tick, frame, timing, lost=7, **every), skills, joints=7)
        assert message.tick == Tick(
            tick.index, tuple(Event(event.kind, event.payload, None) for event in tick.inbox)
        )
        assert (encode(message.frame), encode(message.timing), message.lost) == (
            encode(frame),
            encode(timing),
            7,
        )
        assert (message.state is None) == (every["state"] is None)
        assert message.skill == (SKILL if every["with_skill"] else None)


def test_what_is_told_is_recorded(tmp_path: Path) -> None:
    settings = Settings(cell="hall/bench-1", rate_hz=50, recording=WHOLE)
    with scribe(settings, folder=tmp_path) as writer:
        sent = tell(writer, 200)
        writer.note("requests", "via_points add handover", at_ns(20))
        status = writer.status()
        assert (status["alive"], status["sent"], status["lost"], status["errors"]) == (
            True,
            200,
            0,
            [],
        )
        assert status["free_mb"] == pytest.approx(shutil.disk_usage(tmp_path).free / 1e6, rel=0.2)
    recording = Recording.open(status["recording"])
    first, *steps = recording.steps()
    assert Path(status["recording"]).name.startswith("hall-bench-1-2")
    assert (recording.settings, recording.skill, recording.truncated, first.tick) == (
        settings,
        SKILL,
        False,
        -1,
    )
    assert [step.events for step in steps] == [
        tuple((event.kind, event.payload) for event in tick.inbox) for tick, *_ in sent
    ]
    assert [encode(step.frame) for step in steps] == [encode(frame) for _, frame, _ in sent]
    # the next state follows after 10 s
    assert [step.tick for step in steps if step.state is not None] == [49]
    assert [text for _, text, _ in recording.notes("requests")] == ["via_points add handover"]


def test_images_of_a_camera_are_recorded_beside_the_ticks(tmp_path: Path) -> None:
    with_camera = RecordingSettings(also=("camera/front",))
    settings = Settings(cell="hall/bench-1", rate_hz=50, recording=with_camera)
    images = [CompressedImage(at_ns(i), "lens", "jpeg", grey(40 + i)) for i in range(0, 60, 20)]
    with scribe(settings, folder=tmp_path) as writer:
        tell(writer, 40)
        for i, image in enumerate(images):
            writer.image("camera/front", encode_image(image), at_ns(40 + i))
        tell(writer, 160, first=40)
        status = writer.status()
        assert status["lost"] == 0
    recording = Recording.open(status["recording"])
    assert [*recording.images()] == [
        ("camera/front", image, at_ns(40 + i)) for i, image in enumerate(images)
    ]
    assert len(list(recording.steps())) == 201


def test_stopped_process_costs_ticks_but_no_time(tmp_path: Path) -> None:
    """The recording shows the gap of a stopped process."""
    with scribe(recording=tmp_path / "a.mcap") as writer:
        pid = writer.status()["pid"]
        os.kill(pid, signal.SIGSTOP)
        durations = []
        cycle = list(ticks(40))
        for i in range(6000):
            tick, frame, timing = cycle[i % 40]
            began = time.perf_counter()
            writer.send(
                Tick(i, tick.inbox),
                frame,
                timing,
                state=lambda i=i: state_after(i),
                skill=b"another skill",
            )
            durations.append(time.perf_counter() - began)
        lost = writer.status()["lost"]
        assert lost > 100
        assert statistics.median(durations) < 5e-4
        os.kill(pid, signal.SIGCONT)
        index = 6000

        def told_again() -> bool:
            nonlocal index
            lost = writer.status()["lost"]
            tell(writer, 1, first=index, skill=b"another skill")
            index += 1
            return writer.status()["lost"] == lost

        until(told_again)
        lost = writer.status()["lost"]
    _, *steps = Recording.open(tmp_path / "a.mcap").steps()
    assert [(step.lost, step.skill) for step in steps if step.lost] == [(lost, b"another skill")]
    assert next(step for step in steps if step.lost).state is not None
    assert next(Recording.open(tmp_path / "a.mcap").notes("log"))[1].startswith(
        f"{lost} ticks before tick "
    )


def test_killed_process_is_replaced_with_a_new_recording(tmp_path: Path) -> None:
    """The new recording can be read alone."""
    with scribe(recording=tmp_path / "a.mcap", restart_s=0.0) as writer:
        tell(writer, 20)
        killed = writer.status()["pid"]
        os.kill(killed, signal.SIGKILL)
        until(lambda: not writer.status()["alive"])
        writer.supervise()
        tell(writer, 35, first=20, skill=b"another skill")
        assert writer.ready(60)
        status = writer.status()
        assert status["pid"] != killed
        # lost: the ticks that were not yet on disk
        assert (status["alive"], status["restarts"], status["lost"]) == (True, 1, 20)
        assert status["errors"] == ["the scribe ended with code -9"]
    recording = Recording.open(tmp_path / "a-2.mcap")
    steps = list(recording.steps())
    assert recording.skill == b"another skill"
    assert [step.tick for step in steps] == list(range(20, 55))
    assert steps[0].lost == 20
    assert encode(steps[0].state) == encode(state_after(20))


def test_what_a_scribe_is_sent_before_it_exists_is_recorded(tmp_path: Path) -> None:
    """The process from which the scribe is forked has to import everything first."""
    child.end_server()
    writer = Scribe(SETTINGS, folder=tmp_path)
    began = time.perf_counter()
    writer.start(skill=SKILL, state=state_after(-1))
    tell(writer, 400)
    assert time.perf_counter() - began < 0.5
    assert not writer.ready(0.0)
    assert writer.close(60) == ""
    (path,) = tmp_path.glob("*.mcap")
    assert [step.tick for step in Recording.open(path).steps()] == list(range(-1, 400))


def test_everything_told_is_on_disk_when_the_loop_is_gone(tmp_path: Path) -> None:
    """The loop's process has ended."""
    with scribe(recording=tmp_path / "a.mcap") as writer:
        tell(writer, 300)
        pid = writer.status()["pid"]
        os.kill(pid, signal.SIGINT)
        os.kill(pid, signal.SIGTERM)
        assert writer.close(10) == ""
        assert writer.status()["errors"] == []
        tell(writer, 1, first=300)
        assert writer.status()["lost"] == 1
    recording = Recording.open(tmp_path / "a.mcap")
    assert len(list(recording.steps())) == 301
    assert not recording.truncated


def test_silent_process_is_replaced_and_its_gap_marked(tmp_path: Path) -> None:
    """The gap is what the process had not written."""
    with scribe(folder=tmp_path, restart_s=0.1, silent_s=1.0) as writer:
        tell(writer, 100)
        time.sleep(1.2)  # two flushes
        stopped = writer.status()["pid"]
        os.kill(stopped, signal.SIGSTOP)
        count = 100

        def replaced() -> bool:
            nonlocal count
            tell(writer, 2, first=count)
            count += 2
            writer.supervise()
            time.sleep(0.01)
            status = writer.status()
            return (
                status["pid"] != stopped and status["sent"] > 300 and status["state"] == "recording"
            )

        until(replaced)
        status = writer.status()
        assert "the scribe made no progress for 1 s, so it is replaced" in status["errors"]
        assert status["restarts"] == 1
        with pytest.raises(ProcessLookupError):
            os.kill(stopped, 0)
    first, second = (Recording.open(path) for path in sorted(tmp_path.glob("*.mcap")))
    indices = [step.tick for step in first.steps() if step.frame is not None]
    start, *steps = second.steps()
    assert indices == list(range(100))
    assert start.lost == start.tick - 100 == status["lost"]
    assert [step.tick for step in steps] == list(range(start.tick + 1, count))


@pytest.mark.thorough
@pytest.mark.parametrize("is_killed", [True, False])
def test_lost_ticks_are_those_not_on_disk(tmp_path: Path, is_killed: bool) -> None:
    """Thousands of ticks wait, and more reports arrive than the socket can hold unread. If the
    process is killed, one chunk may be on disk without a report.
    """
    count = 12_000
    chunk = 60
    with scribe(msgspec.structs.replace(SETTINGS, rate_hz=1000), folder=tmp_path) as writer:
        tell(writer, count)
        (path,) = tmp_path.glob("*.mcap")
        until(lambda: path.stat().st_size > 1_000_000)
        if is_killed:
            os.kill(writer.status()["pid"], signal.SIGKILL)
        words = writer.close(60)
    recorded = sum(step.frame is not None for step in Recording.open(path).steps())
    assert (recorded < count) is is_killed
    lost = int(words.split()[0]) if words else 0
    assert count - recorded <= lost <= count - recorded + chunk * is_killed


DAEMON = """
import os, signal, sys, time
from pathlib import Path
from thirdhand.settings.config import RecordingSettings, Settings
from thirdhand.scribe.scribe import Scribe
from support.recorded import SKILL, state_after, tell
one = Scribe(Settings(cell="hall/bench-1", rate_hz=50), folder=Path(sys.argv[1]))
one.start(skill=SKILL, state=state_after(-1))
assert one.ready(60)
pid = one.status()["pid"]
if sys.argv[2] == "stopped":
    os.kill(pid, signal.SIGSTOP)
tell(one, 300)
print(pid, flush=True)
os.kill(os.getpid(), signal.SIGKILL)
"""


@pytest.mark.parametrize("how", ["running", "stopped"])
def test_scribe_ends_with_its_daemon(tmp_path: Path, how: str) -> None:
    """Everything that it received is written."""
    command = [sys.executable, "-c", DAEMON, str(tmp_path), how]
    path = os.pathsep.join(sys.path)
    environment = os.environ | {"PYTHONPATH": path}
    done = subprocess.run(
        command, stdout=subprocess.PIPE, text=True, timeout=60, check=False, env=environment
    )
    assert done.returncode == -signal.SIGKILL
    until(lambda: not is_running(int(done.stdout)))
    (path,) = tmp_path.glob("*.mcap")
    recording = Recording.open(path)
    assert len(list(recording.steps())) == 301
    assert not recording.truncated


@pytest.mark.parametrize("place", ["/dev/full", "/dev/null/a.mcap"])
def test_unwritable_recording_spares_the_live_view(place: str) -> None:
    """The recording cannot be written, which is reported."""
    with scribe(recording=Path(place), live_port=0) as writer:
        tell(writer, 100)
        until(lambda: writer.supervise() or writer.status()["live"])
        status = writer.status()
    assert any(
        place in error and ("No space left" in error or "File exists" in error)
        for error in status["errors"]
    )
    assert status["recording"] is None
    assert status["live"].startswith("rerun+http://127.0.0.1:")


def test_no_process_without_anything_to_write() -> None:
    """Nothing is lost."""
    with scribe() as writer:
        tell(writer, 5)
        writer.note("requests", "x", 0)
        writer.supervise()
        status = writer.status()
    assert (status["pid"], status["alive"], status["lost"], status["errors"]) == (
        None,
        False,
        0,
        [],
    )


def test_a_skill_larger_than_a_message_is_told_and_recorded(tmp_path: Path) -> None:
    large = bytes(range(256)) * 20_000
    with scribe(recording=tmp_path / "a.mcap") as writer:
        (_, frame, timing), *_ = ticks(1)
        writer.keep(large)
        for i in range(8):
            writer.send(
                Tick(i, (Event("skill", large[i:], None),)),
                frame,
                timing,
                state=lambda: state_after(0),
                skill=large,
            )
        assert writer.status()["lost"] == 0
    _, *steps = Recording.open(tmp_path / "a.mcap").steps()
    assert [payload for step in steps for _, payload in step.events] == [
        large[i:] for i in range(8)
    ]


SLOW = """
import socket, time
def run(channel):
    channel.recv(1)
    end = time.process_time() + {busy}
    while time.process_time() < end:
        pass
    {then}
"""


@pytest.fixture
def slow_child(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[..., Child]]:
    """Children of an own fork server that compute for a time and then do something."""
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(tmp_path), *sys.path]))
    monkeypatch.setattr(child, "_server", server := child.ForkServer())
    started: list[Child] = []

    def begun(busy: float, then: str) -> Child:
        name = f"slow_{len(started)}"
        (tmp_path / f"{name}.py").write_text(SLOW.format(busy=busy, then=then))
        started.append(child.start("slow", name, socket.SOCK_STREAM))
        assert started[-1].has_begun(60.0)
        return started[-1]

    yield begun
    for process in started:
        process.kill()
        process.wait()
        process.socket.close()
    server.close()


@pytest.mark.thorough
def test_progress_tells_a_child_that_is_slow_from_one_that_hangs(
    slow_child: Callable[..., Child],
) -> None:
    """The slow child waits for a processor behind others. One hanging child sleeps, another
    computes.
    """

    def seconds_until_hung(one: Child, limit_s: float, most_s: float) -> float:
        progress = Progress(one)
        began = time.monotonic()
        one.socket.send(b"0")
        while (
            not progress.is_hung(limit_s)
            and time.monotonic() - began < most_s
            and one.poll() is None
        ):
            time.sleep(0.02)
        return time.monotonic() - began

    slow = slow_child(0.4, "channel.recv(1)")
    assert slow.pid is not None
    os.sched_setaffinity(slow.pid, {min(os.sched_getaffinity(0))})
    busy = (
        f"import os\nos.sched_setaffinity(0, {{{min(os.sched_getaffinity(0))}}})\nwhile True: pass"
    )
    hogs = [
        subprocess.Popen([sys.executable, "-c", busy], start_new_session=True) for _ in range(25)
    ]
    try:
        assert seconds_until_hung(slow, 1.0, 4.0) > 3.9
    finally:
        for hog in hogs:
            hog.kill()
            hog.wait()
    assert 1.0 < seconds_until_hung(slow_child(0.1, "channel.recv(1)"), 1.0, 20.0) < 15.0
    assert 1.0 < seconds_until_hung(slow_child(1e9, "pass"), 1.0, 60.0) < 50.0
    stopped = slow_child(1e9, "pass")
    stopped.send_signal(signal.SIGSTOP)
    assert 1.0 < seconds_until_hung(stopped, 1.0, 20.0) < 15.0
