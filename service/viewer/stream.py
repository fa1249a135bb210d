"""The stream of a Rerun scene into a file, to live viewers, or both.

Frames are sent by columns, a batch at a time. A destination that fails (full disk, used port) is
closed and named in `problems`; the other one continues.
"""

from __future__ import annotations

import contextlib
import importlib.util
import socket
import sys
import threading
import time
import uuid
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import rerun as rr
from numpy.typing import NDArray

from service.contract import cdr
from service.contract.explain import ExplainedError, in_words
from service.contract.images import CompressedImage
from service.contract.joint_states import measured
from service.contract.messages import SceneObject, WireError
from service.contract.printable import printable
from service.core.frame import Record
from service.core.intake.arm_samples import in_turn
from service.files.recording import OBJECTS_NOTE
from service.files.shipped import skills_folder
from service.learning.demonstration import Demonstration
from service.settings.config import Settings
from service.viewer import learned, scene_objects
from service.viewer.blueprint import blueprint
from service.viewer.dynamic import LOG_NS, DrawnFrame, DynamicScene
from service.viewer.learned import SkillContents
from service.viewer.sentences import sentence
from service.viewer.static import ArmModels, log_static
from service.viewer.thinning import Thinning

FILE_BATCH_S, LIVE_BATCH_S = 1.0, 0.2
THIN_BATCH_S = 10.0  # batch of a file with a budget, because each batch takes 50 kB beside its frames
IMAGE_EVERY_S = 2.0  # interval of images in a file with a budget
LIVE_MB = 24  # memory for viewers that connect later, without meshes: 20 s at 500 Hz, as curves show
LIVE_WAITING = 5  # batches that wait for a slow viewer; beyond it, the oldest are left out
FLUSH_TIMEOUT_S = 5.0
SCENE_REPEAT_S = 10.0  # interval at which live viewers get skill and objects again, as they connect late


class ViewerError(ExplainedError, RuntimeError):
    """Something cannot be shown; the message says what, and what to do."""


class _Destination:
    """One destination of the scene: collects frames, and sends them in batches."""

    def __init__(
        self,
        name: str,
        sink: Any,
        path: Path | None = None,
        *,
        live: bool,
        batch_s: float,
        urdf: Path,
        settings: Settings,
        recording_id: str,
        skill: tuple[SkillContents, list[Demonstration]] | None,
        thinning: Thinning | None = None,
    ) -> None:
        self._batch_ticks, self._repeat_ticks = settings.ticks_in(batch_s), settings.ticks_in(SCENE_REPEAT_S)
        self._thinning = thinning
        self._pending: list[DrawnFrame] = []
        self._live, self._settings = live, settings
        self.models = ArmModels(urdf, settings)
        self._dynamic = DynamicScene(self.models, settings, live=live)
        self._stream = rr.RecordingStream("thirdhand", recording_id=recording_id)
        self._skill = skill
        if skill is not None:
            self._dynamic.set_gate(skill[0].threshold)
        self._objects: tuple[SceneObject, ...] = ()
        self._moved: list[tuple[int, tuple[SceneObject, ...]]] = []  # times [ns], objects: to be sent with the frames
        self._image_ns: dict[str, int] = {}  # time [ns] of the newest image by key
        self._repeated_ns = self._repeated_tick = 0
        self._open = False
        self.redirect(name, sink, path)

    def redirect(self, name: str, sink: Any, path: Path | None = None) -> None:
        """Send the scene to another sink from now on, which may be the file at `path`.

        The static part is sent first; skill and objects follow with the first frame.
        """
        self._finish()
        self.name, self._path = name, path
        self._dynamic.restart()
        self._repeated_ns, self._open = 0, True
        self._stream.set_sinks(sink)
        self._stream.send_recording_name(self._settings.cell)
        blueprint(self._settings, live=self._live, gate_m=self._gate_m).send_to(self._stream)
        log_static(self._stream, self.models, self._settings)
        self._stream.flush(timeout_sec=FLUSH_TIMEOUT_S)
        if self._thinning is not None:
            self._thinning.restart(self._size())

    def _size(self) -> int:
        """Bytes in the file; 0 without a file."""
        with contextlib.suppress(OSError):
            return 0 if self._path is None else self._path.stat().st_size
        return 0

    def add(self, shown: DrawnFrame) -> None:
        """Add one frame."""
        tick = int(shown.frame["tick"])
        if not self._repeated_ns:
            self._repeat(tick, shown.time_ns)
            if self.models.remark:
                self.log(self.models.remark, "WARN", shown.time_ns)
        kept = shown if self._thinning is None else self._thinning.kept(shown)
        if kept is not None:
            self._pending.append(kept)
        if self._pending and tick - int(self._pending[0].frame["tick"]) >= self._batch_ticks:
            self.send()
        if self._live and tick - self._repeated_tick > self._repeat_ticks:
            self._repeat(tick, shown.time_ns)

    def _repeat(self, tick: int, time_ns: int) -> None:
        """Send skill and objects, also for viewers that connect later."""
        self._repeated_tick, self._repeated_ns = tick, time_ns
        if self._skill is not None:
            self.put(list(learned.skill_chunks(*self._skill, self._at(time_ns))))
        self._put_objects(time_ns)

    def learn(self, skill: SkillContents, demonstrations: list[Demonstration]) -> None:
        """Show the skill that is in force from now on."""
        self._skill = skill, demonstrations
        self._dynamic.set_gate(skill.threshold)
        if self._repeated_ns:
            self.send()
            self.put(list(learned.skill_chunks(skill, demonstrations, self._at(self._repeated_ns))))
            self._put_objects(self._repeated_ns)

    def show_objects(self, objects: tuple[SceneObject, ...], time_ns: int) -> None:
        """Show the objects on the bench."""
        before, self._objects = self._objects, objects
        if not self._repeated_ns or objects == before:
            return
        if self._thinning is not None and scene_objects.are_the_same(before, objects):
            self._moved.append((time_ns, objects))
        else:
            self._send_moved()
            self._put_objects(time_ns, before)

    def _put_objects(self, time_ns: int, before: Iterable[SceneObject] = ()) -> None:
        """Show the objects; an object whose name a via-point has gets no second label."""
        places = () if self._skill is None else (point.name for point in self._skill[0].via_points)
        known = (one.name for one in before)
        self.put(list(scene_objects.object_chunks(self._objects, known, places, self._at(time_ns))))

    def show_image(self, key: str, image: CompressedImage, time_ns: int) -> None:
        """Add one image; with a budget, one of each camera in IMAGE_EVERY_S."""
        every_ns = 0 if self._thinning is None else IMAGE_EVERY_S * 1e9
        if self._repeated_ns and not 0 <= time_ns - self._image_ns.get(key, 0) < every_ns:
            self._image_ns[key] = time_ns
            column = rr.EncodedImage.columns(blob=[image.data], media_type=[f"image/{image.format}"])
            self.put([self._at(time_ns)(f"/cameras/{key}", *column)])

    def log(self, text: str, level: str, time_ns: int) -> None:
        """Add one line to the log."""
        self.put([self._at(time_ns, to_ns=LOG_NS)("/log", *rr.TextLog.columns(text=[text], level=[level]))])

    def _at(self, time_ns: int, *, to_ns: int = 1) -> Callable[..., rr.chunk.Chunk]:
        """The function that makes a chunk of one row at this time [ns]."""
        index = self._dynamic.index(np.array([time_ns], np.int64), to_ns=to_ns)
        return lambda path, *columns: rr.chunk.Chunk.from_columns(path, index, list(columns))

    def send(self) -> None:
        """Send what is pending."""
        if self._pending:
            batch, self._pending = self._pending, []
            if self._thinning is not None:
                self._thinning.sent(len(batch), self._size())
            self.put(list(self._dynamic.chunks(batch)))
        self._send_moved()

    def _send_moved(self) -> None:
        """Send the objects' motion since the last batch in few chunks: a chunk of one row takes 50
        times as much of a file as a row.
        """
        if self._moved:
            moved, self._moved = self._moved, []
            index = self._dynamic.index(np.array([time_ns for time_ns, _ in moved], np.int64))
            self.put(list(scene_objects.moved_chunks([objects for _, objects in moved], index)))

    def _finish(self) -> None:
        """Send what is pending; to a file also its blueprint, with the curves' ranges."""
        self.send()
        if self._open and not self._live and self._dynamic.end_s > 0:
            tops = {view: float(np.percentile(peaks, 95)) for view, peaks in self._dynamic.peaks.items()}
            curves: dict[str, Any] = {"tops": tops, "end_s": self._dynamic.end_s}
            blueprint(self._settings, live=False, gate_m=self._gate_m, **curves).send_to(self._stream)

    @property
    def _gate_m(self) -> float:
        return np.inf if self._skill is None else self._skill[0].threshold

    def put(self, chunks: list[rr.chunk.Chunk]) -> None:
        """Pass chunks to the stream."""
        self._stream.send_chunks(chunks)

    def flush(self) -> None:
        """Send what is pending; raises if it does not arrive."""
        self.send()
        self._stream.flush(timeout_sec=FLUSH_TIMEOUT_S)

    def close(self) -> None:
        """End the file or the server."""
        self._finish()
        self._stream.disconnect()


class _Live(_Destination):
    """A server for live viewers, fed on a thread of its own.

    A viewer that stalls does not delay the drawing: the oldest batches are left out. Seconds count
    from the time [ms] at the end of the recording's id, from which a page computes a picture's age.
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
        self._waiting: deque[list[rr.chunk.Chunk]] = deque(maxlen=LIVE_WAITING)
        self._come, self._ended, start_ms = threading.Event(), False, time.time_ns() // 1_000_000
        limit_mb = LIVE_MB + ArmModels(common["urdf"], common["settings"]).mesh_mb
        sink = rr.GrpcServerSink("127.0.0.1", port, server_memory_limit=f"{limit_mb}MiB")
        common |= {"recording_id": f"{common['settings'].cell}-{start_ms}", "live": True, "batch_s": LIVE_BATCH_S}
        super().__init__(f"the live view at {self.url}", sink, **common)
        self._dynamic.index(np.array([1_000_000 * start_ms]))  # seconds count from there
        self._thread = threading.Thread(target=self._feed, name="live view", daemon=True)
        self._thread.start()

    def _feed(self) -> None:
        while not self._ended and self._come.wait():
            self._come.clear()
            while self._waiting:
                self._stream.send_chunks(self._waiting.popleft())
                self._stream.flush()  # waits for the server; otherwise they queue up in Rerun without a limit

    def put(self, chunks: list[rr.chunk.Chunk]) -> None:
        self._waiting.append(chunks)
        self._come.set()

    def flush(self) -> None:
        self.send()

    def close(self) -> None:
        self.send()
        self._ended = True
        self._come.set()
        self._thread.join(FLUSH_TIMEOUT_S)
        if not self._thread.is_alive():
            self._stream.disconnect()


class Viewer:
    """Draw frames as a Rerun scene into a file, for live viewers, or both.

    Failures are listed in `problems`, not raised.
    """

    def __init__(
        self,
        *,
        urdf: Path,
        settings: Settings,
        skill: bytes | None = None,
        rrd: Path | None = None,
        live_port: int | None = None,
        mb_per_hour: float = 0.0,
    ) -> None:
        """`mb_per_hour` [MB/h] limits the growth of files, by leaving out frames; 0: no limit."""
        self.problems: list[str] = []
        self.url: str | None = None
        self.rrd: str | None = None
        self._settings = settings
        self._measured: NDArray[np.float64] | None = None
        self._skill, self._learned_from = b"", ""
        self._unread: SkillContents | None = None  # its demonstrations have not been read yet
        self._remarks: list[str] = []  # for the log, with the next frame
        self._demonstrations: list[Demonstration] = []
        self._destinations: list[_Destination] = []
        self._file: _Destination | None = None
        self._thinning: Thinning | None = None
        if mb_per_hour:
            segment_s = 60 * settings.files.segment_minutes
            self._thinning = Thinning(mb_per_hour, rate_hz=settings.rate_hz, segment_s=segment_s)
        self._common: dict[str, Any] = {
            "urdf": urdf,
            "settings": settings,
            "recording_id": f"{settings.cell}-{uuid.uuid4().hex[:12]}",
            "skill": None,
        }
        if skill is not None:
            self.learn(skill)
        if rrd is not None:
            self.draw_into(rrd)
        if live_port is not None:
            with self._contained("the live view", None):
                live = _Live(live_port, **self._common)
                self._destinations.append(live)
                self.url = live.url

    @property
    def arm_remark(self) -> str:
        """A sentence on meshes of the arm that are not drawn; empty if all are."""
        return next((one.models.remark for one in self._destinations), "")

    def draw_into(self, rrd: Path) -> None:
        """End the current file, if there is one, and continue in another.

        Each file can be viewed alone. One endless file would fill the memory, because Rerun keeps a
        list of what was sent. Files with a budget have no footer, for which it would keep more;
        `rerun rrd optimize` adds one.
        """
        name, drawn = f"the drawing in {rrd}", self._file if self._file in self._destinations else None
        self.rrd = None
        with self._contained(name, drawn):
            rrd.parent.mkdir(parents=True, exist_ok=True)
            rrd.open("wb").close()
            sink = rr.FileSink(rrd, write_footer=self._thinning is None)
            if drawn is None:
                batch_s = FILE_BATCH_S if self._thinning is None else THIN_BATCH_S
                thinned: dict[str, Any] = {"thinning": self._thinning, "batch_s": batch_s}
                self._file = _Destination(name, sink, rrd, live=False, **thinned, **self._common)
                self._destinations.append(self._file)
            else:
                drawn.redirect(name, sink, rrd)
            self.rrd = str(rrd)

    @contextlib.contextmanager
    def _contained(self, name: str, destination: _Destination | None) -> Iterator[None]:
        """Context in which an exception is noted in `problems`, and ends only this destination."""
        try:
            yield
        except Exception as error:
            self.problems.append(f"{name} ended: {in_words(error)}")
            if destination in self._destinations:
                self._destinations.remove(destination)
            if destination is not None and destination is self._file:
                self.rrd = None

    def _each(self, act: Callable[[_Destination], None]) -> None:
        for destination in list(self._destinations):
            with self._contained(destination.name, destination):
                act(destination)

    def add(
        self, frame: Record, time_ns: int, timing: Record | None = None, events: Iterable[tuple[str, bytes]] = ()
    ) -> None:
        """Draw a frame at a time [ns], and the arm and skill in its `events` (kind, bytes)."""
        for kind, payload in events:
            if kind == "joints/state":
                with contextlib.suppress(WireError):
                    joints = self._settings.joints
                    position = np.array(measured(cdr.decode_joints(payload), joints.names)[0])
                    self._measured = in_turn(joints, position, frame["joints"])
            elif kind == "skill":
                self.learn(payload)
        if self._unread is not None:
            found, self._unread = self._unread, None
            self._demonstrations = learned.demonstrations(found, skills_folder(self._settings))
            self._show(found)
        while self._remarks:
            self.log(self._remarks.pop(0), "WARN", time_ns)
        shown = DrawnFrame(frame, time_ns, timing, self._measured)
        self._each(lambda destination: destination.add(shown))

    def learn(self, skill: bytes) -> None:
        """Draw a skill's demonstrations and via-points from now on."""
        if skill == self._skill:
            return
        self._skill = skill
        try:
            found = learned.skill_contents(skill)
        except ValueError as error:
            self._remarks.append(str(error))
            return
        if found.learned_from != self._learned_from:
            self._learned_from, self._demonstrations = found.learned_from, []
            self._unread = found
        self._show(found)

    def _show(self, skill: SkillContents) -> None:
        self._common["skill"] = skill, self._demonstrations
        self._each(lambda destination: destination.learn(skill, self._demonstrations))

    def note(self, key: str, text: str, time_ns: int) -> None:
        """Show a note: objects on the bench, or a line in the log (a warning under `log`)."""
        if key == OBJECTS_NOTE:
            found = msgspec.json.decode(text, type=tuple[SceneObject, ...])
            self._each(lambda destination: destination.show_objects(found, time_ns))
        else:
            self.log(sentence(text), "WARN" if key == "log" else "INFO", time_ns)

    def image(self, key: str, image: CompressedImage, time_ns: int) -> None:
        """Show an image under `cameras/<key>`."""
        self._each(lambda destination: destination.show_image(key, image, time_ns))

    def log(self, text: str, level: str, time_ns: int) -> None:
        """Show a line in the log; level is INFO, WARN or ERROR."""
        shown = printable(text)
        self._each(lambda destination: destination.log(shown, level, time_ns))

    def flush(self) -> None:
        """Send what is pending, and wait until the file has it."""
        self._each(lambda destination: destination.flush())

    def close(self) -> None:
        """End the file and the live view."""
        self._each(lambda destination: destination.flush())
        self._each(lambda destination: destination.close())
        self._destinations = []


def rerun_program() -> Path:
    """The Rerun program that is installed with the library; it need not be on the path."""
    found = importlib.util.find_spec("rerun_cli")
    if found is None or found.origin is None:
        raise ViewerError("the Rerun program is not installed: pip install rerun-sdk")
    return Path(found.origin).with_name("rerun.exe" if sys.platform == "win32" else "rerun")
