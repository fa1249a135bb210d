"""Memory that a process used at its start and does not need afterwards."""

from __future__ import annotations

import contextlib
import ctypes
import re
from pathlib import Path

# a file's mapping, private to this process: begin, end, is writable, path, anonymous pages [kB]
_MAPPING = re.compile(
    r"^([0-9a-f]+)-([0-9a-f]+) r(.).p \S+ \S+ [1-9]\d* +(.+)\n(?:[A-Z].*\n)*?Anonymous: +(\d+) kB",
    re.MULTILINE,
)
# Linux and glibc define them
_MADV_DONTNEED = 4
_M_ARENA_MAX = -8


def release_start_memory() -> None:
    """Release code and constants of all libraries, and memory that was freed.

    What is used again is mapped again from the system's cache of files, in some microseconds.
    Segments that relocation or this process changed are kept, as are libraries that are just being
    loaded: their writable segment is mapped last. Without Linux and glibc nothing is released.
    """
    with contextlib.suppress(OSError, AttributeError):
        libc = ctypes.CDLL(None)
        libc.malloc_trim(0)
        mappings = _MAPPING.findall(Path("/proc/self/smaps").read_text(errors="replace"))
        loaded = {path for _, _, writable, path, _ in mappings if writable == "w"}
        for begin, end, writable, path, anonymous_kb in mappings:
            if path in loaded and writable == "-" and anonymous_kb == "0":
                address = int(begin, 16)
                libc.madvise(
                    ctypes.c_void_p(address),
                    ctypes.c_size_t(int(end, 16) - address),
                    _MADV_DONTNEED,
                )


def share_one_heap() -> None:
    """Have threads that begin later allocate from one heap: each of several keeps what it freed."""
    with contextlib.suppress(AttributeError):
        ctypes.CDLL(None).mallopt(_M_ARENA_MAX, 1)
