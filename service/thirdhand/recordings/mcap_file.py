"""Writing of MCAP files: profile `ros2`, small chunks with checksums, whole records on a full
disk.
"""

from __future__ import annotations

import contextlib
import functools
import os
import platform
from collections.abc import Iterator
from importlib import metadata as packages
from pathlib import Path
from typing import Any, Self

import numpy as np
from mcap.writer import MCAP0_MAGIC, CompressionType, IndexType, Writer
from threadpoolctl import threadpool_info

from thirdhand.contract.explain import ExplainedError
from thirdhand.contract.ros2msg import schema
from thirdhand.core.frame import definitions
from thirdhand.settings import file_content
from thirdhand.settings.file_content import UnusableError
from thirdhand.settings.whole_file import whole

_MEDIA = {".json": "application/json", ".urdf": "application/xml"}
_BYTES = "application/octet-stream"
# between two flushes a kill loses at most this, and a reader holds at most this
CHUNK_BYTES = 128 * 1024


class RecordingError(ExplainedError, ValueError):
    """A file is not the required kind of recording; the message has the cause and the remedy."""


@functools.cache
def machine() -> dict[str, str]:
    """Versions, CPU and BLAS of this machine, on which the result of a tick may depend."""
    facts = {
        "python": platform.python_version(),
        "system": platform.platform(),
        "cpu": platform.processor() or platform.machine(),
    }
    with contextlib.suppress(OSError):
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace").splitlines()
        facts["cpu"] = next(
            (line.partition(":")[2].strip() for line in lines if line.startswith("model name")),
            facts["cpu"],
        )
    build: Any = np.show_config(mode="dicts")
    blas = build["Build Dependencies"]["blas"]
    facts["blas"] = f"{blas['name']} {blas['version']}"
    facts["features"] = " ".join(build["SIMD Extensions"].get("found", []))
    facts["libc"] = " ".join(platform.libc_ver())
    kernels = {
        library.get("architecture")
        for library in threadpool_info()
        if library["user_api"] == "blas"
    }
    facts["kernel"] = " ".join(sorted(filter(None, kernels)))
    for name in (
        "thirdhand",
        "numpy",
        "scipy",
        "pin",
        "ruckig",
        "msgspec",
        "mcap",
        "eclipse-zenoh",
    ):
        with contextlib.suppress(packages.PackageNotFoundError):
            facts[name] = packages.version(name)
    return facts


class _WholeWrites:
    """A file of whole writes: a write that does not fit is undone.

    It is unbuffered: the system has written data at once, and each write raises its own error.
    """

    def __init__(self, path: Path) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        self.descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_CLOEXEC, 0o644)
        self._size = 0
        self.closed = False

    def write(self, data: bytes) -> int:
        remainder = memoryview(data)
        try:
            while remainder:
                remainder = remainder[os.write(self.descriptor, remainder) :]
        except OSError:
            with contextlib.suppress(OSError):
                os.ftruncate(self.descriptor, self._size)
            raise
        self._size += len(data)
        return len(data)

    def tell(self) -> int:
        return self._size

    def flush(self) -> None:
        """Do nothing: all data is written already."""

    def close(self) -> None:
        if not self.closed:
            self.closed = True
            os.close(self.descriptor)


class McapFile:
    """An MCAP file that is being written: profile `ros2`, zstd, small chunks.

    A channel is made at its first message. A chunk ends only at a call of `part_ends`, so the
    messages of one tick are kept or lost together. Raises OSError for errors of the file system;
    the file then holds everything written before.
    """

    def __init__(
        self,
        path: Path,
        *,
        joints: int,
        attached: bool = True,
        compressed: bool = True,
        has_wishes: bool = False,
    ) -> None:
        """`joints` is the arm's number of joints, and a State `has_wishes` where a policy leads, on
        which the schemas depend.

        A file without attachments and metadata (`attached` False) has no index of them, because its
        summary would list empty groups.
        """
        self.path = path
        self._stream = _WholeWrites(path)
        kinds = IndexType.ALL if attached else IndexType.CHUNK | IndexType.MESSAGE
        compression = CompressionType.ZSTD if compressed else CompressionType.NONE
        self.writer = Writer(self._stream, 1 << 62, compression, kinds, enable_data_crcs=True)  # type: ignore[arg-type]
        self._definitions = definitions(joints, has_wishes=has_wishes)
        self._unflushed = 0  # bytes
        self._schemas: dict[str, int] = {}
        self._channels: dict[str, int] = {}
        try:
            self.writer.start(profile="ros2", library="thirdhand")
        except OSError:
            self.abandon()
            raise

    @property
    def closed(self) -> bool:
        """True once nothing more can be written."""
        return self._stream.closed

    @property
    def size(self) -> int:
        """Number of written bytes."""
        return self._stream.tell()

    def put(
        self, topic: str, kind: str, data: bytes, time_ns: int, sequence: int, *, qos: str = ""
    ) -> None:
        """Write one CDR message of the type `kind`."""
        channel = self._channels.get(topic)
        if channel is None:
            if kind not in self._schemas:
                self._schemas[kind] = self.writer.register_schema(
                    kind, "ros2msg", schema(kind, self._definitions).encode()
                )
            channel = self.writer.register_channel(
                topic, "cdr", self._schemas[kind], {"offered_qos_profiles": qos}
            )
            self._channels[topic] = channel
        self.writer.add_message(channel, time_ns, data, time_ns, sequence & 0xFFFFFFFF)
        self._unflushed += len(data)

    def attach(self, name: str, data: bytes, time_ns: int) -> None:
        """Attach a file; its media type follows from the suffix of its name."""
        self.writer.add_attachment(
            time_ns, time_ns, name, _MEDIA.get(Path(name).suffix, _BYTES), data
        )

    def part_ends(self) -> None:
        """End the chunk here if it is large enough."""
        if self._unflushed >= CHUNK_BYTES:
            self.flush()

    def flush(self) -> None:
        """End the chunk in progress; data written so far survives a kill of the process."""
        self.writer.flush()  # type: ignore[no-untyped-call]
        self._unflushed = 0

    def lost_name(self) -> str:
        """Empty while the file is at its path, else `removed` or `moved`."""
        own_file = os.fstat(self._stream.descriptor)
        with contextlib.suppress(OSError):
            if os.path.samestat(self.path.stat(), own_file):
                return ""
        return "moved" if own_file.st_nlink else "removed"

    def close(self) -> None:
        """End and close the file, also after an error. A second call does nothing."""
        if not self.closed:
            try:
                self.flush()
                self.writer.finish()  # type: ignore[no-untyped-call]
            finally:
                self.abandon()

    def abandon(self) -> None:
        """Close the file without unflushed data and without a summary."""
        self._stream.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


@contextlib.contextmanager
def whole_file(path: Path, *, joints: int) -> Iterator[McapFile]:
    """A context with an MCAP file that is moved to `path` once it is complete."""
    with whole(path) as part:
        file = McapFile(part, joints=joints)
        try:
            yield file
            file.close()
        finally:
            file.abandon()


def existing(path: str | Path) -> Path:
    """The path of an MCAP file that exists.

    Raises RecordingError, which lists the recordings in its folder.
    """
    path = Path(path)
    if path.is_dir():
        raise RecordingError(f"{path} is a folder, a recording needed")
    with contextlib.suppress(FileNotFoundError, NotADirectoryError):
        path.stat()  # reports a link that leads to itself
    if not path.is_file():
        recordings = sorted(other.name for other in path.parent.glob("*.mcap"))
        names = f" Its folder has: {', '.join(recordings)}." if recordings else ""
        raise RecordingError(f"no recording {path}.{names}")
    if begin_of(path) != MCAP0_MAGIC:
        raise RecordingError(f"{path} is not an MCAP file")
    return path


def begin_of(path: Path) -> bytes:
    """The first bytes of a recording, as many as MCAP0_MAGIC has. Raises RecordingError for a
    pointer of Git LFS.
    """
    try:
        return file_content.begin_of(path)[: len(MCAP0_MAGIC)]
    except UnusableError as error:
        raise RecordingError(str(error)) from None


def ends_early(path: Path) -> bool:
    """True if an MCAP file was cut: its closing bytes are missing."""
    with path.open("rb") as stream:
        size = stream.seek(0, 2)
        stream.seek(max(0, size - len(MCAP0_MAGIC)))
        return stream.read() != MCAP0_MAGIC or size < 2 * len(MCAP0_MAGIC)
