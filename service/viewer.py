"""The viewer's tap: frames become a Rerun scene, in a file, live, or both. Also a recording made into such a file, and a picture of one.

Frames are sent by columns, a batch at a time. Where a destination fails (full disk, used port) it is given up and named in `problems`; the other
goes on.
"""

from __future__ import annotations

import contextlib
import importlib.util
import os
import queue
import socket
import subprocess
import sys
import tempfile
import threading
import time as clock
import uuid
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import rerun as rr

from service.config import ExplainedError, Settings
from service.drawing import Batch, Chunks, blueprint, log_fixed
from service.frame import Record
from service.recording import Recording

FILE_BATCH_S, LIVE_BATCH_S = 1.0, 0.1
LIVE_MEMORY = "64MiB"
FLUSH_TIMEOUT_S = 5.0


class ViewerError(ExplainedError, RuntimeError):
    """Something that cannot be shown: says what, and what would help."""


class _Destination:
    """Where the scene goes: collects frames, sends them by batches."""

    def __init__(self, name: str, sink: Any, *, live: bool, urdf: Path, settings: Settings, recording_id: str, batch_s: float) -> None:
        self.name = name
        self._batch_ns = round(batch_s * 1e9)
        self._pending: Batch = []
        tree = rr.urdf.UrdfTree.from_file_path(urdf, entity_path_prefix="arm")
        self._chunks = Chunks(tree, settings.rate_hz)
        self._stream = rr.RecordingStream("thirdhand", recording_id=recording_id)
        arrangement = blueprint(live=live)
        self._stream.set_sinks(sink, default_blueprint=arrangement)
        self._stream.send_recording_name(settings.cell)
        self._stream.send_blueprint(arrangement)
        log_fixed(self._stream, tree)
        self._stream.flush(timeout_sec=FLUSH_TIMEOUT_S)

    def add(self, frame: Record, time_ns: int, timing: Record | None) -> None:
        """Takes in one frame."""
        self._pending.append((frame, time_ns, timing))
        if time_ns - self._pending[0][1] >= self._batch_ns:
            self.send()

    def log(self, text: str, level: str, time_ns: int) -> None:
        """Takes in one line of the log."""
        index = [rr.TimeColumn("time", timestamp=np.array([time_ns], "datetime64[ns]"))]
        self.put([rr.chunk.Chunk.from_columns("/log", index, rr.TextLog.columns(text=[text], level=[level]))])

    def send(self) -> None:
        """Sends what is pending."""
        if self._pending:
            batch, self._pending = self._pending, []
            self.put(list(self._chunks.of(batch)))

    def put(self, chunks: list[rr.chunk.Chunk]) -> None:
        """Hands chunks to the stream."""
        self._stream.send_chunks(chunks)

    def flush(self) -> None:
        """Sends what is pending; raises if it does not arrive."""
        self.send()
        self._stream.flush(timeout_sec=FLUSH_TIMEOUT_S)

    def close(self) -> None:
        """Ends the file or the server."""
        self.send()
        self._stream.disconnect()


class _Live(_Destination):
    """A server for live viewers, fed on a thread of its own: a viewer that stalls holds up nobody, the oldest batches are dropped."""

    def __init__(self, port: int, **common: Any) -> None:
        with socket.socket() as probe:
            try:
                probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
                probe.bind(("127.0.0.1", port))
            except OSError as error:
                raise ViewerError(f"port {port} on 127.0.0.1: {error.strerror}; choose another, or 0 for any") from None
            port = probe.getsockname()[1]
        self.url = f"rerun+http://127.0.0.1:{port}/proxy"
        self._waiting: queue.Queue[list[rr.chunk.Chunk] | None] = queue.Queue(maxsize=100)
        sink = rr.GrpcServerSink("127.0.0.1", port, server_memory_limit=LIVE_MEMORY)
        super().__init__(f"the live view at {self.url}", sink, live=True, batch_s=LIVE_BATCH_S, **common)
        self._thread = threading.Thread(target=self._feed, name="live view", daemon=True)
        self._thread.start()

    def _feed(self) -> None:
        while (chunks := self._waiting.get()) is not None:
            self._stream.send_chunks(chunks)

    def put(self, chunks: list[rr.chunk.Chunk] | None) -> None:
        while True:
            try:
                return self._waiting.put_nowait(chunks)
            except queue.Full:
                with contextlib.suppress(queue.Empty):
                    self._waiting.get_nowait()

    def flush(self) -> None:
        self.send()

    def close(self) -> None:
        self.send()
        self.put(None)
        self._thread.join(FLUSH_TIMEOUT_S)
        if not self._thread.is_alive():
            self._stream.disconnect()


class Viewer:
    """Draws frames as a Rerun scene into a file, for live viewers, or both. Where it fails is told in `problems`, not raised."""

    def __init__(self, *, cell: str, urdf: Path, settings: Settings, rrd: Path | None = None, live_port: int | None = None) -> None:
        self.problems: list[str] = []
        self.url: str | None = None
        self.rrd: str | None = None
        self._destinations: list[_Destination] = []
        common: dict[str, Any] = {"urdf": urdf, "settings": settings, "recording_id": f"{cell}-{uuid.uuid4().hex[:12]}"}
        if rrd is not None:
            with self._sparing(f"the drawing in {rrd}", None):
                rrd.parent.mkdir(parents=True, exist_ok=True)
                rrd.open("wb").close()
                self._destinations.append(_Destination(f"the drawing in {rrd}", rr.FileSink(rrd), live=False, batch_s=FILE_BATCH_S, **common))
                self.rrd = str(rrd)
        if live_port is not None:
            with self._sparing("the live view", None):
                live = _Live(live_port, **common)
                self._destinations.append(live)
                self.url = live.url

    @contextlib.contextmanager
    def _sparing(self, name: str, destination: _Destination | None) -> Iterator[None]:
        """What goes wrong inside is noted, and ends the destination only."""
        try:
            yield
        except Exception as error:
            self.problems.append(f"{name} ended: {error}")
            if destination in self._destinations:
                self._destinations.remove(destination)

    def _each(self, act: Callable[[_Destination], None]) -> None:
        for destination in list(self._destinations):
            with self._sparing(destination.name, destination):
                act(destination)

    def add(self, frame: Record, time_ns: int, timing: Record | None = None) -> None:
        """Draws a frame at a time [ns]."""
        self._each(lambda destination: destination.add(frame, time_ns, timing))

    def log(self, text: str, level: str, time_ns: int) -> None:
        """Shows a line in the log; level is INFO, WARN or ERROR."""
        self._each(lambda destination: destination.log(text, level, time_ns))

    def flush(self) -> None:
        """Sends what is pending and sees to it that the file has it."""
        self._each(lambda destination: destination.flush())

    def close(self) -> None:
        """Ends the file and the live view."""
        self._each(lambda destination: destination.flush())
        self._each(lambda destination: destination.close())
        self._destinations = []


def convert(recording_path: str | Path, rrd_path: str | Path) -> int:
    """The number of ticks of a recording drawn into a Rerun file. Raises RecordingError and ViewerError."""
    recording = Recording.open(recording_path)
    with tempfile.TemporaryDirectory() as folder:
        urdf = Path(folder) / "arm.urdf"
        urdf.write_text(recording.urdf, encoding="utf-8")
        viewer = Viewer(cell=recording.settings.cell, urdf=urdf, settings=recording.settings, rrd=Path(rrd_path))
        notes = recording.notes("requests", "log")
        note = next(notes, None)
        count = 0
        for step in recording.steps():
            if step.frame is None:
                continue
            time_ns = step.time_ns
            while note is not None and note[2] <= time_ns:
                viewer.log(note[1], "INFO" if note[0] == "requests" else "WARN", note[2])
                note = next(notes, None)
            viewer.add(step.frame, time_ns, step.timing)
            count += 1
        viewer.close()
    if viewer.problems:
        raise ViewerError("; ".join(viewer.problems))
    return count


def screenshot(source: str | Path, png: str | Path, *, time: float | None = None) -> None:
    """Saves a picture of a Rerun file or live view, `time` [s] after its start or at its end. Raises ViewerError."""
    from rerun.experimental import ViewerClient

    if "://" not in str(source) and not Path(source).is_file():
        raise ViewerError(f"nothing to picture: there is no {source}")
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    os.environ.setdefault("RUST_LOG", "error")  # or its remarks cover the picture
    os.environ.setdefault("XDG_RUNTIME_DIR", tempfile.gettempdir())  # or its graphics library complains
    try:
        with ViewerClient.spawn(headless=True, port=port, hide_welcome_screen=True, executable_path=str(_executable())) as client:
            client.open(str(source if "://" in str(source) else Path(source).absolute()))
            _wait(lambda: _extent(client) is not None and ("://" in str(source) or not client.get_state().loading))
            extent = _extent(client)
            if extent is None:
                raise ViewerError(f"no picture of {source}: it holds nothing yet")
            start, end = extent
            at = end if time is None else min(end, start + round(time * 1e9))
            if time is None and "://" in str(source):
                client.set_time("time", play_state="following")
            else:
                client.set_time("time", timestamp=np.datetime64(at, "ns"), play_state="paused")
            _settled(client, Path(png).absolute())
    except ViewerError:
        raise
    except (RuntimeError, ConnectionError, TimeoutError, OSError) as error:
        hint = "drawing without a screen needs a Vulkan driver: on Debian, apt install mesa-vulkan-drivers"
        raise ViewerError(f"no picture of {source}: {error} ({hint})") from error


def show(source: str | Path) -> int:
    """The exit code of the Rerun viewer, opened on a file or a live view, once its window is closed."""
    return subprocess.run([_executable(), str(source)], check=False).returncode


def _extent(client: Any) -> tuple[int, int] | None:
    """Start and end [ns] of what is loaded, None before there is anything."""
    lines = [line for recording in client.get_state().recordings for line in recording.timelines if line.name == "time"]
    return next(((line.start, line.end) for line in lines if line.start is not None and line.end is not None), None)


def _settled(client: Any, png: Path) -> None:
    """Saves the picture once two in a row are the same: data are loaded and remarks gone."""
    seen: list[bytes] = []

    def same() -> bool:
        client.save_screenshot(str(png))
        seen.append(png.read_bytes())
        return len(seen) >= 8 and seen[-1] == seen[-2] == seen[-3]

    _wait(same, timeout_s=10.0)


def _wait(done: Callable[[], bool], timeout_s: float = 30.0) -> None:
    deadline = clock.monotonic() + timeout_s
    while not done():
        if clock.monotonic() > deadline:
            return
        clock.sleep(0.3)


def _executable() -> Path:
    """The Rerun program that came with the library: it need not be on the path."""
    found = importlib.util.find_spec("rerun_cli")
    if found is None or found.origin is None:
        raise ViewerError("the Rerun program is not installed: pip install rerun-sdk")
    return Path(found.origin).with_name("rerun.exe" if sys.platform == "win32" else "rerun")
