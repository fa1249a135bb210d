"""Probes for `thirdhand bench`, each a process that prints one JSON line: a loop with a fixed piece
of work, a loop with the core alone, a tracker that measures the commands' latency, and an echo.
"""

from __future__ import annotations

from thirdhand.process import one_blas_thread  # noqa: F401

# isort: split
import functools
import json
import math
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import msgspec
import numpy as np
import zenoh

from thirdhand.client import Publisher, endpoints, open_session
from thirdhand.contract import cdr, channels
from thirdhand.contract.messages import PoseStamped
from thirdhand.contract.records import SIDES
from thirdhand.core.controller import Controller
from thirdhand.core.frame import Event, Tick, Vector
from thirdhand.core.skill.skill import Skill
from thirdhand.core.warm_up import warm_up
from thirdhand.daemon.clock import SPIN_NS, Deadlines, ask_for_real_time
from thirdhand.recordings.shipped import cell_of
from thirdhand.settings.config import Settings, robot_description
from thirdhand.skills.skill_file import decoded

PERCENTS = (50.0, 99.0, 99.9, 100.0)
EDGES_US = np.geomspace(1.0, 1e5, 101)  # edges of the histograms' bins
TRACKER_HZ = 487.3  # it is no multiple of a loop's rate
SWAY_M = 0.03  # amplitude of the hands' motion
SWAY_HZ = 0.3  # frequency of the hands' motion
HANDS_EVERY_S = 0.01
PING_EVERY = 20  # every 20th sample measures the round trip
FLOATS = 200  # additions in Python in the fixed piece of work
CALLS = 20  # calls of NumPy in the fixed piece of work
UNCOUNTED_S = 1.0  # the first second is not counted


def percentiles(values: Any) -> dict[str, float]:
    """The percentiles PERCENTS of values, by name; zeros without values."""
    quantiles = (
        np.percentile(values, PERCENTS).round(2).tolist() if len(values) else [0.0] * len(PERCENTS)
    )
    return dict(zip(("p50", "p99", "p99.9", "max"), quantiles, strict=True))


def figures(lateness_us: Any, work_us: Any) -> dict[str, Any]:
    """Percentiles and histograms of a loop's lateness and work [µs]."""
    results: dict[str, Any] = {}
    for name, values in (("lateness", lateness_us), ("work", work_us)):
        results[f"{name}_us"] = percentiles(values)
        results[f"{name}_counts"] = np.histogram(
            np.clip(values, EDGES_US[0], EDGES_US[-1]), EDGES_US
        )[0].tolist()
    return results


def fixed_work(array: Vector) -> float:
    """Do a fixed piece of work in Python and NumPy, which measures the machine's present speed."""
    total = 0.0
    for k in range(FLOATS):
        total += 0.5 * k
    for _ in range(CALLS):
        array = np.minimum(array * 1.0, 2.0)
    return total + float(array[0])


def loop(rate_hz: int, seconds: float, work: Callable[[int], object]) -> dict[str, Any]:
    """Run a loop that does `work` each tick; its missed deadlines, lateness and work [µs]."""
    realtime = ask_for_real_time().realtime
    clock = Deadlines(rate_hz, spin_ns=SPIN_NS if realtime else 0)
    late_us = []
    work_us = []
    first = missed = 0
    for _ in range(round((UNCOUNTED_S + seconds) * rate_hz)):
        index, late_ns = clock.wait()
        began = time.perf_counter_ns()
        work(index)
        took = time.perf_counter_ns() - began
        if index < UNCOUNTED_S * rate_hz:
            first = index
            missed = clock.missed
        elif index > (UNCOUNTED_S + seconds) * rate_hz:
            break
        else:
            late_us.append(late_ns / 1e3)
            work_us.append(took / 1e3)
    return {
        "realtime": realtime,
        "ticks": index - first,
        "missed": clock.missed - missed,
        **figures(late_us, work_us),
    }


@functools.cache
def _middle(skill: Skill) -> list[float]:
    """The demonstrated positions of both hands (6,) [m] that are nearest to their mean."""
    hands = skill.hands
    nearest: list[float] = hands[((hands - hands.mean(axis=0)) ** 2).sum(axis=1).argmin()].tolist()
    return nearest


def swaying(skill: Skill, t: float) -> list[tuple[float, float, float]]:
    """Positions of both hands [m] at a time [s], swaying about demonstrated positions."""
    middle = _middle(skill)
    x = SWAY_M * math.sin(2 * math.pi * SWAY_HZ * t)
    return [(middle[0] + x, middle[1], middle[2]), (middle[3] + x, middle[4], middle[5])]


def hands_of(session: zenoh.Session, skill: Skill) -> Callable[[float, int], None]:
    """A function that publishes both swaying hands of a time [s] with a stamp [ns]."""
    cell = Settings().cell
    publishers = [Publisher(session, cell, f"hands/{side}") for side in SIDES]

    def publish(t: float, stamp_ns: int) -> None:
        for publisher, place in zip(publishers, swaying(skill, t), strict=True):
            publisher.put(
                cdr.encode_pose(PoseStamped(stamp_ns, "base", place, (0.0, 0.0, 0.0, 1.0)))
            )

    return publish


def core(skill: Skill, rate_hz: int, seconds: float, arm: str) -> dict[str, Any]:
    """Run the loop with the core alone; the result of `loop`."""
    cell = cell_of(arm)
    assumed = msgspec.structs.replace(cell.arm, source="assumed")
    settings = msgspec.structs.replace(cell, rate_hz=rate_hz, arm=assumed)
    skill = replace(skill, threshold=math.inf)
    urdf = robot_description(settings)
    warm_up(settings, skill, urdf=urdf)
    controller = Controller(settings, skill, urdf=urdf)
    every = max(1, round(HANDS_EVERY_S * rate_hz))

    def step(index: int) -> object:
        hands = swaying(skill, index / rate_hz) if index % every == 0 else []
        poses = (PoseStamped(1 + index, "", place, (0.0, 0.0, 0.0, 1.0)) for place in hands)
        return controller.step(
            Tick(
                index,
                tuple(
                    Event(f"hands/{side}", b"", pose)
                    for side, pose in zip(SIDES, poses, strict=False)
                ),
            )
        )

    return loop(rate_hz, seconds, step)


def tracker(skill: Skill, endpoint: str, echo_at: str, seconds: float) -> dict[str, Any]:
    """Measure the time from a published hand to its command, and the round trip to an echo [ms]."""
    cell = Settings().cell
    answered: dict[int, int] = {}
    trips_ms: list[float] = []

    def command(sample: zenoh.Sample) -> None:
        if sample.attachment is not None:
            newest = cdr.decode_attachment(sample.attachment.to_bytes()).hand_stamp_ns
            answered.setdefault(newest, time.time_ns())

    def pong(sample: zenoh.Sample) -> None:
        trips_ms.append((time.time_ns() - int(sample.payload.to_bytes())) / 1e6)

    with open_session(connect=[endpoint, echo_at], more={"mode": "peer"}) as session:
        listening = [
            session.declare_subscriber(channels.key(cell, "joints/command"), command),
            session.declare_subscriber("probe/pong", pong),
        ]
        publish = hands_of(session, skill)
        ping = session.declare_publisher("probe/ping", express=True)
        start_ns = time.time_ns()
        sent = []
        for k in range(round((UNCOUNTED_S + seconds) * TRACKER_HZ)):
            due_ns = start_ns + round(1e9 * k / TRACKER_HZ)
            time.sleep(max(0.0, (due_ns - time.time_ns()) / 1e9))
            now_ns = time.time_ns()
            publish(k / TRACKER_HZ, now_ns)
            if k > UNCOUNTED_S * TRACKER_HZ:
                sent.append(now_ns)
                if k % PING_EVERY == 0:
                    ping.put(str(time.time_ns()).encode())
        time.sleep(0.1)
        for subscriber in listening:
            subscriber.undeclare()  # type: ignore[no-untyped-call]
    latencies_ms = [(answered[stamp] - stamp) / 1e6 for stamp in sent if stamp in answered]
    return {
        "latency_ms": percentiles(latencies_ms),
        "round_trip_ms": percentiles(trips_ms),
        "sent": len(sent),
    }


def echo() -> None:
    """Send received messages back until the standard input ends."""
    with open_session(listen=["tcp/127.0.0.1:0"]) as session:
        back = session.declare_publisher("probe/pong", express=True)
        heard = session.declare_subscriber("probe/ping", lambda sample: back.put(sample.payload))
        print(endpoints(session)[0], flush=True)
        sys.stdin.read()
        heard.undeclare()  # type: ignore[no-untyped-call]


def main(kind: str, *arguments: str) -> int:
    """Run the probe of a command line: `empty RATE SECONDS`, `core SKILL RATE SECONDS ARM`,
    `tracker SKILL ENDPOINT ECHO SECONDS` or `echo`.
    """
    if kind == "echo":
        echo()
        return 0
    if kind == "empty":
        array = np.ones(7)
        result = loop(int(arguments[0]), float(arguments[1]), lambda index: fixed_work(array))
    else:
        with open(arguments[0], "rb") as file:
            skill = decoded(file.read(), origin=arguments[0])
        if kind == "core":
            result = core(skill, int(arguments[1]), float(arguments[2]), arguments[3])
        else:
            result = tracker(skill, arguments[1], arguments[2], float(arguments[3]))
    print(json.dumps(result), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
