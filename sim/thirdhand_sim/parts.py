"""Parts of a cell as processes that tests kill, freeze and restart: a tracker, a network between
two ends, and a Zenoh router.

python -m thirdhand_sim.parts PART, where PART is

tracker ENDPOINT    publishes both hands at 100 Hz; from SIGUSR1 on it repeats the last sample; each
                    SIGUSR2 sets its clock back by an hour, or ahead again
relay TARGET PORT   relays TCP from tcp/127.0.0.1:PORT to TARGET; if it is frozen, the network is
                    silent
router PORT         a Zenoh session that routes between its clients
"""

from __future__ import annotations

from thirdhand.process import one_blas_thread  # noqa: F401

# isort: split
import argparse
import asyncio
import contextlib
import itertools
import math
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator

from thirdhand.client import Publisher, endpoints, open_session
from thirdhand.contract import cdr, messages
from thirdhand.contract.explain import in_words
from thirdhand.daemon.clock import Deadlines
from thirdhand.process import child
from thirdhand_sim.scene import Scene
from thirdhand_sim.script import HandScript

CELL = "thirdhand"  # the default cell
PART_HANDS_HZ = 100
HOUR_NS = 3_600_000_000_000
MIDDLE_S = 5.15  # script time at which the tool is fastest
SWING_S = 1.2  # amplitude of the swing about that time
FASTEST = 1.7  # rate of the script in the middle of the swing
START_TIMEOUT_S = 60.0
PRIORITY = 20  # below the service's loop, above its other threads


def before_others() -> None:
    """Schedule this thread, and those that it starts, before other processes, if granted, so that a
    busy machine does not look like a fault.
    """
    with contextlib.suppress(PermissionError, AttributeError, OSError):
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(PRIORITY))


@contextlib.contextmanager
def as_usual_afterwards() -> Iterator[None]:
    """A context in which this thread and new threads are scheduled before other processes."""
    before_others()
    try:
        yield
    finally:
        with contextlib.suppress(PermissionError, AttributeError, OSError):
            os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))


class PartError(RuntimeError):
    """A part did not start; the message has its name."""


def script_time(time_s: float) -> float:
    """The script's time [s] for hands that swing to and fro where the tool is fastest."""
    return MIDDLE_S + SWING_S * math.sin(FASTEST / SWING_S * time_s)


def track(endpoint: str, seed: int) -> None:
    """Publish both hands forever. From SIGUSR1 on the last sample is repeated; SIGUSR2 sets the
    clock of the stamps.
    """
    repeats = threading.Event()
    offs_ns = itertools.cycle([HOUR_NS, 0])
    off_ns = 0

    def set_the_clock(*_: object) -> None:
        nonlocal off_ns
        off_ns = next(offs_ns)

    signal.signal(signal.SIGUSR1, lambda *_: repeats.set())
    signal.signal(signal.SIGUSR2, set_the_clock)
    script = HandScript(Scene(), seed=seed)
    sides = ("left", "right")
    with open_session(connect=[endpoint]) as session:
        publishers = [Publisher(session, CELL, f"hands/{side}") for side in sides]
        clock = Deadlines(PART_HANDS_HZ)
        payloads = [b"", b""]
        print("begun", flush=True)
        while True:
            clock.wait()
            if not repeats.is_set() or not payloads[0]:
                stamp_ns = time.time_ns() - off_ns
                poses = [pose.tolist() for pose in script.sample(script_time(time.monotonic()))]
                payloads = [
                    cdr.encode_pose(
                        messages.PoseStamped(stamp_ns, messages.BASE, (x, y, z), tuple(turn))
                    )
                    for x, y, z, *turn in poses
                ]
            for publisher, payload in zip(publishers, payloads, strict=True):
                publisher.put(payload)


async def _pump(source: asyncio.StreamReader, sink: asyncio.StreamWriter) -> None:
    try:
        while data := await source.read(65536):
            sink.write(data)
            await sink.drain()
    except OSError:  # the other direction ends too
        pass
    finally:
        sink.close()


async def relay(target: str, port: int) -> None:
    """Relay bytes between each client and the target, forever."""
    host, _, target_port = target.removeprefix("tcp/").rpartition(":")

    async def carry(near: asyncio.StreamReader, to_near: asyncio.StreamWriter) -> None:
        try:
            far, to_far = await asyncio.open_connection(host, int(target_port))
        except OSError:  # nothing listens at the target
            to_near.close()
            return
        await asyncio.gather(_pump(near, to_far), _pump(far, to_near))

    server = await asyncio.start_server(carry, "127.0.0.1", port)
    print(f"listening on tcp/127.0.0.1:{server.sockets[0].getsockname()[1]}", flush=True)
    await server.serve_forever()


def route(port: int) -> None:
    """Route between the clients that connect, forever."""
    with open_session(listen=[f"tcp/127.0.0.1:{port}"], more={"mode": "router"}) as session:
        print(f"listening on {endpoints(session)[0]}", flush=True)
        signal.pause()


class CellPart:
    """A running part with its `endpoint`. Raises PartError if it does not start.

    `again` restarts it at the same endpoint.
    """

    def __init__(self, *arguments: str) -> None:
        self._arguments = arguments
        self._start()

    def _start(self) -> None:
        command = [sys.executable, "-m", "thirdhand_sim.parts", *self._arguments]
        self.process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        clock = threading.Timer(START_TIMEOUT_S, self.process.kill)
        clock.start()
        assert self.process.stdout is not None
        words = self.process.stdout.readline().split()
        clock.cancel()
        if not words:
            raise PartError(
                f"python -m thirdhand_sim.parts {' '.join(self._arguments)} did not begin"
            )
        self.endpoint = words[-1]

    def send(self, number: int) -> None:
        """Send a signal to the process."""
        self.process.send_signal(number)

    def again(self) -> None:
        """Restart the process at the same endpoint."""
        self.close()
        if self._arguments[0] != "tracker":
            self._arguments = (*self._arguments[:-1], self.endpoint.rsplit(":", 1)[1])
        self._start()

    def close(self) -> None:
        """End the process."""
        self.process.kill()
        self.process.wait()
        if self.process.stdout is not None:
            self.process.stdout.close()


class Link:
    """A virtual cable between this machine and a network namespace in which a service may run. It
    can be taken down. Only root may make one; raises PartError for others.
    """

    # in the range that is reserved for measurements
    ADDRESS = "198.18.77.1"
    OTHER = "198.18.77.2"

    def __init__(self) -> None:
        self.name = f"thirdhand{os.getpid()}"
        self._cable = f"th{os.getpid()}"
        _ip("netns", "add", self.name)
        try:
            _ip(
                "link",
                "add",
                self._cable,
                "type",
                "veth",
                "peer",
                "name",
                "th0",
                "netns",
                self.name,
            )
            _ip("-n", self.name, "addr", "add", f"{self.ADDRESS}/30", "dev", "th0")
            _ip("-n", self.name, "link", "set", "th0", "up")
            _ip("-n", self.name, "link", "set", "lo", "up")
            _ip("addr", "add", f"{self.OTHER}/30", "dev", self._cable)
            self.set("up")
        except PartError:
            self.close()
            raise

    def set(self, state: str) -> None:
        """Set the cable `up` or `down`."""
        _ip("link", "set", self._cable, state)

    @property
    def program(self) -> tuple[str, ...]:
        """Arguments of Python for a service in the namespace."""
        return (
            "-c",
            "import ctypes, os, sys\n"
            f"if ctypes.CDLL(None).setns(os.open('/run/netns/{self.name}', os.O_RDONLY), 0): "
            "sys.exit('no namespace')\n"
            "from thirdhand.__main__ import main\nsys.exit(main())",
        )

    def close(self) -> None:
        """Remove the namespace and the cable."""
        _ip("netns", "del", self.name)


def _ip(*arguments: str) -> None:
    try:
        done = subprocess.run(
            ["ip", *arguments], capture_output=True, text=True, timeout=10, check=False
        )
    except OSError as error:
        raise PartError(f"ip cannot be run: {in_words(error)}") from None
    if done.returncode != 0:
        raise PartError(f"ip {' '.join(arguments)}: {done.stderr.strip()}")


def main(arguments: list[str] | None = None) -> int:
    """Run a part; exit code 0, 2 on bad usage."""
    p = argparse.ArgumentParser(
        prog="python -m thirdhand_sim.parts",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    kinds = p.add_subparsers(dest="kind", required=True)
    tracker = kinds.add_parser("tracker", help="publish both hands, moving to and fro")
    tracker.add_argument(
        "endpoint", metavar="ENDPOINT", help="the endpoint of the service or of a router"
    )
    tracker.add_argument("--seed", type=int, default=Scene().seed, help="of the hands")
    relaying = kinds.add_parser("relay", help="a network between two ends")
    relaying.add_argument(
        "target", metavar="TARGET", help="the endpoint of the other end, like tcp/127.0.0.1:7447"
    )
    routing = kinds.add_parser("router", help="a Zenoh router")
    for subparser in (relaying, routing):
        subparser.add_argument(
            "port", metavar="PORT", type=int, help="the port to listen on; 0 for a free one"
        )
    args = p.parse_args(arguments)
    child.end_with_parent()
    before_others()
    if args.kind == "tracker":
        track(args.endpoint, args.seed)
    elif args.kind == "relay":
        asyncio.run(relay(args.target, args.port))
    else:
        route(args.port)
    return 0


if __name__ == "__main__":
    sys.exit(main())
