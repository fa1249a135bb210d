"""Keys that a command waits for while it works."""

from __future__ import annotations

import os
import select
import sys


class EnterPressed:
    """A function that is True once for each Enter. Standard input is ignored if it is closed, has
    ended or belongs to another process group; `listens` is False from then on.
    """

    def __init__(self) -> None:
        self.listens = sys.stdin is not None  # a program may lack standard input

    def __call__(self) -> bool:
        try:
            if not self.listens or not select.select([sys.stdin], [], [], 0)[0]:
                return False
            if sys.stdin.isatty() and os.tcgetpgrp(sys.stdin.fileno()) != os.getpgrp():
                return False
            if sys.stdin.readline():
                return True
        except (OSError, ValueError):
            pass
        self.listens = False
        return False
