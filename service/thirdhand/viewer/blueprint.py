"""The Rerun blueprint: three tabs of views, for the task, the timing, and the learned skill.

All curves share one time axis, seconds from the start; it continues beyond the newest value, where
the legends are. The range of each view follows from the limits in force, or from the drawn values,
such that a single outlier does not flatten the rest.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import rerun as rr
import rerun.blueprint as rrb
import rerun_bindings
from rerun.blueprint import components

from thirdhand.settings import palette
from thirdhand.settings.config import Settings

TIMELINE = "seconds"
TABS = ("task", "timing", "learning")
WINDOW_S = 20.0  # live curves show this time
LEGEND_SHARE = 0.175  # this share of the time axis is kept free for legends
# width of the numbers left of a curve, which modes lack, as share of the time axis
NUMBERS_SHARE = 0.032
HEADROOM = 1.25  # range of an axis / usual range of its curves
MAX_GATE_RATIO = 4.0  # a gate farther above the curves is not drawn, as it would flatten them
EYE = (0.90, -0.72, 0.62)
LOOK_AT = (0.53, 0.0, 0.23)
UP = (0.0, 0.0, 1.0)


class PlotView(NamedTuple):
    """One view of curves: path, title and range. Unless the range is `fixed`, that of the drawn
    values replaces it.
    """

    origin: str
    title: str
    low: float
    high: float
    fixed: bool = False


def plot_views(settings: Settings) -> dict[str, PlotView]:
    """All views of curves by path, with ranges from the settings."""
    joints = settings.joints
    tool = settings.tool
    period_us = 1e6 * settings.period_s
    velocity = max(joints.velocity)
    acceleration = max(joints.acceleration)
    kinds = joints.every_kind
    unit = "rad" if set(joints.units) == {"rad"} else "rad or m"
    lowest = min(
        max(low, -math.pi) if kind == "continuous" else low
        for low, kind in zip(joints.lower, kinds, strict=True)
    )
    highest = max(
        min(high, math.pi) if kind == "continuous" else high
        for high, kind in zip(joints.upper, kinds, strict=True)
    )
    return {
        view.origin: view
        for view in (
            PlotView("/error", "Tool to target [mm]", 0, 60),
            PlotView("/turn", "Tool turned from the target [°]", 0, 10),
            PlotView("/gripper", "Gripper closure [%]", 0, 110, True),
            PlotView("/segment", "Segment of the task: number and probability", 0, 8, True),
            PlotView("/deviation", "Uncertainty, and deviation of the hands [mm]", 0, 250),
            PlotView(
                "/doubt", "Probability that the target is off by more than 10 cm [%]", 0, 110, True
            ),
            PlotView("/speed", "Speed [m/s]", 0, tool.max_speed),
            PlotView("/separation/distance", "Nearest hand: distance [m]", 0, 1.0),
            PlotView("/separation/limit", "Nearest hand: allowed speed toward it [m/s]", 0, 1.5),
            PlotView("/joints/velocity", f"Joint velocity [{unit}/s]", -velocity, velocity),
            PlotView("/joints/position", f"Joint position [{unit}]", lowest, highest, True),
            PlotView(
                "/joints/acceleration",
                f"Joint acceleration [{unit}/s²]",
                -acceleration,
                acceleration,
            ),
            PlotView(
                "/joints/error",
                f"Joint error, measured - commanded [{unit}]",
                0,
                settings.arm.fault_error_rad,
            ),
            PlotView("/latency", "Hand to command [ms]", 0, 20),
            PlotView("/timing/lateness", "Lateness of a tick [µs]", 0, period_us / 2),
            PlotView("/timing/work", "Work of a tick [µs]", 0, period_us),
            PlotView("/timing/stages", "Work of each stage [µs]", 0, period_us / 4),
            PlotView(
                "/age",
                "Age of the newest sample of each hand [ms]",
                0,
                1.2 * settings.hands.longest_stale_ms,
                True,
            ),
        )
    }


class SentBlueprint(rrb.Blueprint):
    """A blueprint that leaves nothing in memory once it is sent."""

    def send_to(self, stream: rr.RecordingStream) -> None:
        """Send it, and end the stream in which Rerun made it, which takes 2 MB and two threads."""
        stream.send_blueprint(self, make_active=True)
        self._made_in.disconnect()
        rerun_bindings.flush_and_cleanup_orphaned_recordings()

    def _log_to_stream(self, stream: rr.RecordingStream) -> None:
        super()._log_to_stream(stream)
        self._made_in = stream


def blueprint(
    settings: Settings,
    *,
    live: bool,
    gate_m: float = math.inf,
    tops: Mapping[str, float] | None = None,
    end_s: float | None = None,
    tab: str = TABS[0],
) -> SentBlueprint:
    """The blueprint of a live view, or of a file with a duration of `end_s` [s] and curves up to
    `tops`. `gate_m` is the deviation [m] above which the arm holds with the skill in force.
    """
    plots = _Plots(settings, live=live, gate_m=gate_m, tops=tops or {}, end_s=end_s)
    return SentBlueprint(
        rrb.Tabs(
            _task(plots, settings.recording.also),
            _timing(plots),
            _learning(plots),
            active_tab=TABS.index(tab),
        ),
        rrb.TopPanel(state="hidden"),
        rrb.TimePanel(
            state="collapsed", timeline=TIMELINE, play_state="following" if live else None
        ),
        rrb.BlueprintPanel(state="hidden"),
        rrb.SelectionPanel(state="hidden"),
        auto_views=False,
        auto_layout=False,
    )


class _Plots:
    """The views over time of one blueprint, with a common time axis."""

    def __init__(
        self,
        settings: Settings,
        *,
        live: bool,
        gate_m: float,
        tops: Mapping[str, float],
        end_s: float | None,
    ) -> None:
        self._views = plot_views(settings)
        self._tops = {origin: HEADROOM * top for origin, top in tops.items()}
        gate_mm = 1e3 * gate_m
        most_mm = MAX_GATE_RATIO * tops.get("/deviation", self._views["/deviation"].high)
        if gate_mm <= most_mm:
            self._tops["/deviation"] = HEADROOM * max(gate_mm, tops.get("/deviation", 0.0))
        self._left_out = {"/deviation": ["- $origin/gate"]} if most_mm < gate_mm < math.inf else {}
        self._end_s = end_s
        relative = rrb.TimeRangeBoundary.cursor_relative
        visible = rr.VisibleTimeRange(TIMELINE, start=relative(seconds=-WINDOW_S), end=relative())
        self._loaded = rrb.VisibleTimeRanges(visible) if live else None

    def _time_axis(self, margin_share: float) -> rrb.TimeAxis:
        """The time axis, which begins earlier by a share of its length."""
        boundary: Any = rrb.TimeRangeBoundary.absolute
        first_s = 0.0
        last_s = self._end_s
        if last_s is None:
            boundary = rrb.TimeRangeBoundary.cursor_relative
            first_s = -WINDOW_S
            last_s = 0.0
        whole_s = max(1.0, (last_s - first_s) / (1 - LEGEND_SHARE))
        time_range = rr.TimeRange(
            start=boundary(seconds=first_s - margin_share * whole_s),
            end=boundary(seconds=first_s + whole_s),
        )
        return rrb.TimeAxis(link=components.LinkAxis.Independent, view_range=time_range)

    def curves(self, origin: str) -> rrb.TimeSeriesView:
        """The view of the curves below a path."""
        view = self._views[origin]
        high = view.high if view.fixed else self._tops.get(origin, view.high)
        low = view.low if view.fixed or view.low >= 0 else -high
        return rrb.TimeSeriesView(
            origin=origin,
            contents=["+ $origin/**", *self._left_out.get(origin, ())],
            name=view.title,
            plot_legend=rrb.PlotLegend(corner=rrb.Corner2D.RightTop, visible=True),
            axis_x=self._time_axis(0.0),
            axis_y=rrb.ScalarAxis(range=(low, high)),
            time_ranges=self._loaded,
        )

    def tabs(self, *origins: str) -> rrb.Tabs:
        """Views of curves of which the first is open."""
        return rrb.Tabs(*map(self.curves, origins), active_tab=0)

    def modes(self) -> rrb.StateTimelineView:
        """The view of modes and reasons."""
        return rrb.StateTimelineView(
            origin="/",
            contents=["/mode", "/reason"],
            name="Mode",
            time_view=self._time_axis(NUMBERS_SHARE),
        )


def _task(plots: _Plots, cameras: Sequence[str]) -> rrb.Horizontal:
    bench = rrb.Vertical(
        _scene("Bench", "+ /scene/**", "+ /arm/**", "+ /measured/**", "+ /skill/**"),
        _log(),
        row_shares=[4, 1],
    )
    if cameras:
        pictures = [rrb.Spatial2DView(origin=f"/cameras/{key}", name=key) for key in cameras]
        bench = rrb.Vertical(bench, rrb.Horizontal(*pictures), row_shares=[3, 2])
    quantities = ("velocity", "position", "acceleration", "error")
    curves = rrb.Vertical(
        plots.tabs("/error", "/turn", "/gripper", "/segment"),
        plots.tabs("/deviation", "/doubt"),
        plots.tabs("/speed", "/separation/distance", "/separation/limit"),
        rrb.Tabs(*(plots.curves(f"/joints/{quantity}") for quantity in quantities)),
        plots.modes(),  # below the curves, with the same time axis
        row_shares=[3, 3, 3, 5, 2.6],  # the legend of the joints has seven names
    )
    return rrb.Horizontal(bench, curves, column_shares=[1, 1], name="Task")


def _timing(plots: _Plots) -> rrb.Horizontal:
    return rrb.Horizontal(
        rrb.Vertical(*map(plots.curves, ("/latency", "/timing/lateness", "/age")), _log()),
        rrb.Vertical(
            *map(plots.curves, ("/timing/work", "/timing/stages")),
            plots.modes(),
            row_shares=[4, 4, 2],
        ),
        name="Timing",
    )


def _learning(plots: _Plots) -> rrb.Horizontal:
    return rrb.Horizontal(
        _scene(
            "The learned skill, and taught via-points",
            "+ /skill/**",
            "+ /scene/**",
            "- /scene/banner/**",
            "- /scene/reach/**",
        ),
        rrb.Vertical(
            rrb.TextDocumentView(origin="/about/skill", name="Skill"),
            plots.curves("/deviation"),
            plots.curves("/error"),
            row_shares=[3, 2, 2],
        ),
        column_shares=[3, 2],
        name="Learning",
    )


def _scene(name: str, *contents: str) -> rrb.Spatial3DView:
    return rrb.Spatial3DView(
        origin="/",
        name=name,
        contents=list(contents),
        background=rrb.Background(color=palette.BACKGROUND),
        line_grid=rrb.LineGrid3D(
            spacing=0.1,
            plane=rr.components.Plane3D.XY.with_distance(-0.02),
            stroke_width=0.5,
            color=palette.faint(palette.GRID, 0.35),
        ),
        eye_controls=rrb.EyeControls3D(position=EYE, look_target=LOOK_AT, eye_up=UP),
    )


def _log() -> rrb.TextLogView:
    return rrb.TextLogView(
        origin="/log",
        name="Log",
        columns=rrb.TextLogColumns(
            timeline_columns=[TIMELINE], text_log_columns=["LogLevel", "Body"]
        ),
    )
