"""One's own arm on thirdhand's wire: a driver to begin from. Put the arm's library in `FakeArm`'s
place; what else a driver owes is in docs/hardware.md.

    python examples/own_arm.py tcp/127.0.0.1:7447 thirdhand
"""

from __future__ import annotations

import contextlib
import math
import sys
import threading
import time

import zenoh
from zenoh.handlers import RingChannel

from service.client import Client, open_session
from service.contract.cdr import decode_joints, encode_joints
from service.contract.messages import JointState, WireError, finite, in_order

PERIOD_S = 0.002
BRAKE_S = 0.020  # without a command for so long the arm brakes by itself
REJOIN_S = 0.1  # and after so long it follows again only what begins where it stands,
NEAR_RAD = 0.05  # so nearly
Joints = tuple[float, ...]


class FakeArm:
    """An arm that does what it is told at once, and brakes at 10 rad/s²."""

    def __init__(self, names: tuple[str, ...], position: Joints) -> None:
        self.names, self.position, self.velocity = names, position, (0.0,) * len(names)  # [rad], [rad/s]

    def move(self, position: Joints, velocity: Joints) -> None:
        """Follows one command [rad, rad/s]."""
        self.position, self.velocity = position, velocity

    def brake(self) -> None:
        """One period on its way to rest, within what its drives can do."""
        self.velocity = tuple(math.copysign(max(abs(v) - 10 * PERIOD_S, 0.0), v) for v in self.velocity)
        self.position = tuple(q + v * PERIOD_S for q, v in zip(self.position, self.velocity, strict=True))


def drive(arm: FakeArm, session: zenoh.Session, cell: str, stop: threading.Event) -> None:
    """Tells the arm's joints and follows commands, until `stop`; then the arm is at rest."""
    state = session.declare_publisher(f"{cell}/joints/state", express=True)
    commands = session.declare_subscriber(f"{cell}/joints/command", RingChannel(1))  # the newest wins
    heard = -math.inf
    try:
        while not stop.wait(PERIOD_S):
            state.put(encode_joints(JointState(time.time_ns(), arm.names, arm.position, arm.velocity)))
            if command := command_in(commands.try_recv(), arm.names):
                off = max(abs(q - at) for q, at in zip(command[0], arm.position, strict=True))
                if time.monotonic() - heard < REJOIN_S or off < NEAR_RAD:
                    heard = time.monotonic()
                    arm.move(*command)
            if time.monotonic() - heard > BRAKE_S:
                arm.brake()
    finally:
        while any(arm.velocity):
            arm.brake()
            time.sleep(PERIOD_S)


def command_in(sample: zenoh.Sample | None, names: tuple[str, ...]) -> tuple[Joints, Joints] | None:
    """Position and velocity that are commanded, if a sample came that can be followed."""
    try:
        command = None if sample is None else in_order(decode_joints(sample.payload.to_bytes()), names)
    except WireError:
        return None  # another arm's, or no command at all
    return command if command and finite(command[0] + command[1]) else None


def main() -> None:
    """Drives a fake arm until Ctrl-C."""
    endpoint = sys.argv[1] if len(sys.argv) > 1 else "tcp/127.0.0.1:7447"
    cell = sys.argv[2] if len(sys.argv) > 2 else "thirdhand"
    with contextlib.suppress(KeyboardInterrupt), open_session(connect=[endpoint]) as session:
        names = tuple(Client(session, cell).ask("status")["joints"])
        arm = FakeArm(names, (0.0, 0.8, 0.0, 2.2, 0.0, -1.0, 0.0)[: len(names)])
        print(f"{', '.join(names)} of cell {cell} are driven; Ctrl-C ends it")
        drive(arm, session, cell, threading.Event())


if __name__ == "__main__":
    main()
