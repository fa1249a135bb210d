"""A follower of joint commands: here an arm that is ideal and only a list of numbers. It tells its
joints, and brakes where commands end. Try: python examples/follower.py --seconds 20
"""

from __future__ import annotations

import argparse
import contextlib
import math
import time

from thirdhand.client import Follower, client_settings
from thirdhand.settings.config import Settings

PERIOD_S = 0.005


def main(arguments: list[str] | None = None) -> list[float]:
    """The joints [rad] after so many seconds."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--connect", action="append", help="of the daemon or a router")
    parser.add_argument("--seconds", type=float, default=math.inf, help="else until Ctrl-C")
    args = parser.parse_args(arguments)
    client = client_settings(connect=args.connect)
    names = Settings().joints.names
    joints = list(Settings().arm.posture)
    with (
        client.session(timeout_s=None) as session,
        Follower(session, names, client.cell) as follower,
    ):
        begin = time.monotonic()
        braking = True
        while time.monotonic() - begin < args.seconds:
            command = follower.command()  # waits for one, 20 ms at most
            if command is None:
                velocity = (0.0,) * len(joints)  # an arm of mass would brake
            else:
                joints = list(command.position)
                velocity = command.velocity
            if braking != (command is None):
                braking = not braking
                print(
                    "no command for 20 ms: it brakes"
                    if command is None
                    else f"commands arrive, at tick {command.tick}"
                )
            follower.tell(joints, velocity)
            time.sleep(PERIOD_S)
        if follower.rejected:
            print(f"{follower.rejected} commands were none of this arm's: {follower.reason}")
    return joints


if __name__ == "__main__":
    with contextlib.suppress(KeyboardInterrupt):
        main()
