"""Reports of sessions whose content is known: modes and reasons over time, causes of holds and
faults, via-points, limits, promptness.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from support.in_process import LEFT, RIGHT, arm, hand
from support.recorded import frames_of, thin
from support.wam import URDF
from support.wicked import wicked_skill
from thirdhand.command_line import main
from thirdhand.contract.records import Flag, Mode, Reason
from thirdhand.contract.requests import Percentiles, Status, ViaPoint, encode_json
from thirdhand.core.arm.stage import ArmStage
from thirdhand.core.controller import Controller
from thirdhand.core.frame import STAGES, Event, Tick, order, timed
from thirdhand.core.skill.skill import Skill
from thirdhand.core.tuning import TUNING
from thirdhand.daemon.input_monitor import InputMonitor
from thirdhand.daemon.status import CellStatus
from thirdhand.recordings.recording import Recorder, Recording
from thirdhand.settings.config import Settings
from thirdhand.skills.skill_file import decoded
from thirdhand.skills.via_points import adapted
from thirdhand.workbench.report.columns import read, runs
from thirdhand.workbench.report.report import Report, Span, reported, why_missed
from thirdhand.workbench.report.stops import (
    LEAST_STOP_SPEED_MPS,
    TOLERATED_M,
    excess_m,
    measured_setting,
)
from thirdhand.workbench.report.tables import tables, verdict
from thirdhand_sim.golden import AWAY_S, BAD_S, DROPOUT_S, HOLD_S, RETEACH_S, SESSION_S, TEACH_S

SETTINGS = Settings()
PERIOD_S = SETTINGS.period_s
PERIOD_NS = round(SETTINGS.period_s * 1e9)
START_NS = 1_700_000_000_000_000_000
FAULT_AT = 600  # ticks
FIELDS: dict[str, Any] = {  # fields of a status that do not come from the core
    "rate_hz": 500.0,
    "missed": 0,
    "realtime": True,
    "memory_locked": True,
    "awake": True,
    "scribe": {},
    "endpoints": (),
    "version": "",
    **dict.fromkeys(("lateness_us", "work_us", "latency_ms"), Percentiles()),
}
HERE = ViaPoint("here", LEFT, RIGHT, (0.5, 0.0, 0.35), std=0.001, radius=0.03)


def stamp(tick: int) -> int:
    return START_NS + tick * PERIOD_NS


class Told:
    """A recorded session with resting hands and an arm that follows its commands until something
    happens from tick `FAULT_AT` on; with a status ten times a second or without.
    """

    def __init__(
        self,
        skill: Skill,
        path: Path,
        what: str = "",
        *,
        lost_at: int | None = None,
        statuses: bool = True,
    ) -> None:
        self.what = what
        self.joints = SETTINGS.arm.posture
        self.said: list[Status] = []
        controller = Controller(SETTINGS, skill, urdf=URDF)
        monitor = InputMonitor(SETTINGS)
        with Recorder(
            path, settings=SETTINGS, skill=skill.file, state=controller.state
        ) as recorder:
            for k in range(1200):
                tick = Tick(k, tuple(self.inbox(k)))
                frame = controller.step(tick)
                if frame["commanded"]:
                    self.joints = tuple(frame["joints"].tolist())
                if lost_at is not None and lost_at <= k < lost_at + 100:
                    continue
                lost = 100 if lost_at is not None and k == lost_at + 100 else 0
                timing = timed(
                    k,
                    stamp(k),
                    k // 300,
                    50.0 + k % 7,
                    200.0,
                    1500.0 if k % 5 == 0 else 0.0,
                    (0.0,) * len(STAGES),
                )
                state = controller.state if lost else None
                recorder.write(tick, frame, time_ns=stamp(k), timing=timing, state=state, lost=lost)
                sources = dict(monitor.update(controller, controller.state, k * PERIOD_S))
                if statuses and k % 50 == 0:
                    failure = "the request thread failed: out of paper" if what == "failed" else ""
                    cell = CellStatus(
                        frame, controller, controller.state, sources, SETTINGS, failure
                    )
                    self.said.append(cell.status(**FIELDS))
                    recorder.note("status", encode_json(self.said[-1]).decode(), stamp(k))

    def first(self, reason: str, *, after: int = 0) -> Status:
        """The first status with a reason, from a tick on."""
        return next(
            status for status in self.said if status.reason == reason and status.tick >= after
        )

    def inbox(self, k: int) -> Iterable[Event]:
        late = k >= FAULT_AT
        if k % 5 == 0 and not (late and self.what == "left alone"):
            stamp_ns = k + 1 + (10**10 if k >= FAULT_AT - 20 and self.what == "stepped" else 0)
            yield hand("left", LEFT, stamp_ns)
            yield hand("right", RIGHT, stamp_ns)
        if k % 2 == 0 and not (
            (self.what in ("silent", "stepped") and FAULT_AT <= k < 900)
            or (self.what == "left alone" and k >= 850)
        ):
            q = list(self.joints)
            dq = [0.0] * 7
            if late and self.what == "pushed":
                q[3] += min(0.15, 0.003 * (k - FAULT_AT))
            if late and self.what == "fast":
                dq[0] = 5.0
            yield arm(tuple(q), stamp(k), tuple(dq))
        if late and self.what == "failed" and k == FAULT_AT:
            yield order("fault", "the request thread failed: out of paper")
        if k == 1000:
            yield order("reset")


@pytest.fixture(scope="module")
def session(golden: Path) -> Report:
    return reported(golden)


def test_stop_distance_is_compared_with_people(golden: Path) -> None:
    """The stop distance is measured at the tool, and compared with the assumed one of people."""
    columns = read(Recording.open(golden))
    report = Report(columns)
    assert report.stop_mm is not None
    assert report.stop_mm.samples == sum(span.mode is Mode.HOLD for span in report.spans[1:])
    for begin, end in runs(columns.frames["mode"]):
        if columns.frames["mode"][begin] == Mode.HOLD:
            tool_m = columns.frames["tool"][begin:end]
            moved_mm = 1000 * np.linalg.norm(tool_m - tool_m[0], axis=1).max()
            assert moved_mm < report.stop_mm.largest + 0.5
    tick = next(iter(columns.stops))
    begin, end = np.zeros((2, 7))
    end[1] = 0.1
    columns.stops = {tick: [begin, end]}
    columns.frames["setpoint_velocity"][columns.frames["tick"] == tick] = (0.0, 0.8, 0.0)
    arm = ArmStage(SETTINGS, URDF)
    distance_mm = 1000 * float(np.linalg.norm(arm.at(end).position - arm.at(begin).position))
    assumed_mm = 0.8 * SETTINGS.people.reaction_ms + 1000 * 0.8**2 / (2 * SETTINGS.people.brake)
    (prompt,) = (table for table in tables(Report(columns)) if table.name == "times")
    shown_mm = {row[0]: row[3] for row in prompt.rows if row[0].startswith("distance of a stop")}
    assert list(shown_mm.values()) == [f"{distance_mm:.1f}", f"{distance_mm - assumed_mm:.1f}"]


@given(
    stops=st.lists(
        st.tuples(st.floats(LEAST_STOP_SPEED_MPS, 1.5), st.floats(0.0, 1.0)), min_size=1, max_size=5
    )
)
def test_setting_of_measured_stops_covers_all_of_them(stops: list[tuple[float, float]]) -> None:
    """A proposed setting covers every stop; none is proposed where those in force do."""
    measured = np.array(stops)
    text = measured_setting(measured, SETTINGS)
    is_covered = excess_m(measured, SETTINGS).max() <= TOLERATED_M
    assert is_covered == text.endswith("within what [people] assumes.")
    if not is_covered:
        name, number = re.findall(r"`(\w+) = ([\d.]+)`", text)[0]
        people = msgspec.structs.replace(SETTINGS.people, **{name: float(number)})
        changed = msgspec.structs.replace(SETTINGS, people=people)
        assert excess_m(measured, changed).max() <= TOLERATED_M + 1e-9
    assert measured_setting(measured[:0], SETTINGS) == ""


def test_spans_of_a_session_name_what_happened(session: Report) -> None:
    """The spans follow each other without gaps."""
    ends = [span.start_s + span.lasts_s for span in session.spans]
    assert [span.start_s for span in session.spans] == pytest.approx([0.0, *ends[:-1]], abs=1e-9)
    assert ends[-1] == pytest.approx(session.lasts_s) == pytest.approx(SESSION_S, abs=0.05)
    held = {span.reason: span for span in session.spans if span.mode is Mode.HOLD}
    far_end_s = AWAY_S[1] + TUNING.intake.hand_still_s  # the hand returns by a jump
    for reason, (begin_s, end_s) in {
        # within the first 0.5 s the tool does not depend on that hand
        Reason.STALE_HAND: (DROPOUT_S[0] + 0.5, DROPOUT_S[1]),
        Reason.OPERATOR: HOLD_S,
        Reason.FAR_FROM_DEMONSTRATIONS: (AWAY_S[0], far_end_s),
    }.items():
        assert held[reason].start_s == pytest.approx(begin_s, abs=0.15)
        assert held[reason].start_s + held[reason].lasts_s == pytest.approx(end_s, abs=0.1)
    # The session has no status, so the words follow from the first frame of each hold.
    assert re.fullmatch(r"the left hand was last seen [45]\d\d ms ago", held[Reason.STALE_HAND].why)
    asked = held[Reason.OPERATOR]
    assert (asked.why, asked.remedy) == (
        "an operator requested a hold, or the daemon was stopped",
        "thirdhand resume",
    )
    far = re.fullmatch(
        r"the distance of a hand from its paths is (.*) cm; the hold ends below 8.8",
        held[Reason.FAR_FROM_DEMONSTRATIONS].why,
    )
    assert far is not None
    assert float(far[1]) > 11.0
    assert session.seconds(Mode.FOLLOW) + session.seconds(Mode.HOLD) == pytest.approx(
        session.lasts_s
    )
    assert (session.faults, session.lacks) == ((), ())


def test_rejections_and_limits_are_those_of_the_frames(session: Report) -> None:
    frames = frames_of(session.path)
    assert sum(rejection.samples for rejection in session.rejections) == int(
        frames[-1]["rejected"].sum()
    )
    assert all(BAD_S[0] <= rejection.first_s <= AWAY_S[1] + 0.1 for rejection in session.rejections)
    for limit in session.limits:
        raised = (frames["flags"] & Flag[limit.name.upper()]) > 0
        assert limit.lasts_s == pytest.approx(raised.sum() * PERIOD_S)
        assert limit.times == sum(1 for begin, _ in runs(raised) if raised[begin])
    assert {limit.name for limit in session.limits} == {
        str(flag.name).lower() for flag in Flag if (frames["flags"] & flag).any()
    }
    assert session.approach is not None
    is_hand_seen = (frames["hand_ages"] >= 0).any(axis=1)
    assert session.approach.distance_m == frames["hand_distance"][is_hand_seen].min()


def test_via_points_are_met_while_the_hands_are_there(session: Report) -> None:
    """Via-points of one name are distinguished by the time at which they were taught."""
    by_name = [(point.name, point.start_s) for point in session.via_points]
    assert {name for name, _ in by_name} == {"handover", "glass", "soldering"}
    first, second = [point for point in session.via_points if point.name == "handover"]
    assert first.start_s == pytest.approx(TEACH_S, abs=0.1)
    assert (
        first.end_s
        == pytest.approx(second.start_s, abs=1.5 * PERIOD_S)
        == pytest.approx(RETEACH_S, abs=0.1)
    )
    assert first.best_m is not None
    assert first.best_m < 0.02
    assert (second.visits, second.best_m) == ((), None)
    assert second.hands_m > 0.03


def test_a_via_point_is_missed_by_as_far_as_the_tool_is_from_it(
    skill: Skill, tmp_path: Path
) -> None:
    """The hands rest where the via-point was taught, and the tool moves toward it."""
    Told(adapted(skill, [HERE], tolerance=0.05), tmp_path / "a.mcap")
    [point] = reported(tmp_path / "a.mcap").via_points
    frames = frames_of(tmp_path / "a.mcap")
    [visit] = point.visits
    assert visit.nearest_m == pytest.approx(
        np.linalg.norm(frames["tool"] - HERE.tool, axis=1).min()
    )
    assert visit.settled_m == pytest.approx(
        np.linalg.norm(frames[-1]["tool"] - HERE.tool), abs=1e-4
    )
    assert point.hands_m < 1e-3


@pytest.mark.parametrize("statuses", [True, False])
@pytest.mark.parametrize(
    ("what", "reason", "why", "about"),
    [
        (
            "silent",
            Reason.ARM_SILENT,
            "no joint states for 1",
            "no joint states arrived for 100 ms ([arm] silent_ms)",
        ),
        (
            "pushed",
            Reason.ARM_ERROR,
            "now wam/elbow_pitch_joint is off by 0.1",
            "a joint was measured more than 0.1 rad",
        ),
        (
            "fast",
            Reason.TOOL_SPEED,
            " m/s, 1 accepted",
            "the tool was measured faster than 1 m/s ([tool] fault",
        ),
        (
            "failed",
            Reason.SERVICE,
            "the request thread failed: out of paper",
            "the request thread failed: out of",
        ),
    ],
)
def test_fault_tells_cause_and_end(
    skill: Skill, tmp_path: Path, what: str, reason: Reason, why: str, about: str, statuses: bool
) -> None:
    """The fault has the words of its status, and what happened before it."""
    session = Told(skill, tmp_path / "a.mcap", what, statuses=statuses)
    report = reported(tmp_path / "a.mcap")
    fault = report.faults[0]
    assert fault.reason is reason
    assert FAULT_AT * PERIOD_S <= fault.start_s <= FAULT_AT * PERIOD_S + 0.2
    if statuses:
        status = session.first(str(reason.name).lower())
        assert (fault.why, fault.remedy) == (status.because, status.remedy)
        assert why in fault.why
    else:
        assert fault.why.startswith(about)
    assert re.search(
        rf"and {len(report.faults)} faults?; the worst was fault: \w+, for ", verdict(report)
    )
    assert any(line.startswith("before it: it followed for 1.") for line in fault.before)
    assert fault.ended.startswith("ended by a `reset` after 0.")
    missed = why_missed(report, "here", begun_s=1.0, start_s=0.0, end_s=2.0)
    assert str(reason.name).lower() in missed
    assert fault.why in missed


def test_before_a_fault_is_told_what_was_rejected_and_why(skill: Skill, tmp_path: Path) -> None:
    Told(skill, tmp_path / "a.mcap", "stepped")
    lines = reported(tmp_path / "a.mcap").faults[0].before
    words = (
        "left hand: rejected as ahead: stamped 10 s after the newest accepted one: its clock "
        "stepped ahead"
    )
    assert words in lines


def test_waiting_is_no_hold_of_the_session(golden: Path) -> None:
    """The end of a session is no hold either."""

    def spans(*parts: tuple[float, Mode, Reason]) -> tuple[Span, ...]:
        timeline = []
        at_s = 0.0
        for lasts_s, mode, reason in parts:
            timeline.append(Span(at_s, lasts_s, mode, reason))
            at_s += lasts_s
        return tuple(timeline)

    hold = Mode.HOLD
    follow = Mode.FOLLOW
    fault = Mode.FAULT
    waits = (6.0, hold, Reason.NO_HANDS)
    ends = [(3.0, hold, Reason.STALE_HAND), (0.1, hold, Reason.OPERATOR)]
    moves = (4.0, follow, Reason.NONE)
    stops = (1.0, hold, Reason.STALE_HAND)
    cases = {
        "a bench": (waits, moves, *ends),
        "a stop": (waits, moves, stops, moves, *ends),
        "a hold before it": (
            moves,
            (0.1, hold, Reason.STALE_HAND),
            (1.0, fault, Reason.ARM_SILENT),
        ),
    }
    verdicts = {}
    report = reported(golden)
    for name, parts in cases.items():
        report.spans = spans(*parts)
        report.lasts_s = sum(part[0] for part in parts)
        verdicts[name] = verdict(report)
    assert verdicts["a bench"].startswith(
        "It followed 100 % of 4.0 s, from 6.0 to 10.0 s, with no holds and no faults"
    )
    assert verdicts["a bench"].endswith("It ended with hold: stale_hand, 3.1 s before the end.")
    assert verdicts["a stop"].startswith(
        "It followed 89 % of 9.0 s, from 6.0 to 15.0 s, with 1 hold and no faults"
    )
    assert (
        "with 1 hold and 1 fault; the worst was fault: arm_silent" in verdicts["a hold before it"]
    )
    assert "It ended with" not in verdicts["a hold before it"]


def test_a_hold_has_the_words_of_the_first_status_in_it(skill: Skill, tmp_path: Path) -> None:
    session = Told(skill, tmp_path / "a.mcap", "left alone")
    first, *_, alone, last = reported(tmp_path / "a.mcap").spans
    held = {Reason.ARM_NOT_READY: first, Reason.STALE_HAND: alone}
    for reason, span in held.items():
        assert span.reason is reason
        assert (span.why, span.remedy) == (
            session.first(str(reason.name).lower()).because,
            span.remedy,
        )
    assert "hand was last seen" in alone.why
    assert last.reason is Reason.ARM_NOT_READY
    assert last.why == session.first("arm_not_ready", after=850).because
    assert last.why.startswith("no joint states for ")


def test_promptness_is_that_of_the_timings(skill: Skill, tmp_path: Path) -> None:
    """Ticks that are not recorded belong to no mode."""
    Told(skill, tmp_path / "a.mcap", lost_at=700)
    report = reported(tmp_path / "a.mcap")
    assert report.missed == 3
    assert report.latency_ms is not None
    assert report.latency_ms[:3] == pytest.approx((1.5, 1.5, 1.5))
    assert report.latency_ms.samples == 220
    assert report.lateness_us is not None
    assert report.lateness_us.largest == 56.0
    assert len(report.lacks) == 1
    assert "100 ticks not recorded" in report.lacks[0]
    assert sum(span.lasts_s for span in report.spans) == pytest.approx(1100 * PERIOD_S)
    assert report.lasts_s == pytest.approx(1200 * PERIOD_S)


def test_names_have_no_effect_on_tables_and_page(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The names are those in a skill and of a file."""
    path = tmp_path / "$\\frac$ <b>\x1b[31m.mcap"
    Told(decoded(wicked_skill(), origin="wicked"), path)
    html_path = tmp_path / "page.html"
    assert main(["report", str(path), "--html", str(html_path)]) == 0
    output = capsys.readouterr().out
    page = html_path.read_text(encoding="utf-8")
    for text in (output, page):
        assert all(line.isprintable() for line in text.splitlines())
    assert r"skill a\nb\x1b[31mred" in output
    assert "<b>" not in page
    assert r"$\frac$ &lt;b&gt;\x1b[31m" in page


@pytest.mark.parametrize("far_ticks", [900, None])
def test_the_initial_approach_is_no_error_of_following(golden: Path, far_ticks: int | None) -> None:
    columns = read(Recording.open(golden))
    as_recorded = Report(columns).lag_mm
    follows = np.flatnonzero(columns.frames["mode"] == Mode.FOLLOW)
    columns.frames["tool"][follows[:far_ticks]] += (0.473, 0.0, 0.0)
    report = Report(columns)
    assert report.initial_mm is not None
    assert report.initial_mm.largest > 400.0
    if far_ticks is None:
        assert report.lag_mm is None
        # otherwise the largest error is that of a stop
        report.spans = tuple(span for span in report.spans if span.mode is Mode.FOLLOW)
        assert "did not reach the target" in verdict(report)
        return
    assert report.initial_mm.samples == far_ticks
    assert report.initial_s == pytest.approx(far_ticks * columns.period_s)
    assert report.lag_mm is not None
    assert as_recorded is not None
    assert report.lag_mm.largest <= as_recorded.largest


@pytest.mark.thorough
def test_ages_of_hands_advance_between_recorded_frames(golden: Path, tmp_path: Path) -> None:
    """Ages are too large by the time since the last frame at most; seen and unseen hands agree."""
    whole = read(Recording.open(golden))
    columns = read(Recording.open(thin(golden, tmp_path / "thin.mcap")))
    assert np.array_equal(columns.frames["tick"], whole.frames["tick"])
    ages = columns.frames["hand_ages"]
    true_ages = whole.frames["hand_ages"]
    assert np.array_equal(ages < 0, true_ages < 0)
    errors = ages - true_ages
    assert errors.min() >= 0
    assert errors.max() < 20 + 25  # a frame is recorded every 20 ticks; a jump is accepted after 25
    stale = whole.frames["stale_ticks"]
    assert np.array_equal(ages < stale, true_ages < stale)
