"""A relay of TCP connections that counts bytes."""

from __future__ import annotations

import contextlib
import socket
import threading
from typing import Self


class CountingRelay:
    """A relay between clients of `endpoint` and a target, on a port (0: a free one); used as a
    context.
    """

    def __init__(self, target: str, port: int = 0) -> None:
        host, _, target_port = target.removeprefix("tcp/").rpartition(":")
        self._target = host, int(target_port)
        self._there = self._back = 0
        self._sockets: list[socket.socket] = []
        self._listening = socket.create_server(("127.0.0.1", port))
        self.endpoint = f"tcp/127.0.0.1:{self._listening.getsockname()[1]}"
        self._spawn(self._accept)

    def counted(self) -> tuple[int, int]:
        """Numbers of bytes that were sent to the target and received from it."""
        return self._there, self._back

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._close(self._listening, *self._sockets)

    @staticmethod
    def _close(*sockets: socket.socket) -> None:
        for connection in sockets:
            with contextlib.suppress(OSError):  # the socket is closed, or was never connected
                connection.shutdown(socket.SHUT_RDWR)
            connection.close()

    @staticmethod
    def _spawn(work: object, *arguments: object) -> None:
        threading.Thread(target=work, args=arguments, name="relay", daemon=True).start()  # type: ignore[arg-type]

    def _accept(self) -> None:
        with contextlib.suppress(OSError):  # the socket was closed
            while True:
                near, _ = self._listening.accept()
                far = socket.create_connection(self._target)
                self._sockets += [near, far]
                self._spawn(self._carry, near, far, True)
                self._spawn(self._carry, far, near, False)

    def _carry(self, source: socket.socket, sink: socket.socket, there: bool) -> None:
        with contextlib.suppress(OSError):
            while data := source.recv(65536):
                sink.sendall(data)
                if there:
                    self._there += len(data)
                else:
                    self._back += len(data)
        self._close(source, sink)
