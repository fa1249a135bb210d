"""Standard output and error in the encoding of the terminal, whatever it is."""

from __future__ import annotations

import io
import sys


def accept_all_characters() -> None:
    """Write characters that the encoding of the output lacks as escapes: `\\xb2`, `\\u2588`."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")
