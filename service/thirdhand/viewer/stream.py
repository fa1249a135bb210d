"""The stream of a Rerun scene into a file, or to live viewers.

Frames are sent by columns, a batch at a time.
"""

from __future__ import annotations

import contextlib
import importlib.util
import socket
import sys
import time
import uuid
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import rerun as rr

from thirdhand.contract import cdr
from thirdhand.contract.explain import ExplainedError
from thirdhand.contract.images import CompressedImage
from thirdhand.contract.joint_states import measured
from thirdhand.contract.messages import SceneObject, WireError
from thirdhand.contract.printable import printable
from thirdhand.core.frame import Record
from thirdhand.core.intake.arm_samples import in_turn
from thirdhand.recordings.recording import OBJECTS_NOTE
from thirdhand.settings.config import Settings
from thirdhand.viewer import learned, scene_objects
from thirdhand.viewer.blueprint import blueprint
from thirdhand.viewer.dynamic import LOG_NS, DrawnFrame, DynamicScene
from thirdhand.viewer.learned import SkillContents
from thirdhand.viewer.sentences import sentence
from thirdhand.viewer.static import ArmModels, log_static

FILE_BATCH_S = 1.0
LIVE_BATCH_S = 0.2
# memory for viewers that connect later, without meshes: 20 s at 500 Hz, as curves show
LIVE_MB = 24
# interval at which live viewers get skill and objects again, as they connect late
SCENE_REPEAT_S = 10.0
# of the ticks between two frames, the largest is drawn
PEAKS = ("lateness_us", "work_us", "latency_us", "stages_us")


class ViewerError(ExplainedError, RuntimeError):
    """Something cannot be shown; the message says what, and what to do."""


class Viewer:
    """Draw frames as a Rerun scene into the file `rrd`, or for live viewers at a port; 0: any port.

    A file begins with the first frame, a live view with its start. Everything that is added is
    drawn: a slow reader delays the caller. Raises ViewerError for a port that is in use, and
    exceptions of Rerun for a file that cannot be written.
    """

    def __init__(
        self,
        *,
        urdf: Path,
        settings: Settings,
        skill: bytes | None = None,
        rrd: Path | None = None,
        live_port: int | None = None,
    ) -> None:
        self.url: str | None = None
        self._settings = settings
        self._live = live_port is not None
        self._batch_ticks = settings.ticks_in(LIVE_BATCH_S if self._live else FILE_BATCH_S)
        self._repeat_ticks = settings.ticks_in(SCENE_REPEAT_S)
        self._pending: list[DrawnFrame] = []
        self._position: tuple[float, ...] | None = None  # of the joints, as measured last
        # of the newest tick, with the peaks since the last frame
        self._timing: Record | None = None
        self._after_gap = False
        self._skill = b""
        self._contents: SkillContents | None = None  # of the skill
        self._objects: tuple[SceneObject, ...] = ()
        # times [ns], objects: to be sent with the frames
        self._moved: list[tuple[int, tuple[SceneObject, ...]]] = []
        self._repeated_ns = 0
        self._repeated_tick = 0

        self.models = ArmModels(urdf, settings)
        # for the log, with the next frame
        self._remarks = [self.models.remark] if self.models.remark else []
        start_ms = time.time_ns() // 1_000_000
        self._dynamic = DynamicScene(
            self.models, settings, start_ns=1_000_000 * start_ms if self._live else None
        )
        if live_port is None:
            assert rrd is not None
            sink: Any = rr.FileSink(rrd)
            recording_id = f"{settings.cell}-{uuid.uuid4().hex[:12]}"
        else:
            port = _free_port(live_port)
            self.url = f"rerun+http://127.0.0.1:{port}/proxy"
            sink = rr.GrpcServerSink(
                "127.0.0.1", port, server_memory_limit=f"{LIVE_MB + self.models.mesh_mb}MiB"
            )
            # from this time a page computes a picture's age
            recording_id = f"{settings.cell}-{start_ms}"
        self._stream = rr.RecordingStream("thirdhand", recording_id=recording_id)
        self._stream.set_sinks(sink)
        self._stream.send_recording_name(settings.cell)
        if skill is not None:
            self.learn(skill)
        self._send_blueprint()
        log_static(self._stream, self.models, settings)
        self._stream.flush()

    def add(
        self,
        frame: Record | None,
        time_ns: int,
        timing: Record | None = None,
        events: Iterable[tuple[str, bytes]] = (),
    ) -> None:
        """Draw the frame of a tick at a time [ns], and the arm and skill in its `events` (kind,
        bytes). The events and timing of a tick without a frame are drawn with the next frame.
        """
        for kind, payload in events:
            if kind == "joints/state":
                self._measure(payload)
            elif kind == "skill":
                self.learn(payload)
        if timing is not None:
            self._timing = timing if self._timing is None else _with_peaks(self._timing, timing)
        if frame is None:
            return

        tick = int(frame["tick"])
        self._repeat(tick, time_ns)
        while self._remarks:
            self.log(self._remarks.pop(0), "WARN", time_ns)
        position = (
            None
            if self._position is None
            else in_turn(self._settings.joints, np.array(self._position), frame["joints"])
        )
        self._pending.append(DrawnFrame(frame, time_ns, self._timing, position, self._after_gap))
        self._timing = None
        self._after_gap = False
        if tick - int(self._pending[0].frame["tick"]) >= self._batch_ticks:
            self._send()

    def _measure(self, joint_state: bytes) -> None:
        """Take the joints of the arm from its state, if that can be decoded."""
        with contextlib.suppress(WireError):
            joints = cdr.decode_joints(joint_state)
            self._position = measured(joints, self._settings.joints.names)[0]

    def _repeat(self, tick: int, time_ns: int) -> None:
        """Put skill and objects at the begin, and to live viewers every SCENE_REPEAT_S."""
        is_due = self._live and tick - self._repeated_tick > self._repeat_ticks
        if is_due or not self._repeated_ns:
            self._repeated_tick = tick
            self._repeated_ns = time_ns
            self._put_skill()
            self._put_objects(time_ns)

    def learn(self, skill: bytes) -> None:
        """Draw a skill's demonstrations and via-points from now on."""
        if skill == self._skill:
            return
        self._skill = skill
        try:
            contents = learned.skill_contents(skill)
        except ValueError as error:
            self._remarks.append(str(error))
            return
        self._contents = contents
        self._dynamic.set_gate(contents.threshold)
        if self._repeated_ns:
            self._send()
            self._put_skill()
            self._put_objects(self._repeated_ns)

    def note(self, key: str, text: str, time_ns: int) -> None:
        """Show a note: objects on the bench, or a line in the log (a warning under `log`)."""
        if key == OBJECTS_NOTE:
            self._show_objects(msgspec.json.decode(text, type=tuple[SceneObject, ...]), time_ns)
        else:
            self.log(sentence(text), "WARN" if key == "log" else "INFO", time_ns)

    def image(self, key: str, image: CompressedImage, time_ns: int) -> None:
        """Show an image under `cameras/<key>`."""
        if self._repeated_ns:
            column = rr.EncodedImage.columns(
                blob=[image.data], media_type=[f"image/{image.format}"]
            )
            self._put([self._at(time_ns)(f"/cameras/{key}", *column)])

    def log(self, text: str, level: str, time_ns: int) -> None:
        """Show a line in the log; level is INFO, WARN or ERROR."""
        line = rr.TextLog.columns(text=[printable(text)], level=[level])
        self._put([self._at(time_ns, to_ns=LOG_NS)("/log", *line)])

    def gap(self, text: str, time_ns: int) -> None:
        """Interrupt curves and trails before the next frame, and show the reason in the log."""
        self._after_gap = True
        self.log(text, "WARN", time_ns)

    def close(self) -> None:
        """Send what is pending, and end the file or the server. A file gets the ranges of its
        curves.
        """
        self._send()
        if not self._live and self._dynamic.end_s > 0:
            tops = {
                view: float(np.percentile(peaks, 95)) for view, peaks in self._dynamic.peaks.items()
            }
            self._send_blueprint(tops=tops, end_s=self._dynamic.end_s)
        self._stream.flush()
        self._stream.disconnect()

    def _send_blueprint(self, **curves: Any) -> None:
        gate_m = np.inf if self._contents is None else self._contents.threshold
        blueprint(self._settings, live=self._live, gate_m=gate_m, **curves).send_to(self._stream)

    def _put_skill(self) -> None:
        """Show the skill, once there are frames."""
        if self._contents is not None and self._repeated_ns:
            chunk_at = self._at(self._repeated_ns)
            self._put(list(learned.skill_chunks(self._contents, chunk_at)))

    def _show_objects(self, objects: tuple[SceneObject, ...], time_ns: int) -> None:
        previous = self._objects
        self._objects = objects
        if not self._repeated_ns or objects == previous:
            return
        if scene_objects.are_the_same(previous, objects):
            self._moved.append((time_ns, objects))
        else:
            self._send_moved()
            self._put_objects(time_ns, previous)

    def _put_objects(self, time_ns: int, previous: Iterable[SceneObject] = ()) -> None:
        """Show the objects; an object whose name a via-point has gets no second label."""
        via_points = (
            () if self._contents is None else (point.name for point in self._contents.via_points)
        )
        names = (item.name for item in previous)
        self._put(
            list(scene_objects.object_chunks(self._objects, names, via_points, self._at(time_ns)))
        )

    def _at(self, time_ns: int, *, to_ns: int = 1) -> Callable[..., rr.chunk.Chunk]:
        """The function that makes a chunk of one row at this time [ns]."""
        index = self._dynamic.index(np.array([time_ns], np.int64), to_ns=to_ns)
        return lambda path, *columns: rr.chunk.Chunk.from_columns(path, index, list(columns))

    def _send(self) -> None:
        """Send what is pending."""
        if self._pending:
            batch = self._pending
            self._pending = []
            self._put(list(self._dynamic.chunks(batch)))
        self._send_moved()

    def _send_moved(self) -> None:
        """Send the objects' motion since the last batch in few chunks: a chunk of one row takes 50
        times as much of a file as a row.
        """
        if self._moved:
            moved = self._moved
            self._moved = []
            index = self._dynamic.index(np.array([time_ns for time_ns, _ in moved], np.int64))
            self._put(list(scene_objects.moved_chunks([objects for _, objects in moved], index)))

    def _put(self, chunks: list[rr.chunk.Chunk]) -> None:
        """Pass chunks to the stream, and wait for them: Rerun's queue has no limit."""
        self._stream.send_chunks(chunks)
        self._stream.flush()


def _with_peaks(earlier: Record, timing: Record) -> Record:
    """A tick's timing, with the larger times of the earlier one."""
    peaks = timing.copy()
    for name in PEAKS:
        peaks[name] = np.maximum(earlier[name], timing[name])
    return peaks


def _free_port(port: int) -> int:
    """The port of this machine, or a free one for 0. Raises ViewerError."""
    with socket.socket() as probe:
        try:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind(("127.0.0.1", port))
        except OSError as error:
            raise ViewerError(
                f"port {port} on 127.0.0.1: {error.strerror}; choose another, or 0 for any"
            ) from None
        return int(probe.getsockname()[1])


def rerun_program() -> Path:
    """The Rerun program that is installed with the library; it need not be on the path."""
    spec = importlib.util.find_spec("rerun_cli")
    if spec is None or spec.origin is None:
        raise ViewerError("the Rerun program is not installed: pip install 'thirdhand[view]'")
    return Path(spec.origin).with_name("rerun.exe" if sys.platform == "win32" else "rerun")
