"""A control box of UFACTORY as its clients see it, on a loopback address, as a process of its own:
the commands of port 502. Its servo is late: v = (q* - q) / LAG_S.

A number on standard input stops the arm by this error (1 is the emergency stop), and 0 without one,
or clears the error. The end of the input ends the program.

python tests/support/ufactory_robot.py ADDRESS Q1 ... Q7
"""

from __future__ import annotations

import socket
import struct
import sys
import threading
import time

import numpy as np

PERIOD_S = 0.002
LAG_S = 0.05
# function codes
GET_VERSION, MOTION_ENABLE, SET_STATE, GET_STATE, GET_ERROR = 1, 11, 12, 13, 15
SET_MODE, MOVE_SERVO, GET_JOINTS = 19, 29, 42
NEEDS_ENABLE, HAS_ERROR = 0x10, 0x40  # bits of each reply
READY, SLEEPING, STOPPED = 0, 2, 4


class Robot:
    """The servo, and what the control box knows of it."""

    def __init__(self, joints: list[float]) -> None:
        self.count = len(joints)
        self.position = np.array(joints + [0.0] * (7 - self.count))
        self.velocity = np.zeros(7)
        self.target = self.position.copy()
        self.mode = 0
        self.state = STOPPED
        self.error = 0
        self.is_enabled = False

    @property
    def is_ready(self) -> bool:
        return self.is_enabled and self.state != STOPPED and self.mode == 1

    def stop(self, error: int) -> None:
        self.error = error
        self.state = STOPPED
        self.is_enabled = error != 1 and self.is_enabled

    def move(self) -> None:
        self.velocity = (self.target - self.position) / LAG_S if self.is_ready else np.zeros(7)
        self.position = self.position + PERIOD_S * self.velocity

    def answer(self, function: int, body: bytes) -> bytes:
        """The parameters of a reply."""
        if function == GET_VERSION:
            return f"{self.count},{self.count},XI1304,AC1304,v2.3.0".encode().ljust(40, b"\0")
        if function == GET_STATE:
            return bytes([self.state])
        if function == GET_ERROR:
            return bytes([self.error, 0])
        if function == GET_JOINTS:
            return struct.pack("<14f", *self.position, *self.velocity)
        if function == MOTION_ENABLE and not self.error:
            self.is_enabled = bool(body[1])
        elif function == SET_MODE:
            self.mode = body[0]
        elif function == SET_STATE and not self.error:
            self.state = SLEEPING if body[0] == READY else body[0]
            self.target = self.position.copy()
        elif function == MOVE_SERVO and self.is_ready:
            self.target = np.array(struct.unpack("<10f", body)[:7])
        return b""


def serve(connection: socket.socket, robot: Robot) -> None:
    connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    with connection, connection.makefile("rb") as stream:
        while len(header := stream.read(7)) == 7:
            number, protocol, size, function = struct.unpack(">3HB", header)
            parameters = robot.answer(function, stream.read(size - 1))
            status = HAS_ERROR * bool(robot.error) | NEEDS_ENABLE * (not robot.is_ready)
            reply = struct.pack(">3H2B", number, protocol, 2 + len(parameters), function, status)
            connection.sendall(reply + parameters)


def accept(address: str, robot: Robot) -> None:
    server = socket.create_server((address, 502))
    print("ready", flush=True)
    while True:
        connection, _ = server.accept()
        threading.Thread(target=serve, args=(connection, robot), daemon=True).start()


def main(address: str, *joints: str) -> None:
    robot = Robot([float(joint) for joint in joints])
    threading.Thread(target=accept, args=(address, robot), daemon=True).start()
    ended = threading.Event()

    def obey() -> None:
        for line in sys.stdin:
            robot.stop(int(line))
            print("stopped", flush=True)
        ended.set()

    threading.Thread(target=obey, daemon=True).start()
    due_s = time.monotonic()
    while not ended.is_set():
        due_s += PERIOD_S
        time.sleep(max(due_s - time.monotonic(), 0.0))
        robot.move()


if __name__ == "__main__":
    main(*sys.argv[1:])
