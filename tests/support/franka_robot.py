"""A Franka simulated by franky-sim on a loopback address, as a process of its own. Commands and
joints of each millisecond are written to a file when its standard input ends.

python tests/support/franka_robot.py FILE [--fast]: as fast as commands arrive, else in real time.
Each millisecond lasts until its command has arrived, so that none is missed on a busy machine.
"""

from __future__ import annotations

import sys
import threading
import time
from typing import Any

import numpy as np
from franky_sim import SimulationServer
from franky_sim.mujoco_simulator import MujocoSimulator

# time-outs of the first and of later commands
FIRST_S = 0.002
NEXT_S = 5.0


def main(path: str, *, fast: bool) -> None:
    """Run until standard input ends."""
    cycles: list[tuple[bool, Any, Any]] = []
    commands: list[tuple[Any, bool]] = []
    ended = threading.Event()

    def wait() -> None:
        sys.stdin.read()
        ended.set()

    threading.Thread(target=wait, daemon=True).start()
    with MujocoSimulator() as sim:
        robot = sim.add_robot()
        control = robot.joint_velocity_control

        def controlled(velocity: Any, has_new_command: bool = True) -> None:
            commands[:] = [(velocity, has_new_command)]
            control(velocity, has_new_command)

        robot.joint_velocity_control = controlled
        with SimulationServer(sim) as server:
            print(robot.hostname, flush=True)
            robots = server.robot_servers
            led = False
            due = time.monotonic()
            while not ended.is_set():
                commands.clear()
                robots[0].process_commands()
                patience = time.monotonic() + (NEXT_S if led else FIRST_S)
                while (
                    commands
                    and not commands[0][1]
                    and time.monotonic() < patience
                    and not ended.is_set()
                ):
                    time.sleep(2e-5)
                    commands.clear()
                    robots[0].process_commands()
                led = bool(commands) and (led or commands[0][1])
                if commands:
                    cycles.append((commands[0][1], commands[0][0], robot.inner_state.q))
                sim.step()
                robots[0].send_state()
                due = max(due + 0.001, time.monotonic() - 0.02)
                if not (fast and led):
                    time.sleep(max(due - time.monotonic(), 0.0))
    new, velocity, joints = (np.array([cycle[i] for cycle in cycles]) for i in range(3))
    np.savez(path, new=new, velocity=velocity, joints=joints)


if __name__ == "__main__":
    main(sys.argv[1], fast="--fast" in sys.argv)
