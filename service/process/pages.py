"""Memory pages of libraries that a process used at its start and does not need afterwards."""

from __future__ import annotations

import contextlib
import ctypes
import re
from pathlib import Path

_MAPPING = re.compile(r"([0-9a-f]+)-([0-9a-f]+) r-.p \S+ \S+ [1-9]\d* ")  # private, read-only, of a file
_MADV_DONTNEED = 4  # Linux defines it; Python's mmap has it for its own maps only


def release_library_pages() -> None:
    """Release the unmodified pages of all libraries, half of the memory of a process that compiled.

    A page that is used again is mapped again from the system's cache of files, in some microseconds.
    Nothing is released on a system without /proc.
    """
    with contextlib.suppress(OSError):
        madvise = ctypes.CDLL(None).madvise
        mapping: re.Match[str] | None = None
        for line in Path("/proc/self/smaps").read_text(errors="replace").splitlines():
            if "-" in line.partition(" ")[0]:
                mapping = _MAPPING.match(line)
            elif mapping is not None and line.split() == ["Anonymous:", "0", "kB"]:  # relocated pages are anonymous
                begin, end = int(mapping[1], 16), int(mapping[2], 16)
                madvise(ctypes.c_void_p(begin), ctypes.c_size_t(end - begin), _MADV_DONTNEED)
