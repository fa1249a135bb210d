"""`thirdhand calibrate`: find the tracker's pose from a hand at the tool, check and write it."""

from __future__ import annotations

import argparse
import contextlib
import sys
import time
from collections.abc import Callable, Sequence
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from thirdhand.cli.usage import CONNECT_TIMEOUT_S, UsageError, inputs_session
from thirdhand.contract.messages import BASE
from thirdhand.contract.printable import printable_lines
from thirdhand.core.frame import Vector
from thirdhand.process.progress import say
from thirdhand.recordings.shipped import ARMS, cell_of
from thirdhand.settings.config import Settings
from thirdhand.workbench.cli.keys import EnterPressed
from thirdhand.workbench.trackers.calibration.cell_file import (
    CalibrationRecord,
    hand_settings,
    lines,
    real_path,
    recorded,
    write,
)
from thirdhand.workbench.trackers.calibration.collecting import (
    LedTracks,
    LiveLed,
    distances_m,
    from_recording,
    held_tool,
    lead,
    solved,
    the_hand,
    tracker_of,
)
from thirdhand.workbench.trackers.calibration.solver import (
    MIN_POINTS,
    Calibration,
    CalibrationError,
    bench_corners,
    solve_points,
)

CHECK_S = 10.0
CALIBRATE_POLL_S = 0.02
OTHER_HAND_S = 0.3  # a tracker that sees both hands publishes both within this time
HINT_S = 5.0  # progress without a terminal is shown in this interval


def calibrate(args: argparse.Namespace) -> int:
    """Calibrate, check, or both. Exit code 0; 1 if the check finds a hand too far away."""
    points = points_given(args)
    file = _cell_file(args)
    only_check = args.check and not (args.held or points)
    if not only_check:
        if file is not None:
            real_path(file)  # before the arm is led, as errors would waste this work
    elif file is None:
        raise UsageError(
            "--check compares with the last calibration of a cell: give its settings by --config "
            "FILE"
        )
    settings = cell_of(args.config) if args.config else None
    if args.recording is not None:
        return _from_recording(settings, file, only_check, args)
    settings = settings or Settings()
    with (
        inputs_session(args, CONNECT_TIMEOUT_S, settings) as session,
        contextlib.closing(LiveLed(session, args.cell or settings.cell, settings)) as live,
    ):
        return _live(live, settings, file, points, only_check, args)


def _cell_file(args: argparse.Namespace) -> Path | None:
    """The file of the cell's settings; None for a shipped cell, or none."""
    return Path(args.config) if args.config and args.config not in ARMS else None


def _from_recording(
    cell_settings: Settings | None, file: Path | None, only_check: bool, args: argparse.Namespace
) -> int:
    """Calibrate or check by a recording; the exit code."""
    led, settings = from_recording(args.recording, cell_settings)
    if only_check:
        assert file is not None
        return _checked(led, settings, _last(led, file, settings, args.hand), args)
    solution = solved(led, settings, bench_corners(settings), args.hand)
    record = _record(
        solution.calibration, solution.side, solution.frame or settings.hands.frame, "held"
    )
    _show(record, args, solution.remarks, lasts_s=float(np.ptp(solution.held.hand_s)))
    _write(file, record, solution.frame, settings)
    return _checked(led, settings, record, args) if args.check else 0


def points_given(args: argparse.Namespace) -> list[tuple[float, float, float]]:
    """The points to touch. Raises UsageError."""
    points: list[tuple[float, float, float]] = [(x, y, z) for x, y, z in args.at or ()]
    if points and args.recording is not None:
        raise UsageError("points are touched in a running cell: --from needs no --at")
    if points and len(points) < MIN_POINTS:
        raise UsageError(f"{len(points)} points given; {MIN_POINTS} or more needed")
    return points


def _live(
    live: LiveLed,
    settings: Settings,
    file: Path | None,
    given: list[tuple[float, float, float]],
    only_check: bool,
    args: argparse.Namespace,
) -> int:
    pressed = EnterPressed()
    corners = bench_corners(settings)
    _await(live, args, needs_joints=not given)
    if only_check:
        assert file is not None
        record = _last(live.led(most_states=1), file, settings, args.hand)
    else:
        begun_s = time.monotonic()
        side = the_hand(live.arriving, args.hand)
        if given:
            track = live.led(most_states=1).hands[side]
            remarks = list[str]()
            tracker_of(track, settings)
            frame = track.frame
            calibration = _touched(
                live, side, corners, given, pressed, settings.tracker_section(frame)
            )
        else:
            say(
                "hold the tool and lead it: up and down, far apart, and turn the wrist; Enter or "
                "Ctrl-C ends it"
            )
            try:
                accept_m = args.accept / 1000
                say(
                    lead(
                        live,
                        settings,
                        corners,
                        side,
                        accept_m=accept_m,
                        longest_s=args.seconds,
                        is_ended=pressed,
                        show=_shower(),
                        warn=say,
                    )
                )
            except KeyboardInterrupt:
                say("ended by Ctrl-C")
            solution = solved(live.led(), settings, corners, side)
            calibration = solution.calibration
            frame = solution.frame
            remarks = list(solution.remarks)
        remarks += live.unreadable
        record = _record(
            calibration, side, frame or settings.hands.frame, "points" if given else "held"
        )
        _show(record, args, remarks, lasts_s=time.monotonic() - begun_s)
        _write(file, record, frame, settings)
    if not args.check:
        return 0
    say(
        f"check: {'hold' if record.method == 'held' else 'touch'} the tool as before, for "
        f"{CHECK_S:g} s"
    )
    end_s = time.monotonic() + CHECK_S
    while time.monotonic() < end_s:
        time.sleep(CALIBRATE_POLL_S)
        live.collect()
    return _checked(live.led(since_s=CHECK_S), settings, record, args)


def _await(live: LiveLed, args: argparse.Namespace, *, needs_joints: bool) -> None:
    """Wait until hands and joints arrive, and for the other hand a moment longer. Raises
    CalibrationError after --wait.
    """
    begun_s = time.monotonic()
    while missing := live.unheard(args.hand, needs_joints=needs_joints):
        if time.monotonic() - begun_s > args.wait:
            raise CalibrationError(live.not_received(missing))
        time.sleep(CALIBRATE_POLL_S)
        live.collect()
    if args.hand is None:
        time.sleep(OTHER_HAND_S)
        live.collect()


def _touched(
    live: LiveLed,
    side: str,
    corners: Vector,
    given: list[tuple[float, float, float]],
    pressed: EnterPressed,
    section: str,
) -> Calibration:
    """The calibration from points that are touched one after another. Raises CalibrationError."""
    hand: list[Vector] = []
    base: list[Vector] = []
    try:
        while len(hand) < len(given):
            where = "({:g}, {:g}, {:g}) m".format(*given[len(hand)])
            say(
                f"{len(hand) + 1}: touch {where} with the tracked point of the {side} hand, then "
                "press Enter"
            )
            while not pressed():
                if not pressed.listens:
                    raise KeyboardInterrupt
                time.sleep(CALIBRATE_POLL_S)
                live.collect()
            live.collect()
            try:
                position_m = live.touch(side)
            except CalibrationError as error:
                say(f"not used: {error}")
                continue
            base.append(np.array(given[len(hand)]))
            hand.append(position_m)
            if len(hand) >= MIN_POINTS:
                try:
                    calibration = solve_points(
                        np.array(hand), np.array(base), corners, section=section
                    )
                    say(
                        f"residual {1e3 * calibration.rms_m:.1f} mm, accuracy "
                        f"{1e3 * calibration.std_m:.1f} mm; Ctrl-C ends it here"
                    )
                except CalibrationError as error:
                    say(f"not enough yet: {error}")
    except KeyboardInterrupt:
        say(f"ended after {len(hand)} points")
    return solve_points(
        np.array(hand).reshape(-1, 3), np.array(base).reshape(-1, 3), corners, section=section
    )


def _shower() -> Callable[[str], None]:
    """A function that shows progress: each line on a terminal, else one every HINT_S."""
    shown_s = [0.0]

    def show(line: str) -> None:
        now_s = time.monotonic()
        if (sys.stderr and sys.stderr.isatty()) or now_s - shown_s[0] >= HINT_S:
            shown_s[0] = now_s
            say(line)

    return show


def _record(calibration: Calibration, hand: str, frame: str, method: str) -> CalibrationRecord:
    now = datetime.now(UTC).isoformat(timespec="seconds")
    return CalibrationRecord(
        date=now,
        method=method,  # type: ignore[arg-type]
        hand=hand,
        frame=frame,
        calibration=calibration,
    )


def _show(
    record: CalibrationRecord, args: argparse.Namespace, remarks: Sequence[str], *, lasts_s: float
) -> None:
    """Print the calibration. Raises CalibrationError if it is less accurate than accepted."""
    calibration = record.calibration
    stds_mm = [1e3 * std for std in record.calibration.corner_std_m]
    for remark in remarks:
        say(f"remark: {remark}")
    kind = "samples" if record.method == "held" else "points"
    print(
        f"{record.hand} hand     {record.method}, {lasts_s:.0f} s, {calibration.samples} {kind}, "
        f"{calibration.outliers} outliers"
    )
    print(
        f"residual       {1e3 * calibration.rms_m:.1f} mm rms, "
        f"{1e3 * calibration.residual_95_m:.1f} mm (95 %)"
    )
    print(
        f"accuracy       {1e3 * calibration.std_m:.1f} mm: standard deviation at the corners of "
        f"the bench, {min(stds_mm):.1f} to {max(stds_mm):.1f} mm"
    )
    if record.method == "held":
        print("hand in tool   ({:.3f}, {:.3f}, {:.3f}) m".format(*calibration.hand_in_tool))
        print(
            f"delay          {round(1e3 * calibration.delay_s)} ms of the hand's stamps behind the "
            "arm's"
        )
    if calibration.std_m > args.accept / 1000:
        raise CalibrationError(
            f"not accurate enough: {1e3 * calibration.std_m:.1f} mm at the corners of the bench, "
            f"at most {args.accept:g} mm accepted (--accept). Nothing was written. To improve it, "
            f"{calibration.remedy}"
        )


def _write(file: Path | None, record: CalibrationRecord, frame: str, settings: Settings) -> None:
    """Write the calibration into the tracker's table in the cell's settings, or print the lines to
    write.
    """
    tracker = frame if frame in settings.trackers else ""
    values = hand_settings(record.calibration, "" if frame == BASE or tracker else frame)
    if file is None:
        print(
            "\nWrite this into the cell's settings; --config FILE does "
            f"it:\n{lines(values, tracker)}",
            end="",
        )
        return
    backup = write(file, values, record, tracker)
    print(f"\n{lines(values, tracker)}", end="")
    print(
        f"written into {file}; the earlier file is {backup.name}. Start the daemon again to use it"
    )


def _last(led: LedTracks, file: Path, settings: Settings, side: str | None) -> CalibrationRecord:
    """The last calibration of the tracker in whose frame the hand of a side is; without a side, of
    the calibrated tracker among those of both hands. Raises CalibrationError.
    """
    hands = [track for hand, track in led.hands.items() if side in (None, hand)]
    if not hands:
        return recorded(file, settings)
    records = dict[str, CalibrationRecord]()
    errors = list[CalibrationError]()
    for track in hands:
        try:
            tracker = tracker_of(track, settings)
            records[tracker] = recorded(file, settings, tracker)
        except CalibrationError as error:
            errors.append(error)
    if len(records) > 1:
        frames = " and ".join(repr(record.frame) for record in records.values())
        raise CalibrationError(
            f"the hands are of two trackers, {frames}: give the hand that holds the tool by --hand"
        )
    if not records:
        raise errors[0]
    return next(iter(records.values()))


def _checked(
    led: LedTracks, settings: Settings, record: CalibrationRecord, args: argparse.Namespace
) -> int:
    """Print the hand's distance from its position by the tool's pose; 1 if it is not accepted."""
    if (track := led.hands.get(record.hand)) is None:
        raise CalibrationError(
            f"hands/{record.hand} does not arrive, which was calibrated on {record.date}"
        )
    held, remarks = held_tool(track, led.tool, settings.hands_in(tracker_of(track, settings)))
    if not len(held.hand):
        raise CalibrationError("no samples of hand and arm at the same time")
    off_mm = 1e3 * distances_m(held, record.calibration)
    most_mm = args.accept + 1e3 * record.calibration.rms_m
    for remark in remarks:
        say(f"remark: {remark}")
    if track.frame not in ("", record.frame):
        say(
            f"remark: the frame is {track.frame!r}, and {record.frame!r} was calibrated: the "
            "tracker was recentred"
        )
    is_far = bool(np.median(off_mm) > most_mm)
    advice = (
        ". Does the hand hold the tool as before? Then the tracker has moved: calibrate again"
        * is_far
    )
    text = (
        f"hand at the tool: {np.median(off_mm):.0f} mm (95 %: {np.quantile(off_mm, 0.95):.0f} mm)"
    )
    print(printable_lines(f"{text}; up to {most_mm:.0f} mm accepted{advice}"))
    return int(is_far)
