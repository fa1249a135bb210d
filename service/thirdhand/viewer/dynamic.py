"""The dynamic part of the drawing: the scene at 100 Hz, curves at the full rate of the loop.

Where frames are missing, curves are interrupted and trails begin anew.
"""

from __future__ import annotations

import functools
import itertools
from collections import deque
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import numpy as np
import rerun as rr
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from thirdhand.contract.incidents import word
from thirdhand.contract.records import SIDES, Flag, Mode, Reason
from thirdhand.core.frame import STAGES, TIMING, Record
from thirdhand.core.geometry import between_segments, off_target, place
from thirdhand.core.separation import FARTHEST_REPORTED_M
from thirdhand.core.skill.model import REGION_95, standard_deviations
from thirdhand.core.skill.pose import CLOSED, UNKNOWN
from thirdhand.settings import palette
from thirdhand.settings.config import Settings
from thirdhand.viewer.banner import banner, log_line
from thirdhand.viewer.blueprint import TIMELINE
from thirdhand.viewer.static import ArmModels

SCENE_HZ = 100
SHOWN_TRAIL_S = 3.0
TRAIL_HZ = 20
TRAIL_BREAK_M = 0.15  # a longer step between two corners of a trail is not a motion of the hand
NEAREST_SHOWN_M = 0.5  # a nearer hand is connected with the arm by a line
SAME_M = 1e-5  # smaller differences of deviations come from rounding
TINY = 1e-4  # scale that makes the links of an arm invisible; the viewer rejects 0
LOG_NS = 100_000_000  # resolution of a log line's time: its column shows no more digits
PAUSE_FRAMES = 2  # a longer step between two frames, in intervals of a recording's frames, is a gap
BREAK_NS = 1000  # a curve ends this long after the last frame before a gap
# interval at which live viewers get the mode again, as they connect late or skip frames
REPEAT_S = 0.5
Columns = Callable[..., rr.chunk.Chunk]
Curve = Callable[..., Iterator[rr.chunk.Chunk]]


class DrawnFrame(NamedTuple):
    """A frame, its time [ns], its timing, the joints (J,) measured last [rad], and whether frames
    before it are missing.
    """

    frame: Record
    time_ns: int
    timing: Record | None
    measured: NDArray[np.float64] | None
    after_gap: bool = False


class DynamicScene:
    """Convert batches of frames into chunks, with the state that the next batch continues."""

    def __init__(
        self, models: ArmModels, settings: Settings, *, start_ns: int | None = None
    ) -> None:
        """Seconds count from `start_ns` [ns] in a live view, and from the first frame in a file."""
        rate_hz = settings.rate_hz
        names = settings.joints.names
        self._joints, self._ghost = (
            [model.get_joint_by_name(name) for name in names]
            for model in (models.commanded, models.measured)
        )
        self._live = start_ns is not None
        self._settings = settings
        self._repeat_ticks = settings.ticks_in(REPEAT_S)
        self._every = max(1, round(rate_hz / SCENE_HZ))
        self._trail_every = max(1, round(rate_hz / TRAIL_HZ))
        self._max_step_ticks = PAUSE_FRAMES * settings.frame_every
        self._period_ms = 1000.0 / rate_hz
        self._direction = settings.tool.orientation == "direction"
        self._stale_ticks = settings.ticks_in(settings.hands.stale_ms / 1000)
        self._trails: dict[str, deque[NDArray[np.float32]]] = {
            name: deque(maxlen=round(SHOWN_TRAIL_S * TRAIL_HZ)) for name in (*SIDES, "tool")
        }
        self._body = models.body
        people = settings.people
        toward = np.array(people.toward_elbow)
        self._forearm = people.length / np.linalg.norm(toward) * toward
        self._hand_radius = people.radius
        self._gate: float | None = None
        self._missed = 0
        self._followed = False
        self._shown: tuple[int, int, bool] | None = None
        self._mode_sent_tick = 0
        self._last_tick = -1
        self._last_ns = 0
        self._start_ns = start_ns
        self.end_s = 0.0
        self.peaks: dict[str, list[float]] = {}  # peaks of each view, one for each batch
        self._widths: dict[str, int] = {}  # number of values of each curve that has begun, by path

    def set_gate(self, deviation_m: float) -> None:
        """Set the deviation [m] above which the skill in force holds."""
        self._gate = deviation_m

    def index(self, times_ns: NDArray[np.int64], *, to_ns: int = 1) -> list[rr.TimeColumn]:
        """The time columns of these times [ns]; seconds since the start rounded to `to_ns`."""
        if self._start_ns is None:
            self._start_ns = int(times_ns[0])
        since = np.maximum(times_ns - self._start_ns, 0) // to_ns * to_ns
        self.end_s = max(self.end_s, float(since[-1]) / 1e9)
        return [
            rr.TimeColumn(TIMELINE, duration=since.view("timedelta64[ns]")),
            rr.TimeColumn("time", timestamp=times_ns.view("datetime64[ns]")),
        ]

    def chunks(self, batch: list[DrawnFrame]) -> Iterator[rr.chunk.Chunk]:
        """The chunks that show a batch of frames."""
        begin = 0
        for i, drawn in enumerate(batch):
            step_ticks = int(drawn.frame["tick"]) - int(
                batch[i - 1].frame["tick"] if i else self._last_tick
            )
            if drawn.after_gap or step_ticks > self._max_step_ticks:
                yield from self._unbroken(batch[begin:i])
                yield from self._interruption()
                begin = i
        yield from self._unbroken(batch[begin:])

    def _interruption(self) -> Iterator[rr.chunk.Chunk]:
        """The end of all curves and trails after the last frame."""
        for trail in self._trails.values():
            trail.clear()
        after_ns = np.array([self._last_ns + BREAK_NS], np.int64)
        for path, width in self._widths.items():
            index = [rr.TimeColumn("tick", sequence=[self._last_tick + 1]), *self.index(after_ns)]
            nothing = rr.Scalars.columns(scalars=[np.nan] * width).partition([width])
            yield rr.chunk.Chunk.from_columns(path, index, [*nothing])
        self._widths = {}

    def _unbroken(self, batch: list[DrawnFrame]) -> Iterator[rr.chunk.Chunk]:
        """The chunks that show frames between which none is missing."""
        if not batch:
            return
        frames = np.array([drawn.frame for drawn in batch])
        times = np.array([drawn.time_ns for drawn in batch], np.int64)
        ticks = frames["tick"]
        self.index(times[:1])
        columns = functools.partial(self._columns, ticks, times)

        is_seen = frames["hand_ages"] >= 0
        is_repeated = self._live and ticks[-1] - self._mode_sent_tick > self._repeat_ticks
        if batch[0].measured is None and (self._shown is None or is_repeated):
            yield from self._unmeasured(times[:1])
        yield from self._curves(batch, frames, is_seen, columns)
        yield from self._modes(frames, columns)

        before = np.concatenate([[self._last_tick], ticks[:-1]])
        self._last_tick = int(ticks[-1])
        self._last_ns = int(times[-1])
        sampled = np.flatnonzero(ticks // self._every != before // self._every)
        if len(sampled):
            yield from self._scene(batch, frames, sampled, is_seen, columns)
        corners = np.flatnonzero(ticks // self._trail_every != before // self._trail_every)
        if len(corners):
            yield from self._trail(frames, corners, columns)

    def _columns(
        self, ticks: NDArray[Any], times: NDArray[np.int64], path: str, rows: Any, *parts: Any
    ) -> rr.chunk.Chunk:
        """A chunk for these rows of a batch, given the ticks and times [ns] of all its rows."""
        to_ns = LOG_NS if path == "/log" else 1
        tick_column = rr.TimeColumn("tick", sequence=ticks[rows])
        index = [tick_column, *self.index(times[rows], to_ns=to_ns)]
        return rr.chunk.Chunk.from_columns(path, index, list(itertools.chain(*parts)))

    def _unmeasured(self, time_ns: NDArray[np.int64]) -> Iterator[rr.chunk.Chunk]:
        """The measured arm, too small to see: links without a pose are errors to the viewer."""
        for number, joint in enumerate(self._ghost):
            if joint is not None:
                size = rr.Transform3D.columns(scale=[(TINY, TINY, TINY)])
                pose = [*joint.compute_transform_columns([0.0], clamp=False), *size]
                yield rr.chunk.Chunk.from_columns(
                    f"/measured/joints/{number}", self.index(time_ns), pose
                )

    def _curves(
        self,
        batch: list[DrawnFrame],
        frames: NDArray[Any],
        seen: NDArray[np.bool_],
        columns: Columns,
    ) -> Iterator[rr.chunk.Chunk]:
        scalars = functools.partial(self._scalars, columns)
        yield from self._motion(frames, seen, scalars)
        is_predicted = _predicted(frames, seen)
        yield from self._target_errors(frames, is_predicted, scalars)
        yield from self._task(frames, is_predicted, scalars)
        yield from self._uncertainty(frames, is_predicted, scalars)
        yield from self._joint_errors(batch, frames, scalars)
        timed = [i for i, drawn in enumerate(batch) if drawn.timing is not None]
        if timed:
            timings = np.zeros(len(batch), TIMING)
            timings[timed] = [batch[i].timing for i in timed]
            yield from self._timings(timings, timed, scalars)
            yield from self._missed_deadlines(frames, timings, timed[-1], columns)
        ages_ms = np.where(seen, frames["hand_ages"] * self._period_ms, np.nan)
        yield from scalars("/age", np.flatnonzero(seen.any(axis=1)), ages_ms)

    def _scalars(
        self, columns: Columns, path: str, rows: Any, values: NDArray[Any], view: str = ""
    ) -> Iterator[rr.chunk.Chunk]:
        """The chunk of a curve, or of several, in these rows; their peak counts for the view."""
        samples = values[rows]
        if len(samples):
            peak = float(np.nanmax(np.abs(samples), initial=0.0))
            self.peaks.setdefault(view or path, []).append(peak)
            width = self._widths[path] = samples[0].size
            lengths = [width] * len(samples)
            yield columns(
                path, rows, rr.Scalars.columns(scalars=samples.ravel()).partition(lengths)
            )

    def _motion(
        self, frames: NDArray[Any], seen: NDArray[np.bool_], scalars: Curve
    ) -> Iterator[rr.chunk.Chunk]:
        """Motion of joints, tool and hands, and the distance of the nearest hand."""
        every = slice(None)
        yield from scalars("/joints/position", every, frames["joints"])
        yield from scalars("/joints/velocity", every, frames["joint_velocities"])
        yield from scalars("/joints/acceleration", every, frames["joint_accelerations"])
        tool_speeds = np.linalg.norm(frames["setpoint_velocity"], axis=1)
        yield from scalars("/speed/tool", every, tool_speeds, "/speed")
        for side, name in enumerate(SIDES):
            speeds = np.linalg.norm(frames["hand_velocities"][:, side], axis=1)
            yield from scalars(f"/speed/{name}", np.flatnonzero(seen[:, side]), speeds, "/speed")
        near = np.flatnonzero(seen.any(axis=1))
        yield from scalars("/separation/distance", near, frames["hand_distance"])
        yield from scalars("/separation/limit", near, frames["hand_limit"])

    def _target_errors(
        self, frames: NDArray[Any], is_predicted: NDArray[np.bool_], scalars: Curve
    ) -> Iterator[rr.chunk.Chunk]:
        """Distance and angle of the tool from its target, while the arm follows."""
        following = is_predicted & (frames["mode"] == Mode.FOLLOW)
        off_mm = np.where(
            following, 1e3 * np.linalg.norm(frames["target"] - frames["tool"], axis=1), np.nan
        )
        gap_starts = ~following & np.concatenate([[self._followed], following[:-1]])
        self._followed = bool(following[-1])
        drawn = np.flatnonzero(following | gap_starts)
        yield from scalars("/error/target", drawn, off_mm, "/error")
        yield from scalars("/turn/target", drawn, self._rotation_error(frames, following), "/turn")
        std_rad = standard_deviations(frames["orientation_covariance"])
        uncertain = np.flatnonzero(is_predicted & (std_rad > 0))
        yield from scalars("/turn/std", uncertain, np.degrees(std_rad), "/turn")

    def _task(
        self, frames: NDArray[Any], is_predicted: NDArray[np.bool_], scalars: Curve
    ) -> Iterator[rr.chunk.Chunk]:
        """Segment of the task, and closure of the gripper."""
        segmented = np.flatnonzero(frames["segment_belief"] > 0)
        yield from scalars("/segment/number", segmented, frames["segment"] + 1.0)
        yield from scalars("/segment/probable", segmented, frames["segment_belief"])
        gripping = is_predicted & (frames["closure"] >= 0)
        yield from scalars(
            "/gripper/predicted", np.flatnonzero(gripping), 100.0 * frames["closure"], "/gripper"
        )
        is_commanded = gripping & (frames["gripper"] != UNKNOWN)
        closed = 100.0 * (frames["gripper"] == CLOSED)
        yield from scalars("/gripper/commanded", np.flatnonzero(is_commanded), closed, "/gripper")

    def _uncertainty(
        self, frames: NDArray[Any], is_predicted: NDArray[np.bool_], scalars: Curve
    ) -> Iterator[rr.chunk.Chunk]:
        """Uncertainty of the target, and deviation of the hands with its gate."""
        std_m = standard_deviations(frames["covariance"])
        aimed = np.flatnonzero(is_predicted)
        uncertain = np.flatnonzero(is_predicted & (std_m > 0))
        yield from scalars("/deviation/target", uncertain, 1e3 * std_m, "/deviation")
        yield from scalars("/doubt/target", aimed, 100.0 * frames["error_probability"], "/doubt")
        # a gate that compares something else
        differs = is_predicted & (np.abs(frames["gate_m"] - std_m) > SAME_M)
        yield from scalars(
            "/deviation/hands", np.flatnonzero(differs), 1e3 * frames["gate_m"], "/deviation"
        )
        if self._gate is not None and len(aimed):
            gates_mm = np.full(len(frames), 1e3 * self._gate)
            yield from scalars("/deviation/gate", aimed[[0, -1]], gates_mm)

    def _joint_errors(
        self, batch: list[DrawnFrame], frames: NDArray[Any], scalars: Curve
    ) -> Iterator[rr.chunk.Chunk]:
        """Largest difference between measured and commanded joints."""
        measured = [
            i
            for i, drawn in enumerate(batch)
            if drawn.measured is not None and frames["commanded"][i]
        ]
        errors_rad = np.zeros(len(batch))
        errors_rad[measured] = [
            np.abs(batch[i].measured - frames["joints"][i]).max() for i in measured
        ]
        yield from scalars("/joints/error", measured, errors_rad)

    def _timings(
        self, timings: NDArray[Any], timed: list[int], scalars: Curve
    ) -> Iterator[rr.chunk.Chunk]:
        """Lateness, work and latency of the ticks with a timing."""
        yield from scalars("/timing/lateness", timed, timings["lateness_us"])
        yield from scalars("/timing/work", timed, timings["work_us"])
        stages_us = timings["stages_us"].reshape(-1, len(STAGES))
        yield from scalars("/timing/stages", timed, stages_us)
        answered = np.flatnonzero(timings["latency_us"] > 0)
        yield from scalars("/latency/hand", answered, timings["latency_us"] / 1e3, "/latency")

    def _missed_deadlines(
        self, frames: NDArray[Any], timings: NDArray[Any], newest: int, columns: Columns
    ) -> Iterator[rr.chunk.Chunk]:
        """A log line about deadlines that were missed since the last one, up to row `newest`."""
        missed = int(timings["missed"][newest])
        if missed > self._missed:
            count = missed - self._missed
            text = (
                f"{count} deadline{'s' * (count > 1)} missed before tick {frames['tick'][newest]}"
            )
            yield columns("/log", [newest], rr.TextLog.columns(text=[text], level=["WARN"]))
        self._missed = missed

    def _rotation_error(self, frames: NDArray[Any], following: NDArray[np.bool_]) -> NDArray[Any]:
        """Angle between tool and target (T,) [°], as `[tool] orientation` defines it; NaN while the
        arm does not follow.
        """
        angles = np.full(len(frames), np.nan)
        names = ("tool_orientation", "orientation")
        for name in names:  # a frame may be damaged
            following = following & (np.linalg.norm(frames[name], axis=1) > 0.5)
        tool, target = (frames[name][following] for name in names)
        angles[following] = np.degrees(off_target(tool, target, direction=self._direction))
        return angles

    def _modes(self, frames: NDArray[Any], columns: Columns) -> Iterator[rr.chunk.Chunk]:
        """Mode, reason and engaging where they change; to live viewers also every REPEAT_S."""
        changed = []
        sent = []
        ticks = frames["tick"].tolist()
        engaging = (frames["flags"] & int(Flag.ENGAGING) > 0).tolist()
        for i, outcome in enumerate(
            zip(frames["mode"].tolist(), frames["reason"].tolist(), engaging, strict=True)
        ):
            if outcome != self._shown:
                changed.append(i)
                self._shown = outcome
            elif not (self._live and ticks[i] - self._mode_sent_tick > self._repeat_ticks):
                continue
            sent.append(i)
            self._mode_sent_tick = ticks[i]
        if not sent:
            return
        modes = frames["mode"].tolist()
        reasons = frames["reason"].tolist()
        yield columns(
            "/mode", sent, rr.StateChange.columns(state=[word(Mode(modes[i])) for i in sent])
        )
        yield columns(
            "/reason", sent, rr.StateChange.columns(state=[word(Reason(reasons[i])) for i in sent])
        )
        for i in sent:
            picture = banner(modes[i], reasons[i], engaging[i])
            layout = rr.components.ImageFormat(
                width=picture.shape[1],
                height=picture.shape[0],
                color_model="RGB",
                channel_datatype="U8",
            )
            texture = rr.Mesh3D.columns(
                albedo_texture_buffer=[picture.tobytes()], albedo_texture_format=[layout]
            )
            yield columns("/scene/banner", [i], texture)
        for i in changed:  # one chunk each: the viewer shows one level for all rows of a chunk
            level = "ERROR" if modes[i] == Mode.FAULT else "INFO"
            text = log_line(modes[i], reasons[i], engaging[i], self._settings)
            yield columns("/log", [i], rr.TextLog.columns(text=[text], level=[level]))

    def _scene(
        self,
        batch: list[DrawnFrame],
        frames: NDArray[Any],
        rows: NDArray[np.intp],
        seen: NDArray[np.bool_],
        columns: Columns,
    ) -> Iterator[rr.chunk.Chunk]:
        yield from self._links(batch, frames, rows, columns)
        tool = rr.Transform3D.columns(
            translation=frames["tool"][rows], quaternion=frames["tool_orientation"][rows]
        )
        yield columns("/scene/tool", rows, tool)
        yield columns(
            "/scene/setpoint", rows, rr.Points3D.columns(positions=frames["setpoint"][rows])
        )
        for side, name in enumerate(SIDES):
            seen_rows = rows[seen[rows, side]]
            if len(seen_rows):
                positions = rr.Points3D.columns(positions=frames["hands"][seen_rows, side])
                yield columns(f"/scene/{name}_hand", seen_rows, positions)
        predicted_rows = rows[_predicted(frames, seen)[rows]]
        if len(predicted_rows):
            yield columns("/scene/target", predicted_rows, _target_regions(frames[predicted_rows]))
        if len(near := rows[seen[rows].any(axis=1)]):
            lines, labels = zip(*(self._nearest(frames[i], seen[i]) for i in near), strict=True)
            strips = rr.LineStrips3D.columns(strips=lines, labels=labels)
            yield columns("/scene/nearest", near, strips)

    def _links(
        self,
        batch: list[DrawnFrame],
        frames: NDArray[Any],
        rows: NDArray[np.intp],
        columns: Columns,
    ) -> Iterator[rr.chunk.Chunk]:
        """The transforms of the arm's joints, as commanded and as measured."""
        measured_rows = np.array([i for i in rows if batch[i].measured is not None], np.intp)
        measured = [batch[i].measured for i in measured_rows]
        for number, (joint, ghost) in enumerate(zip(self._joints, self._ghost, strict=True)):
            if joint is not None:
                angles = frames["joints"][rows, number].tolist()
                transforms = joint.compute_transform_columns(angles, clamp=False)
                yield columns(f"/arm/joints/{number}", rows, transforms)
            if ghost is not None and len(measured_rows):
                angles = [float(q[number]) for q in measured if q is not None]
                transforms = ghost.compute_transform_columns(angles, clamp=False)
                yield columns(f"/measured/joints/{number}", measured_rows, transforms)

    def _nearest(self, frame: Record, seen: NDArray[np.bool_]) -> tuple[NDArray[np.float32], str]:
        """The line (2, 3) from the nearest hand to the arm, and its length as text; without a hand
        nearby, a point and no text.
        """
        body = self._body
        nearest = (NEAREST_SHOWN_M, np.zeros((2, 3)))
        placed = np.empty((len(body.capsules), 2, 3))
        near = np.empty(9)  # both nearest points, and the normal
        place(np.ascontiguousarray(frame["joints"]), body.frames, body.axes, body.capsules, placed)
        if frame["hand_distance"] < min(NEAREST_SHOWN_M, FARTHEST_REPORTED_M):
            for side in np.flatnonzero(seen):
                hand = np.stack([frame["hands"][side], frame["hands"][side] + self._forearm])
                for ends, radius in zip(placed, body.capsules["radius"].tolist(), strict=True):
                    distance = between_segments(ends, hand, near) - radius - self._hand_radius
                    if distance < nearest[0]:
                        surfaces = (
                            near[:3] + radius * near[6:],
                            near[3:6] - self._hand_radius * near[6:],
                        )
                        nearest = distance, np.stack(surfaces)
        distance, line = nearest
        label = f"{100 * distance:.0f} cm" if distance < NEAREST_SHOWN_M else ""
        return line.astype(np.float32), label

    def _trail(
        self, frames: NDArray[Any], rows: NDArray[np.intp], columns: Columns
    ) -> Iterator[rr.chunk.Chunk]:
        """The trails of the last SHOWN_TRAIL_S; a trail restarts after its hand was lost."""
        # older recordings have no limits of their own
        stale = np.maximum(frames["stale_ticks"], self._stale_ticks)
        tracks = [
            (name, frames["hands"][:, side], frames["hand_ages"][:, side], stale[:, side])
            for side, name in enumerate(SIDES)
        ]
        tracks.append(("tool", frames["tool"], np.where(frames["commanded"], 0, -1), stale[:, 0]))
        for name, positions, ages, limits in tracks:
            trail = self._trails[name]
            drawn_rows = []
            strips = []
            for i in rows:
                fresh = 0 <= ages[i] < limits[i]
                if not fresh or (
                    trail and np.linalg.norm(trail[-1] - positions[i]) > TRAIL_BREAK_M
                ):
                    trail.clear()
                if fresh:
                    trail.append(positions[i].astype(np.float32))
                if ages[i] >= 0:
                    drawn_rows.append(i)
                    strips.append(np.array(trail, np.float32).reshape(-1, 3))
            if drawn_rows:
                yield columns(
                    f"/scene/{name}_trail", drawn_rows, rr.LineStrips3D.columns(strips=strips)
                )


def _target_regions(frames: NDArray[Any]) -> rr.ComponentColumnList:
    """The 95 % regions of the target in frames (T,), coloured by the flag `unsure`."""
    variances, axes = np.linalg.eigh(frames["covariance"])
    axes[:, :, 0] *= np.linalg.det(axes)[:, None]
    unsure = frames["flags"] & int(Flag.UNSURE) > 0
    return rr.Ellipsoids3D.columns(
        half_sizes=np.clip(np.sqrt(REGION_95 * np.maximum(variances, 0.0)), 1e-4, 0.3),
        centers=frames["target"],
        quaternions=Rotation.from_matrix(axes).as_quat(),
        colors=[palette.GATE if is_unsure else palette.TARGET for is_unsure in unsure],
    )


def _predicted(frames: NDArray[Any], seen: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Mask (T,) of the frames with a target. If one hand leads and the other was never seen, the
    covariance shows whether there is a prediction.
    """
    is_predicted = np.any(frames["covariance"], axis=(1, 2))
    mask: NDArray[np.bool_] = np.where(is_predicted, seen.any(axis=1), seen.all(axis=1))
    return mask
