"""One's own arm on thirdhand's wire: a driver to begin from. Put the arm's library in `FakeArm`'s
place; what else a driver owes is in docs/hardware.md. Give it the daemon's settings:

    python examples/own_arm.py --config cell.toml
"""

from __future__ import annotations

import argparse
import contextlib
import math
import threading
import time
from pathlib import Path

import zenoh
from zenoh.handlers import RingChannel

from service.client import client_settings
from service.config import Settings, load
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
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--config", type=Path, help="settings of the cell: joints, and where they begin, [arm] posture")
    parser.add_argument("--connect", action="append", help="of the daemon, of `thirdhand record` or of a router")
    parser.add_argument("--cell", help="prefix of all keys, else as configured")
    args = parser.parse_args()
    settings = load(args.config) if args.config else Settings()
    client = client_settings(connect=args.connect, cell=args.cell or (settings.cell if args.config else None))
    arm = FakeArm(settings.joints.names, settings.arm.posture)
    with client.session(timeout_s=None) as session:
        print(f"{', '.join(arm.names)} of cell {client.cell} are driven; Ctrl-C ends it", flush=True)
        drive(arm, session, client.cell, threading.Event())


if __name__ == "__main__":
    with contextlib.suppress(KeyboardInterrupt):
        main()
