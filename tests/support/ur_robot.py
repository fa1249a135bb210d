"""A control box of Universal Robots as its clients see it, on a loopback address, as a process of
its own: dashboard, script port and RTDE, version 2. Its servo accelerates joints by gain (q* - q -
lookahead v). A line on standard input begins or ends a protective stop; its end ends the program.

python tests/support/ur_robot.py ADDRESS Q1 ... Q6
"""

from __future__ import annotations

import socket
import struct
import sys
import threading
import time
from collections.abc import Callable

import numpy as np

PERIOD_S = 0.002
SERVO, STOP = 11, 255  # commands in the first integer register
STRUCTS = {"DOUBLE": "d", "UINT32": "I", "INT32": "i", "VECTOR6D": "6d", "VECTOR3D": "3d"}
STRUCTS |= {"UINT8": "B", "UINT64": "Q", "VECTOR6INT32": "6i"}
ANSWERS = {
    "polyscopeversion": "URSoftware 5.11.5.1010327 (Jun 01 2021)",
    "is in remote control": "true",
    "robotmode": "Robotmode: RUNNING",
    "safetystatus": "Safetystatus: NORMAL",
    "get robot model": "UR5",
    "stop": "Stopped",
    "get serial number": "20195500001",
}
# the types of variables whose names do not show them
TYPES = {
    "robot_mode": "INT32",
    "safety_mode": "INT32",
    "safety_status": "INT32",
    "joint_mode": "VECTOR6INT32",
    "tool_mode": "UINT32",
    "runtime_state": "UINT32",
    "payload_cog": "VECTOR3D",
    "elbow_position": "VECTOR3D",
    "elbow_velocity": "VECTOR3D",
    "actual_tool_accelerometer": "VECTOR3D",
    "wrench_calc_from_currents": "VECTOR6D",
    "external_force_torque": "VECTOR6D",
    "tool_output_mode": "UINT8",
    "tool_output_voltage": "INT32",
    "tool_analog_input_types": "UINT32",
    "actual_digital_input_bits": "UINT64",
    "actual_digital_output_bits": "UINT64",
    "target_speed_fraction": "DOUBLE",
    "actual_momentum": "DOUBLE",
    "actual_main_voltage": "DOUBLE",
    "actual_robot_voltage": "DOUBLE",
    "actual_robot_current": "DOUBLE",
    "actual_execution_time": "DOUBLE",
}


def type_of(name: str) -> str:
    if name in TYPES:
        return TYPES[name]
    for part, kind in (
        ("int_register", "INT32"),
        ("double_register", "DOUBLE"),
        ("_bits", "UINT32"),
        ("bit_registers", "UINT32"),
        ("speed_slider_mask", "UINT32"),
        ("mask", "UINT8"),
        ("digital_output", "UINT8"),
        ("analog_output_type", "UINT8"),
    ):
        if part in name:
            return kind
    is_of_joints = name.startswith(
        ("actual_q", "actual_current", "actual_TCP", "actual_joint", "target_", "joint_", "ft_raw")
    ) or name in ("tcp_offset", "payload_inertia")
    return "VECTOR6D" if is_of_joints else "DOUBLE"


class Robot:
    """The servo and the values that RTDE shows."""

    def __init__(self, joints: list[float]) -> None:
        self.q = np.array(joints)
        self.v = np.zeros(6)
        self.target = self.q.copy()
        self.gain, self.lookahead = 300.0, 0.1
        self.serves = self.runs = self.is_stopped = False
        self.ready = 1  # output register: 1 ready, 2 done

    def move(self) -> None:
        wanted = self.gain * (self.target - self.q - self.lookahead * self.v)
        accelerations = wanted if self.serves and not self.is_stopped else -self.v / 0.02
        self.v += PERIOD_S * np.clip(accelerations, -40.0, 40.0)
        self.q += PERIOD_S * self.v

    def value(self, name: str) -> list[float] | float:
        known: dict[str, list[float] | float] = {
            "actual_q": self.q.tolist(),
            "actual_qd": self.v.tolist(),
            "target_q": self.target.tolist(),
            "timestamp": time.monotonic(),
            "robot_status_bits": 3 if self.runs else 1,
            "safety_status_bits": 4 if self.is_stopped else 1,
            "runtime_state": 2 if self.runs else 1,
            "robot_mode": 7,
            "safety_mode": 3 if self.is_stopped else 1,
            "output_int_register_0": self.ready,
            "speed_scaling": 1.0,
        }
        count = int(STRUCTS[type_of(name)][:-1] or 1)
        return known.get(name, [0] * count if count > 1 else 0)

    def take(self, values: tuple[float, ...]) -> None:
        if values[0] == SERVO and len(values) == 12:
            *target, _, _, _, lookahead, gain = values[1:]
            self.target = np.array(target)
            self.lookahead, self.gain = lookahead, gain
            self.serves = True
        elif values[0] == 0:
            self.ready = 1
        else:
            self.serves = False
            self.runs &= values[0] != STOP
            self.ready = 2


def dashboard(connection: socket.socket, robot: Robot) -> None:
    connection.sendall(b"Connected: Universal Robots Dashboard Server\n")
    for line in connection.makefile():
        word = line.strip().lower()
        robot.runs &= word != "stop"
        answer = f"Program running: {str(robot.runs).lower()}" if word == "running" else "ok"
        connection.sendall(f"{ANSWERS.get(word, answer)}\n".encode())


def script(connection: socket.socket, robot: Robot) -> None:
    received = b""
    while data := connection.recv(65536):
        received += data
        if received.rstrip().endswith(b"end"):
            robot.runs, robot.ready = True, 1
            received = b""


class Rtde:
    """One connection to the real-time data exchange."""

    def __init__(self, connection: socket.socket, robot: Robot) -> None:
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._connection = connection
        self._robot = robot
        self._recipes: dict[str, list[list[str]]] = {"O": [], "I": []}
        self._runs = False

    def serve(self) -> None:
        threading.Thread(target=self._stream, daemon=True).start()
        received = b""
        while data := self._connection.recv(65536):
            received += data
            while len(received) >= 3:
                size, kind = struct.unpack(">Hc", received[:3])
                if len(received) < size:
                    break
                self._answer(kind.decode(), received[3:size])
                received = received[size:]

    def _send(self, kind: str, body: bytes) -> None:
        self._connection.sendall(struct.pack(">Hc", 3 + len(body), kind.encode()) + body)

    def _answer(self, kind: str, body: bytes) -> None:
        if kind == "v":
            self._send("v", struct.pack(">4I", 5, 11, 5, 1010327))
        elif kind in "OI":
            names = body[8 if kind == "O" else 0 :].decode().strip("\0,").split(",")
            self._recipes[kind].append(names)
            types = ",".join(map(type_of, names)).encode()
            self._send(kind, struct.pack(">B", len(self._recipes[kind])) + types)
        elif kind in "VSP":
            self._runs = kind == "S" or (self._runs and kind == "V")
            self._send(kind, b"\1")
        elif kind == "U":
            names = self._recipes["I"][body[0] - 1]
            layout = "".join(STRUCTS[type_of(name)] for name in names)
            self._robot.take(struct.unpack(f">{layout}", body[1:]))

    def _stream(self) -> None:
        while True:
            time.sleep(PERIOD_S)
            for number, names in enumerate(self._recipes["O"] if self._runs else (), start=1):
                body = struct.pack(">B", number)
                for name in names:
                    value = self._robot.value(name)
                    values = value if isinstance(value, list) else [value]
                    body += struct.pack(f">{STRUCTS[type_of(name)]}", *values)
                try:
                    self._send("U", body)
                except OSError:
                    return


def listen(address: str, port: int, serve: Callable[[socket.socket], None]) -> None:
    server = socket.create_server((address, port))

    def accept() -> None:
        while True:
            connection, _ = server.accept()
            threading.Thread(target=serve, args=(connection,), daemon=True).start()

    threading.Thread(target=accept, daemon=True).start()


def main(address: str, *joints: str) -> None:
    robot = Robot([float(joint) for joint in joints])
    listen(address, 29999, lambda connection: dashboard(connection, robot))
    for port in (30001, 30002, 30003):
        listen(address, port, lambda connection: script(connection, robot))
    listen(address, 30004, lambda connection: Rtde(connection, robot).serve())
    ended = threading.Event()

    def wait() -> None:
        for _ in sys.stdin:
            robot.is_stopped = not robot.is_stopped
            print("stopped", flush=True)
        ended.set()

    threading.Thread(target=wait, daemon=True).start()
    print("ready", flush=True)
    due_s = time.monotonic()
    while not ended.is_set():
        due_s += PERIOD_S
        time.sleep(max(due_s - time.monotonic(), 0.0))
        robot.move()


if __name__ == "__main__":
    main(*sys.argv[1:])
