"""The Rerun blueprint: three tabs of views, for the task, the timing, and the learned skill.

All curves share one time axis, seconds from the start; it continues beyond the newest value, where
the legends are. The range of each view follows from the limits in force, or from the drawn values,
such that a single outlier does not flatten the rest.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NamedTuple

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
    views = plot_views(settings)
    reached = dict(tops or {})
    tops = {origin: HEADROOM * top for origin, top in reached.items()}
    gate_mm = 1e3 * gate_m
    most_mm = MAX_GATE_RATIO * reached.get("/deviation", views["/deviation"].high)
    if gate_mm <= most_mm:
        tops["/deviation"] = HEADROOM * max(gate_mm, reached.get("/deviation", 0.0))
    left_out = ["- $origin/gate"] if most_mm < gate_mm < math.inf else []
    relative = rrb.TimeRangeBoundary.cursor_relative
    boundary, first_s, last_s = (
        (relative, -WINDOW_S, 0.0)
        if end_s is None
        else (rrb.TimeRangeBoundary.absolute, 0.0, end_s)
    )
    whole_s = max(1.0, (last_s - first_s) / (1 - LEGEND_SHARE))
    time_range, beside_numbers = (
        rr.TimeRange(
            start=boundary(seconds=first_s - share * whole_s),
            end=boundary(seconds=first_s + whole_s),
        )
        for share in (0.0, NUMBERS_SHARE)
    )
    loaded = (
        rrb.VisibleTimeRanges(
            rr.VisibleTimeRange(TIMELINE, start=relative(seconds=-WINDOW_S), end=relative())
        )
        if live
        else None
    )

    def plot(origin: str, *, legend: bool = True) -> rrb.TimeSeriesView:
        view = views[origin]
        high = view.high if view.fixed else tops.get(origin, view.high)
        low = view.low if view.fixed or view.low >= 0 else -high
        return rrb.TimeSeriesView(
            origin=origin,
            contents=["+ $origin/**", *(left_out if origin == "/deviation" else [])],
            name=view.title,
            plot_legend=rrb.PlotLegend(corner=rrb.Corner2D.RightTop, visible=legend),
            axis_x=rrb.TimeAxis(link=components.LinkAxis.Independent, view_range=time_range),
            axis_y=rrb.ScalarAxis(range=(low, high)),
            time_ranges=loaded,
        )

    def modes() -> rrb.StateTimelineView:
        axis = rrb.TimeAxis(link=components.LinkAxis.Independent, view_range=beside_numbers)
        return rrb.StateTimelineView(
            origin="/", contents=["/mode", "/reason"], name="Mode", time_view=axis
        )

    bench = rrb.Vertical(
        _scene("Bench", "+ /scene/**", "+ /arm/**", "+ /measured/**", "+ /skill/**"),
        _log(),
        row_shares=[4, 1],
    )
    if cameras := settings.recording.also:
        views_of = [rrb.Spatial2DView(origin=f"/cameras/{key}", name=key) for key in cameras]
        bench = rrb.Vertical(bench, rrb.Horizontal(*views_of), row_shares=[3, 2])
    curves = rrb.Vertical(
        rrb.Tabs(plot("/error"), plot("/turn"), plot("/gripper"), plot("/segment"), active_tab=0),
        rrb.Tabs(plot("/deviation"), plot("/doubt"), active_tab=0),
        rrb.Tabs(
            plot("/speed"), plot("/separation/distance"), plot("/separation/limit"), active_tab=0
        ),
        rrb.Tabs(
            *(
                plot(f"/joints/{quantity}")
                for quantity in ("velocity", "position", "acceleration", "error")
            )
        ),
        modes(),  # below the curves, with the same time axis
        row_shares=[3, 3, 3, 5, 2.6],  # the legend of the joints has seven names
    )
    task = rrb.Horizontal(bench, curves, column_shares=[1, 1], name="Task")
    timing = rrb.Horizontal(
        rrb.Vertical(
            *(plot(origin) for origin in ("/latency", "/timing/lateness", "/age")), _log()
        ),
        rrb.Vertical(
            *(plot(origin) for origin in ("/timing/work", "/timing/stages")),
            modes(),
            row_shares=[4, 4, 2],
        ),
        name="Timing",
    )
    learning = rrb.Horizontal(
        _scene(
            "The learned skill, and taught via-points",
            "+ /skill/**",
            "+ /scene/**",
            "- /scene/banner/**",
            "- /scene/reach/**",
        ),
        rrb.Vertical(
            rrb.TextDocumentView(origin="/about/skill", name="Skill"),
            plot("/deviation"),
            plot("/error"),
            row_shares=[3, 2, 2],
        ),
        column_shares=[3, 2],
        name="Learning",
    )
    return SentBlueprint(
        rrb.Tabs(task, timing, learning, active_tab=TABS.index(tab)),
        rrb.TopPanel(state="hidden"),
        rrb.TimePanel(
            state="collapsed", timeline=TIMELINE, play_state="following" if live else None
        ),
        rrb.BlueprintPanel(state="hidden"),
        rrb.SelectionPanel(state="hidden"),
        auto_views=False,
        auto_layout=False,
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
