"""Where a Rerun scene goes: into a file, to live viewers, or both.

Frames are sent by columns, a batch at a time. Where a destination fails (full disk, used port) it
is given up and named in `problems`; the other goes on.
"""

from __future__ import annotations

import contextlib
import queue
import socket
import threading
import uuid
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import rerun as rr

from service.config import Settings
from service.contract.explain import ExplainedError
from service.core.frame import Record
from service.recorder.scene import Batch, Chunks, blueprint, log_fixed

FILE_BATCH_S, LIVE_BATCH_S = 1.0, 0.1
LIVE_MEMORY = "64MiB"
FLUSH_TIMEOUT_S = 5.0


class ViewerError(ExplainedError, RuntimeError):
    """Something that cannot be shown: says what, and what would help."""


class _Destination:
    """Where the scene goes: collects frames, sends them by batches."""

    def __init__(
        self, name: str, sink: Any, *, live: bool, urdf: Path, settings: Settings, recording_id: str, batch_s: float
    ) -> None:
        self._batch_ns = round(batch_s * 1e9)
        self._pending: Batch = []
        self._live, self._settings = live, settings
        self._tree = rr.urdf.UrdfTree.from_file_path(urdf, entity_path_prefix="arm")
        self._chunks = Chunks(self._tree, settings)
        self._stream = rr.RecordingStream("thirdhand", recording_id=recording_id)
        self.turn(name, sink)

    def turn(self, name: str, sink: Any) -> None:
        """From now on the scene goes elsewhere: what never changes is sent there first."""
        self.send()
        self.name = name
        self._chunks.begin_anew()
        self._stream.set_sinks(sink)
        self._stream.send_recording_name(self._settings.cell)
        self._stream.send_blueprint(blueprint(live=self._live))  # once: Rerun keeps 1.5 MB of each for good
        log_fixed(self._stream, self._tree, self._settings)
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
    """A server for live viewers, fed on a thread of its own: a viewer that stalls holds up nobody,
    the oldest batches are dropped.
    """

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
    """Draws frames as a Rerun scene into a file, for live viewers, or both.

    Where it fails is told in `problems`, not raised.
    """

    def __init__(
        self, *, urdf: Path, settings: Settings, rrd: Path | None = None, live_port: int | None = None
    ) -> None:
        self.problems: list[str] = []
        self.url: str | None = None
        self.rrd: str | None = None
        self._destinations: list[_Destination] = []
        self._file: _Destination | None = None
        self._common: dict[str, Any] = {
            "urdf": urdf,
            "settings": settings,
            "recording_id": f"{settings.cell}-{uuid.uuid4().hex[:12]}",
        }
        if rrd is not None:
            self.draw_into(rrd)
        if live_port is not None:
            with self._sparing("the live view", None):
                live = _Live(live_port, **self._common)
                self._destinations.append(live)
                self.url = live.url

    def draw_into(self, rrd: Path) -> None:
        """Ends the file drawn into, if there is one, and goes on in another.

        Each shows its part of the scene by itself; one endless file would fill the memory, which
        holds a list of all that was sent.
        """
        name, drawn = f"the drawing in {rrd}", self._file if self._file in self._destinations else None
        self.rrd = None
        with self._sparing(name, drawn):
            rrd.parent.mkdir(parents=True, exist_ok=True)
            rrd.open("wb").close()
            if drawn is None:
                self._file = _Destination(name, rr.FileSink(rrd), live=False, batch_s=FILE_BATCH_S, **self._common)
                self._destinations.append(self._file)
            else:
                drawn.turn(name, rr.FileSink(rrd))
            self.rrd = str(rrd)

    @contextlib.contextmanager
    def _sparing(self, name: str, destination: _Destination | None) -> Iterator[None]:
        """What goes wrong inside is noted, and ends the destination only."""
        try:
            yield
        except Exception as error:
            self.problems.append(f"{name} ended: {error}")
            if destination in self._destinations:
                self._destinations.remove(destination)
            if destination is not None and destination is self._file:
                self.rrd = None

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
