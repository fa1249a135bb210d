"""What the viewer shows and how: the arrangement of the views, what never changes, and frames as
chunks of columns.

The scene is drawn at about 100 Hz, the curves at the full rate. Millimetres, microseconds and
colours are chosen here and nowhere else.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from service.config import Settings
from service.contract.records import SIDES, Mode, Reason
from service.core.frame import TIMING, Record

SCENE_HZ = 100
TRAIL_S, TRAIL_HZ = 3.0, 20
LIVE_WINDOW_S = 20.0
BLUE, ORANGE, GREEN, MAGENTA, GREY = (58, 134, 255), (255, 146, 43), (64, 192, 87), (214, 51, 132), (150, 155, 163)
PALETTE = [
    (58, 134, 255),
    (255, 146, 43),
    (64, 192, 87),
    (230, 73, 128),
    (151, 117, 250),
    (59, 201, 219),
    (250, 204, 21),
]
MODE_COLOURS = {Mode.HOLD: 0xF0A000FF, Mode.FOLLOW: 0x40C057FF, Mode.FAULT: 0xE03131FF}
Batch = list[tuple[Record, int, Record | None]]


def blueprint(*, live: bool) -> rrb.Blueprint:
    """The arrangement of the views: the scene large, curves at the right, mode and log below."""
    window = None
    if live:
        start = rrb.TimeRangeBoundary.cursor_relative(seconds=-LIVE_WINDOW_S)
        window = rrb.VisibleTimeRanges(
            rr.VisibleTimeRange("time", start=start, end=rrb.TimeRangeBoundary.cursor_relative())
        )

    def curves(origin: str, name: str, **more: Any) -> rrb.TimeSeriesView:
        legend = rrb.PlotLegend(corner=rrb.Corner2D.LeftTop, visible=more.pop("legend", True))
        return rrb.TimeSeriesView(origin=origin, name=name, plot_legend=legend, time_ranges=window, **more)

    scene = rrb.Spatial3DView(
        origin="/",
        name="Bench",
        contents=["+ /scene/**", "+ /arm/**"],
        background=rrb.Background(color=(24, 27, 33)),
        line_grid=rrb.LineGrid3D(
            spacing=0.1, plane=rr.components.Plane3D.XY.with_distance(-0.02), stroke_width=0.5, color=(70, 76, 86, 90)
        ),
        eye_controls=rrb.EyeControls3D(
            position=(1.90, -1.25, 1.00), look_target=(0.46, 0.0, 0.30), eye_up=(0.0, 0.0, 1.0)
        ),
    )
    return rrb.Blueprint(
        rrb.Vertical(
            rrb.Horizontal(
                scene,
                rrb.Vertical(
                    curves("/accuracy", "Target: how sure, how closely followed [mm]"),
                    rrb.Tabs(
                        curves("/speed", "Speed [m/s]"),
                        curves("/separation", "Nearest hand: distance [m], speed allowed toward it [m/s]"),
                        active_tab=0,
                    ),
                    rrb.Tabs(
                        curves("/joints/velocity", "Joint velocities [rad/s]"),
                        curves("/joints/position", "Joint positions [rad]"),
                        curves("/joints/acceleration", "Joint accelerations [rad/s²]"),
                    ),
                    rrb.Tabs(curves("/latency", "Hand to command [ms]"), curves("/timing", "Time of a tick [µs]")),
                    row_shares=[3, 3, 4, 3],
                ),
                column_shares=[3, 2],
            ),
            rrb.Horizontal(
                rrb.StateTimelineView(origin="/mode", name="Mode"),
                rrb.TextLogView(
                    origin="/log",
                    name="Log",
                    columns=rrb.TextLogColumns(timeline_columns=["time"], text_log_columns=["LogLevel", "Body"]),
                ),
                column_shares=[3, 2],
            ),
            row_shares=[5, 1],
        ),
        rrb.TimePanel(state="collapsed", timeline="time", play_state="following" if live else None),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        auto_views=False,
        auto_layout=False,
    )


def log_fixed(stream: rr.RecordingStream, tree: rr.urdf.UrdfTree, settings: Settings) -> None:
    """Logs what never changes: the arm's shapes, the table, names and colours."""

    def fix(path: str, *what: Any) -> None:
        stream.log(path, *what, static=True)

    for chunk in tree.stream(include_joint_transforms=False):
        if "/collision_geometries/" not in chunk.entity_path:
            stream.send_chunks(chunk)
            for shape in (rr.Boxes3D, rr.Cylinders3D, rr.Ellipsoids3D):
                if any(name.startswith(f"{shape.__name__}:") for name in chunk.to_record_batch().schema.names):
                    fix(chunk.entity_path, shape.from_fields(fill_mode=rr.components.FillMode.Solid))
    for joint in tree.joints():
        if joint.joint_type == "fixed":
            fix(f"/arm/joints/{joint.child_link}", joint.compute_transform(0.0))
    fix("/scene", rr.ViewCoordinates.RIGHT_HAND_Z_UP)
    fix("/scene/base", rr.Transform3D(parent_frame="tf#/", child_frame=tree.root_link().name))
    (x, y, top), (half_x, half_y) = settings.table.centre, settings.table.half_size
    fix(
        "/scene/table",
        rr.Boxes3D(
            centers=[(x, y, top - 0.01)],
            half_sizes=[(half_x, half_y, 0.0095)],
            colors=[(58, 63, 72)],
            fill_mode=rr.components.FillMode.Solid,
        ),
    )
    edge = [(x + a * half_x, y + b * half_y, top) for a, b in ((-1, -1), (1, -1), (1, 1), (-1, 1), (-1, -1))]
    fix("/scene/table/edge", rr.LineStrips3D([edge], colors=[GREY], radii=[0.0015]))
    fix("/scene/tool", rr.TransformAxes3D(0.07))
    for name, colour, radius in (("left_hand", BLUE, 0.022), ("right_hand", ORANGE, 0.022), ("setpoint", GREEN, 0.008)):
        fix(
            f"/scene/{name}",
            rr.Points3D.from_fields(
                colors=[colour], radii=[radius], labels=[name.replace("_", " ")], show_labels=radius > 0.01
            ),
        )
    wires = rr.components.FillMode.TransparentFillMajorWireframe
    fix(
        "/scene/target",
        rr.Ellipsoids3D.from_fields(
            colors=[MAGENTA], line_radii=[0.0006], fill_mode=wires, labels=["target, 2 sigma"], show_labels=False
        ),
    )
    for name, colour in (("left", BLUE), ("right", ORANGE), ("tool", GREEN)):
        fix(f"/scene/{name}_trail", rr.LineStrips3D.from_fields(colors=[colour], radii=[0.002]))
    names = [name.rpartition("/")[2].removesuffix("_joint").replace("_", " ") for name in settings.joints.names]
    for what in ("position", "velocity", "acceleration"):
        fix(
            f"/joints/{what}",
            rr.SeriesLines(
                names=names, colors=[PALETTE[i % len(PALETTE)] for i in range(len(names))], widths=[1.5] * len(names)
            ),
        )
    for path, name, colour in (
        ("/accuracy/deviation", "standard deviation of the target", MAGENTA),
        ("/accuracy/error", "tool to target", GREEN),
        ("/speed/tool", "tool", GREEN),
        ("/speed/left", "left hand", BLUE),
        ("/speed/right", "right hand", ORANGE),
        ("/separation/distance", "nearest hand's distance", BLUE),
        ("/separation/limit", "speed allowed toward it", MAGENTA),
        ("/latency/hand", "hand's stamp to command", MAGENTA),
        ("/timing/lateness", "late by", ORANGE),
        ("/timing/work", "work", BLUE),
    ):
        fix(path, rr.SeriesLines(names=name, colors=colour, widths=1.5))
    for path, names, colours in (
        ("/mode/mode", [mode.name.lower() for mode in Mode], [MODE_COLOURS[mode] for mode in Mode]),
        ("/mode/reason", [reason.name.lower() for reason in Reason], [0x868E96FF] * len(Reason)),
    ):
        labels = [name.replace("_", " ") for name in names]
        fix(path, rr.StateConfiguration(values=names, labels=labels, colors=np.array(colours, np.uint32)))


class Chunks:
    """Batches of frames as chunks of columns; remembers what the next batch continues."""

    def __init__(self, tree: rr.urdf.UrdfTree, settings: Settings) -> None:
        rate_hz = settings.rate_hz
        self._joints = [tree.get_joint_by_name(name) for name in settings.joints.names]
        self._every = max(1, round(rate_hz / SCENE_HZ))
        self._trail_every = max(1, round(rate_hz / TRAIL_HZ))
        self._trails: dict[str, deque[NDArray[np.float32]]] = {
            name: deque(maxlen=round(TRAIL_S * TRAIL_HZ)) for name in (*SIDES, "tool")
        }
        self._shown: tuple[int, int] | None = None
        self._missed = 0
        self._scene_at = self._trail_at = -1

    def begin_anew(self) -> None:
        """What comes goes into another file: the mode in force is said again."""
        self._shown = None

    def of(self, batch: Batch) -> Iterator[rr.chunk.Chunk]:
        """The chunks that show a batch."""
        frames = np.array([frame for frame, _, _ in batch])
        times = np.array([time_ns for _, time_ns, _ in batch], np.int64)
        ticks = frames["tick"]
        timed = [i for i, (_, _, timing) in enumerate(batch) if timing is not None]

        def columns(path: str, rows: Any, *what: Any) -> rr.chunk.Chunk:
            index = [
                rr.TimeColumn("tick", sequence=ticks[rows]),
                rr.TimeColumn("time", timestamp=times[rows].view("datetime64[ns]")),
            ]
            return rr.chunk.Chunk.from_columns(path, index, [column for part in what for column in part])

        def scalars(path: str, rows: Any, values: NDArray[Any]) -> rr.chunk.Chunk:
            flat = rr.Scalars.columns(scalars=values[rows].ravel())
            return columns(
                path, rows, flat.partition([values.shape[1]] * len(ticks[rows])) if values.ndim > 1 else flat
            )

        every = slice(None)
        yield scalars("/joints/position", every, frames["joints"])
        yield scalars("/joints/velocity", every, frames["joint_velocities"])
        yield scalars("/joints/acceleration", every, frames["joint_accelerations"])
        yield scalars("/speed/tool", every, np.linalg.norm(frames["setpoint_velocity"], axis=1))
        seen = frames["hand_ages"] >= 0
        for side, name in enumerate(SIDES):
            rows = np.flatnonzero(seen[:, side])
            if len(rows):
                yield scalars(f"/speed/{name}", rows, np.linalg.norm(frames["hand_velocities"][:, side], axis=1))
        near = np.flatnonzero(seen.any(axis=1))
        if len(near):
            yield scalars("/separation/distance", near, frames["hand_distance"])
            yield scalars("/separation/limit", near, frames["hand_limit"])
        aimed = np.flatnonzero(seen.all(axis=1))
        if len(aimed):
            yield scalars("/accuracy/deviation", aimed, frames["deviation"] * 1e3)
            yield scalars("/accuracy/error", aimed, np.linalg.norm(frames["target"] - frames["tool"], axis=1) * 1e3)
        if timed:
            timings = np.zeros(len(batch), TIMING)
            timings[timed] = [batch[i][2] for i in timed]
            yield scalars("/timing/lateness", timed, timings["lateness_us"])
            yield scalars("/timing/work", timed, timings["work_us"])
            answered = np.flatnonzero(timings["latency_us"] > 0)
            if len(answered):
                yield scalars("/latency/hand", answered, timings["latency_us"] / 1e3)
            missed = int(timings["missed"][timed[-1]])
            if missed > self._missed:
                fresh = missed - self._missed
                text = f"{fresh} deadline{'s' * (fresh > 1)} missed before tick {ticks[timed[-1]]}"
                yield columns("/log", [timed[-1]], rr.TextLog.columns(text=[text], level=["WARN"]))
            self._missed = missed
        yield from self._modes(frames, columns)
        drawn = np.flatnonzero(ticks // self._every != np.concatenate([[self._scene_at], ticks[:-1] // self._every]))
        self._scene_at = int(ticks[-1]) // self._every
        if len(drawn):
            yield from self._scene(frames, drawn, seen, columns)
        corners = np.flatnonzero(
            ticks // self._trail_every != np.concatenate([[self._trail_at], ticks[:-1] // self._trail_every])
        )
        self._trail_at = int(ticks[-1]) // self._trail_every
        if len(corners):
            yield from self._trail(frames, corners, seen, columns)

    def _modes(self, frames: NDArray[Any], columns: Callable[..., rr.chunk.Chunk]) -> Iterator[rr.chunk.Chunk]:
        rows = []
        for i, now in enumerate(zip(frames["mode"].tolist(), frames["reason"].tolist(), strict=True)):
            if now != self._shown:
                rows.append(i)
                self._shown = now
        if rows:
            modes = [Mode(value).name.lower() for value in frames["mode"][rows]]
            reasons = [Reason(value).name.lower() if value else "" for value in frames["reason"][rows]]
            yield columns("/mode/mode", rows, rr.StateChange.columns(state=modes))
            yield columns("/mode/reason", rows, rr.StateChange.columns(state=reasons))
            for row, mode, reason in zip(
                rows, modes, reasons, strict=True
            ):  # apart: the viewer shows one level for all rows of a chunk
                text = f"{mode}: {reason.replace('_', ' ')}" if reason else mode
                yield columns(
                    "/log", [row], rr.TextLog.columns(text=[text], level=["ERROR" if mode == "fault" else "INFO"])
                )

    def _scene(
        self, frames: NDArray[Any], rows: Any, seen: Any, columns: Callable[..., rr.chunk.Chunk]
    ) -> Iterator[rr.chunk.Chunk]:
        for i, joint in enumerate(self._joints):
            if joint is not None:
                yield columns(
                    f"/arm/joints/{i}",
                    rows,
                    joint.compute_transform_columns(frames["joints"][rows, i].tolist(), clamp=False),
                )
        yield columns(
            "/scene/tool",
            rows,
            rr.Transform3D.columns(translation=frames["tool"][rows], quaternion=frames["orientation"][rows]),
        )
        yield columns("/scene/setpoint", rows, rr.Points3D.columns(positions=frames["setpoint"][rows]))
        for side, name in enumerate(SIDES):
            shown = rows[seen[rows, side]]
            if len(shown):
                yield columns(f"/scene/{name}_hand", shown, rr.Points3D.columns(positions=frames["hands"][shown, side]))
        shown = rows[seen[rows].all(axis=1)]
        if len(shown):
            variances, axes = np.linalg.eigh(frames["covariance"][shown])
            axes[:, :, 0] *= np.linalg.det(axes)[:, None]
            half = np.clip(2.0 * np.sqrt(np.maximum(variances, 0.0)), 1e-4, 0.3)
            turned = Rotation.from_matrix(axes).as_quat()
            yield columns(
                "/scene/target",
                shown,
                rr.Ellipsoids3D.columns(half_sizes=half, centers=frames["target"][shown], quaternions=turned),
            )

    def _trail(
        self, frames: NDArray[Any], rows: Any, seen: Any, columns: Callable[..., rr.chunk.Chunk]
    ) -> Iterator[rr.chunk.Chunk]:
        tracks = [(name, frames["hands"][:, side], seen[:, side]) for side, name in enumerate(SIDES)]
        for name, positions, there in (*tracks, ("tool", frames["tool"], np.ones(len(frames), np.bool_))):
            trail, shown, strips = self._trails[name], [], []
            for i in rows[there[rows]]:
                trail.append(positions[i].astype(np.float32))
                if len(trail) > 1:
                    shown.append(i)
                    strips.append(np.array(trail))
            if shown:
                yield columns(f"/scene/{name}_trail", shown, rr.LineStrips3D.columns(strips=strips))
