"""Playback of commands: whatever the network, daemons and clocks do, the positions written to the
drive hold every limit. Without such disturbances they are the commanded ones, a little later.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from thirdhand.arms.playback import REJOIN_AFTER_S, REJOIN_RAD, Playback
from thirdhand.client import BRAKE_AFTER_S, Command
from thirdhand.core.limiter.stage import Limiter
from thirdhand.settings.config import JointSettings

TICK = 0.002  # [s]
PERIOD = 0.001  # [s] of a drive
COMMANDED = JointSettings()
STRONG = JointSettings(velocity=(2.0,) * 7, acceleration=(30.0,) * 7, jerk=(4000.0,) * 7)
# too weak to follow all commands
WEAK = JointSettings(acceleration=(4.0,) * 7, jerk=(60.0,) * 7)
DRIVES = {"as commanded": COMMANDED, "stronger": STRONG, "weaker": WEAK}
AT = np.array([0.0, 0.0, 0.0, 1.2, -1.5, 0.0, 0.0])
LOWER = np.array(COMMANDED.lower)
UPPER = np.array(COMMANDED.upper)
Vector = npt.NDArray[np.float64]


class Written(NamedTuple):
    """The positions and velocities written to a drive, (N, 7) each; before them it was at rest."""

    position: Vector
    velocity: Vector


class Sent(NamedTuple):
    """A command, and its time of receipt."""

    at_s: float
    command: Command


def commanded(
    tick: int, position: Iterable[float], velocity: Iterable[float], stamp_ns: int | None = None
) -> Command:
    stamp_ns = round(1e9 * TICK * tick) if stamp_ns is None else stamp_ns
    return Command(stamp_ns, tuple(position), tuple(velocity), tick, 0, 0)


def motion(wanted: Vector, *, at: Vector = AT, tick: int = 0) -> list[Command]:
    """Commands as the service gives them, each tick, from rest."""
    limiter = Limiter(COMMANDED, TICK)
    state = (at, np.zeros(7), np.zeros(7))
    commands = [commanded(tick, at, np.zeros(7))]
    for i, velocity in enumerate(wanted, start=1):
        state = limiter.step(*state, velocity)[:3]
        commands.append(commanded(tick + i, state[0], state[1]))
    return commands


def sway(seconds: float) -> Vector:
    """Velocities of a fast and smooth motion."""
    times = TICK * np.arange(round(seconds / TICK))[:, None]
    swayed: Vector = 1.2 * np.minimum(times, 1.0) * np.sin(2.0 * times + 0.5 * np.arange(7))
    return swayed


def sent(
    commands: Sequence[Command], late_s: Sequence[float] = (0.0,), begin_s: float = 0.0
) -> list[Sent]:
    """Commands tick by tick, each received with a delay."""
    return [
        Sent(begin_s + i * TICK + late_s[i % len(late_s)], command)
        for i, command in enumerate(commands)
        if not math.isnan(late_s[i % len(late_s)])  # lost
    ]


def drive(limits: JointSettings = STRONG, period: float = PERIOD) -> Playback:
    """The playback of a drive at rest."""
    return Playback(limits, AT, period_s=period)


def play(
    playback: Playback,
    arriving: Iterable[Sent],
    seconds: float,
    period: float = PERIOD,
    elapsed: Sequence[float] = (-1.0,),
) -> Written:
    queue = sorted(arriving, key=lambda one: -one.at_s)
    written = []
    for i in range(round(seconds / period)):
        came: list[Command] = []
        while queue and queue[-1].at_s <= i * period:
            came.append(queue.pop().command)
        written.append(playback.step(came, elapsed_s=elapsed[i % len(elapsed)]))
    return Written(*(np.array([step[k] for step in written]) for k in range(2)))


def assert_held(limits: JointSettings, written: Written, period: float = PERIOD) -> None:
    position = np.vstack((AT, written.position))
    velocity = np.vstack((np.zeros((2, 7)), written.velocity))
    acceleration = np.diff(velocity, axis=0) / period
    jerk = np.diff(acceleration, axis=0) / period
    assert np.isfinite(position).all()
    assert (position >= LOWER).all()
    assert (position <= UPPER).all()
    assert (np.abs(velocity) <= np.array(limits.velocity) * (1 + 1e-9)).all()
    assert (np.abs(acceleration) <= np.array(limits.acceleration) * (1 + 1e-6)).all()
    assert (np.abs(jerk) <= np.array(limits.jerk) * (1 + 1e-6)).all()
    between = 0.5 * (velocity[2:] + velocity[1:-1])
    assert (
        np.abs(np.diff(position, axis=0) / period - between)
        <= np.array(limits.jerk) * period**2 + 2e-6
    ).all()


# --- any commands --------------------------------------------------------------------------------

speeds = st.tuples(*[st.sampled_from([0.0, 0.3, -0.7, 1.5, -1.5])] * 7)
wishes = st.lists(st.tuples(speeds, st.integers(5, 60)), min_size=1, max_size=4)
late = st.lists(
    st.one_of(st.floats(0.0, 0.003), st.floats(0.0, 0.06), st.sampled_from([0.0, math.nan, 0.3])),
    min_size=1,
    max_size=40,
)
clocks = st.lists(
    st.sampled_from([0.001, 0.002, 0.0, 0.02, -1.0, 1e9, math.nan]), min_size=1, max_size=9
)
numbers = st.one_of(st.floats(), st.floats(-3.2, 3.2))
hostile = st.builds(
    commanded,
    st.integers(-1, 400),
    st.lists(numbers, min_size=6, max_size=8),
    st.lists(numbers, min_size=7, max_size=7),
    st.none() | st.integers(-(10**9), 10**12),
)
restarts = st.tuples(
    st.integers(0, 150),
    st.integers(0, 2000),
    st.floats(-0.06, 0.06),
    st.sampled_from([0.0, 0.04, 0.5]),
)


@pytest.mark.parametrize("period", [0.001, 0.002, 0.004])
@pytest.mark.parametrize("limits", DRIVES.values(), ids=DRIVES)
@settings(derandomize=True, deadline=None, max_examples=40)
@given(
    wishes,
    late,
    clocks,
    st.lists(st.tuples(st.floats(0.0, 0.4), hostile), max_size=6),
    st.none() | restarts,
)
@pytest.mark.one_case
def test_limits_hold_whatever_network_and_clocks_do(
    limits: JointSettings,
    period: float,
    wishes: list[tuple[tuple[float, ...], int]],
    late: list[float],
    clocks: list[float],
    hostile: list[tuple[float, Command]],
    restart: tuple[int, int, float, float] | None,
) -> None:
    wishes_radps = np.array([value for value, count in wishes for _ in range(count)])
    commands = motion(wishes_radps)
    arriving = [*sent(commands, late), *(Sent(*pair) for pair in hostile)]
    # the new daemon counts ticks anew, and starts near the arm
    if restart is not None:
        after, tick, offset_rad, silent_s = restart
        end = commands[min(after, len(commands) - 1)]
        commands = commands[:after]
        restarted = motion(
            -wishes_radps, at=(np.array(end.position) + offset_rad).clip(LOWER, UPPER), tick=tick
        )
        arriving = [*sent(commands, late), *sent(restarted, late, len(commands) * TICK + silent_s)]
    playback = drive(limits, period)
    written = play(playback, arriving, len(wishes_radps) * TICK + 1.0, period, clocks)
    assert_held(limits, written, period)


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf, 9.0, -9.0])
@pytest.mark.parametrize("which", ["position", "velocity"])
def test_what_is_not_finite_or_outside_the_limits_moves_nothing(bad: float, which: str) -> None:
    playback = drive(COMMANDED)
    position = [*AT]
    velocity = [0.0] * 7
    (position if which == "position" else velocity)[3] = bad
    arriving = sent([commanded(i, position, velocity) for i in range(100)])
    assert (play(playback, arriving, 0.3).position == AT).all()
    assert playback.refused == 100
    assert "finite" in playback.reason or "limit" in playback.reason


def test_jump_within_the_limits_is_refused() -> None:
    """The motion of the other commands continues."""
    commands = motion(sway(1.0))
    jumping = [
        Sent(message.at_s, message.command._replace(position=tuple(AT)))
        for message in sent(commands)[300::50]
    ]
    playback = drive(COMMANDED)
    regular = [message for i, message in enumerate(sent(commands)) if i < 300 or i % 50]
    written = play(playback, [*regular, *jumping], 1.0)
    assert (playback.refused, playback.reason) == (4, "a jump from the command before")
    late, error_rad = behind(written, commands)
    assert late < 0.006
    assert error_rad < 2e-3


def test_another_number_of_joints_is_refused_and_named() -> None:
    playback = drive(COMMANDED)
    playback.step([commanded(0, AT[:6], [0.0] * 6)])
    assert playback.reason == "6 joints, 7 needed"


# --- silence -------------------------------------------------------------------------------------


def test_it_brakes_20_ms_after_the_last_command() -> None:
    """The arm brakes as fast as its limits allow."""
    playback = drive(COMMANDED)
    commands = motion(np.full((400, 7), 0.5))
    written = play(playback, sent(commands), len(commands) * TICK + 1.0)
    moving = np.abs(written.velocity).max(axis=1)
    silent = round((len(commands) - 1) * TICK / 0.001)
    assert moving[silent + round(BRAKE_AFTER_S / 0.001) - 2] == pytest.approx(0.5, abs=1e-3)
    slowest = min(COMMANDED.acceleration)
    jerk = min(COMMANDED.jerk)
    stop_s = BRAKE_AFTER_S + 0.5 / slowest + slowest / jerk
    assert not moving[silent + round(stop_s / 0.001) + 3 :].any()
    assert_held(COMMANDED, written)


def test_a_sequence_is_taken_up_again_within_a_tenth_of_a_second() -> None:
    playback = drive()
    commands = motion(sway(2.0))
    cut = [message for message in sent(commands) if not 1.0 < message.at_s < 1.06]
    written = play(playback, cut, 2.0)
    assert np.abs(written.position[-1] - commands[-1].position).max() < 0.01
    assert_held(STRONG, written)


@pytest.mark.parametrize(
    ("off", "speed", "followed"),
    [(0.0, 0.0, True), (0.04, 0.0, True), (0.06, 0.0, False), (0.0, 0.1, False)],
)
@pytest.mark.parametrize("at_start", [True, False])
def test_after_silence_only_what_begins_at_the_arm_is_followed(
    off: float, speed: float, followed: bool, at_start: bool
) -> None:
    assert REJOIN_RAD == 0.05
    playback = drive(COMMANDED)
    arm = AT
    if not at_start:
        arm = play(
            playback, sent(motion(np.full((200, 7), 0.2))), 0.4 + 0.3 + REJOIN_AFTER_S
        ).position[-1]
    where = arm + off * np.eye(7)[2]
    after = [commanded(900 + i, where + i * TICK * speed, [speed] * 7) for i in range(40)]
    written = play(playback, sent(after), 0.2)
    assert (written.position == arm).all() == (not followed or off == 0.0)
    assert playback.refused == (0 if followed else 40)
    assert followed or "begin where the arm stands" in playback.reason


def test_late_commands_do_not_move_a_stopped_arm() -> None:
    """Half a second of commands arrives at once, half a second late."""
    playback = drive(COMMANDED)
    commands = motion(sway(1.5))
    held = [
        Sent(1.0, message.command) if 0.5 < message.at_s < 1.0 else message
        for message in sent(commands[:500])
    ]
    written = play(playback, held, 1.5)
    assert (written.position[1000:] == written.position[999]).all()
    assert playback.refused > 200


def test_two_daemons_at_once_do_not_pull_the_arm_to_and_fro() -> None:
    """The daemon heard first is followed; the ticks of the second one do not continue its
    sequence.
    """
    first = motion(sway(1.0))
    other = motion(-sway(1.0), tick=40_000)
    playback = drive(COMMANDED)
    written = play(playback, [*sent(first), *sent(other[10:], begin_s=10 * TICK)], 1.0)
    assert np.abs(written.position[-1] - first[-1].position).max() < 0.01
    assert playback.refused > 400


# --- the length of a tick ------------------------------------------------------------------------


def at_rate(rate_hz: int, seconds: float, *, at: Vector = AT) -> list[Sent]:
    """Commands of a daemon of this rate: from rest, an oscillation of 0.15 rad at 0.4 Hz."""
    pace = 2 * math.pi * 0.4
    arriving = []
    for k in range(round(seconds * rate_hz)):
        t = k / rate_hz
        position = at + 0.15 * (1 - math.cos(pace * t))
        velocity = np.full(7, 0.15 * pace * math.sin(pace * t))
        command = commanded(k, position, velocity, stamp_ns=10**18 + round(1e9 * t))
        arriving.append(Sent(t, command))
    return arriving


def farthest_rad(written: Written, arriving: Sequence[Sent], period: float = PERIOD) -> float:
    """The largest distance between a written position and the newest command at that time [rad]."""
    when = [message.at_s for message in arriving]
    where = [message.command.position[0] for message in arriving]
    expected_rad = np.interp(period * np.arange(1, len(written.position) + 1), when, where)
    return float(np.abs(written.position[:, 0] - expected_rad).max())


@pytest.mark.parametrize("period", [0.001, 0.002, 0.004])
@pytest.mark.parametrize("rate_hz", [67, 100, 250, 500, 700, 1000])
def test_commands_of_any_rate_are_played_back_at_their_own_pace(
    rate_hz: int, period: float
) -> None:
    playback = drive(period=period)
    arriving = at_rate(rate_hz, 4.0)
    written = play(playback, arriving, 4.0, period)
    assert playback.tick_s == pytest.approx(1 / rate_hz, rel=1e-3)
    assert playback.refused == 0
    # at most two periods late, at up to 0.38 rad/s
    assert farthest_rad(written, arriving, period) < 0.4 * (2 / rate_hz + 2 * period)


@pytest.mark.parametrize(
    ("since", "stamped"),
    [
        (800, lambda stamp_ns, k: stamp_ns + 3_600_000_000_000),
        # stamps that advance by 1 us until the clock has caught up
        (800, lambda stamp_ns, k: 10**18 + 1_598_000_000 + 1_000 * (k - 799)),
        (0, lambda stamp_ns, k: stamp_ns + 20_000 * (k % 7)),
    ],
    ids=["set ahead", "set back", "trembles"],
)
def test_a_clock_that_is_set_does_not_change_the_pace(
    since: int, stamped: Callable[[int, int], int]
) -> None:
    arriving = [
        message
        if k < since
        else message._replace(
            command=message.command._replace(stamp_ns=stamped(message.command.stamp_ns, k))
        )
        for k, message in enumerate(at_rate(500, 4.0))
    ]
    playback = drive()
    written = play(playback, arriving, 4.0)
    assert playback.refused == 0
    assert farthest_rad(written, arriving) < 0.003


def test_daemon_of_another_rate_is_followed() -> None:
    """A daemon of another rate that takes over is followed at that rate."""
    playback = drive()
    first = at_rate(250, 1.0)
    stands = play(playback, first, 1.5).position[-1]
    second = at_rate(1000, 3.0, at=stands)
    assert farthest_rad(play(playback, second, 3.0), second) < 0.003
    assert playback.tick_s == pytest.approx(0.001, rel=1e-3)


@pytest.mark.parametrize("rate_hz", [50, 60, 66])
def test_commands_without_room_to_brake_are_refused(rate_hz: int) -> None:
    """The refused commands do not move the arm."""
    playback = drive(COMMANDED)
    assert (play(playback, at_rate(rate_hz, 2.0), 2.0).position == AT).all()
    period = f"{1000 / rate_hz:.0f} ms"
    assert playback.reason == playback.too_slow
    assert playback.too_slow == (
        f"{rate_hz} Hz is too slow: commands would arrive every {period}, and an arm brakes 20 ms "
        "after its last command; 67 Hz or more needed"
    )


def test_commands_without_a_tick_length_are_refused() -> None:
    """Commands are refused if their stamps do not show the length of a tick."""
    playback = drive(COMMANDED)
    unstamped = [
        message._replace(command=message.command._replace(stamp_ns=0))
        for message in at_rate(500, 1.0)
    ]
    assert (play(playback, unstamped, 0.1).position == AT).all()
    assert "no length of a tick" in playback.reason
    assert playback.reason.endswith("1 to 20 ms a tick needed")
    assert playback.too_slow == ""


# --- accuracy ------------------------------------------------------------------------------------


def behind(
    written: Written, commands: Sequence[Command], period: float = PERIOD
) -> tuple[float, float]:
    """The delay [s] of the written positions, and their largest error apart from it [rad]."""
    times = TICK * np.arange(len(commands))
    positions, speed = (
        np.array([getattr(command, name) for command in commands])
        for name in ("position", "velocity")
    )
    when = period * np.arange(1, len(written.position) + 1)
    where, fast = (
        np.stack([np.interp(when, times, x[:, j]) for j in range(7)], axis=1)
        for x in (positions, speed)
    )
    error = written.position - where
    late = -float((error * fast).sum() / (fast * fast).sum())
    return late, float(np.abs(error + late * fast).max())


@pytest.mark.parametrize("period", [0.001, 0.002, 0.004])
@pytest.mark.parametrize(
    ("jitter_s", "lost", "delay_s", "off_rad", "share"),
    [
        (0.0, 0.0, 0.004, 3e-4, 1.05),
        (0.001, 0.0, 0.006, 3e-4, 1.05),
        (0.006, 0.1, 0.016, 6e-3, 2.0),
    ],
)
def test_delay_error_and_smoothness_under_jitter(
    period: float, jitter_s: float, lost: float, delay_s: float, off_rad: float, share: float
) -> None:
    """The delay is what the jitter needs; apart from it, errors are small and the motion is
    smooth.
    """
    rng = np.random.default_rng(3)
    commands = motion(sway(6.0))
    late_s = np.where(
        rng.uniform(size=len(commands)) < lost, math.nan, rng.uniform(0, jitter_s, len(commands))
    )
    playback = drive(period=period)
    written = play(playback, sent(commands, late_s.tolist()), 6.0, period)
    late, error_rad = behind(written, commands, period)
    assert 0.0 < late < delay_s + period
    assert error_rad < off_rad
    assert 0.9 <= playback.delay_ticks < (delay_s + period) / TICK
    assert playback.refused == 0
    jerk = np.diff(written.velocity, n=2, axis=0) / period**2
    assert np.abs(jerk).max() < share * max(COMMANDED.jerk)


@pytest.mark.parametrize("share", [0.97, 1.03])
def test_slow_and_fast_loops_keep_pace(share: float) -> None:
    """A loop takes a step each 0.97 or 1.03 ms for a drive whose period is 1 ms."""
    commands = motion(sway(6.0))
    playback = drive()
    arriving = [Sent(message.at_s / share, message.command) for message in sent(commands)]
    written = play(playback, arriving, 6.0 / share, PERIOD, [PERIOD * share])
    assert np.abs(written.position[-1] - commands[-1].position).max() < 0.02
    assert playback.delay_ticks < 3.0
    assert_held(STRONG, written)


def test_after_a_pause_of_its_loop_it_is_no_later_than_before() -> None:
    """The loop pauses for 60 ms each second; the network is punctual."""
    commands = motion(sway(6.0))
    playback = drive()
    queue = list(reversed(sent(commands)))
    velocity: list[Vector] = []
    now_s = before_s = 0.0
    while now_s < 5.9:
        now_s += 0.06 if len(velocity) % 1000 == 999 else 0.001
        came = []
        while queue and queue[-1].at_s <= now_s:
            came.append(queue.pop().command)
        moved = playback.step(came, elapsed_s=now_s - before_s)
        before_s = now_s
        velocity.append(moved.velocity)
        assert not playback.following or playback.delay_ticks < 3.0 or len(velocity) % 1000 < 5
    assert np.abs(moved.position - commands[round(now_s / TICK)].position).max() < 0.015
    assert np.abs(np.diff(np.array(velocity), axis=0)).max() <= 0.001 * max(STRONG.acceleration)


def test_a_daemon_that_missed_deadlines_does_not_jerk_the_arm() -> None:
    """Tick numbers jump over missed deadlines, but the motion advances by one period."""
    commands = motion(sway(3.0))
    jumped = []
    tick = 0
    for i, command in enumerate(commands):
        tick += 3 if i % 200 == 199 else 1
        jumped.append(
            Sent(tick * TICK, command._replace(tick=tick, stamp_ns=round(1e9 * TICK * tick)))
        )
    playback = drive()
    written = play(playback, jumped, tick * TICK + 0.02)
    assert np.abs(np.diff(written.velocity, axis=0) / 0.001).max() < 6.0
    assert np.abs(np.diff(written.velocity, n=2, axis=0) / 0.001**2).max() < 2.5 * max(
        COMMANDED.jerk
    )
    assert np.abs(written.position[-1] - commands[-1].position).max() < 0.03


def test_delay_grows_with_jitter_and_shrinks_again() -> None:
    """The delay grows at once with jitter, and shrinks slowly without it."""
    rng = np.random.default_rng(5)
    commands = motion(sway(6.0))
    late_s = np.concatenate((np.zeros(500), rng.uniform(0, 0.01, 500), np.zeros(2001)))
    playback = drive()
    delays = []
    for begin in range(0, 3000, 500):
        play(playback, sent(commands[begin : begin + 500], late_s[begin:].tolist()), 1.0)
        delays.append(playback.delay_ticks)
    assert delays[0] < 1.1
    assert 2.5 < delays[1] < 8.0
    assert delays[2] > delays[3] > delays[4]
    assert delays[5] < 2.0
