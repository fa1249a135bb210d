"""`thirdhand sim`: the simulated bench, the same as `python -m sim`."""

from __future__ import annotations

import argparse
import os
import sys
from typing import NoReturn

from service.daemon.launch import engine_of
from service.process.child import python


def sim(args: argparse.Namespace) -> NoReturn:
    """Replace this process by `python -m sim` with the same options."""
    if not {"-h", "--help", "--via-points", "--hands-only"} & set(args.options):
        engine_of()
    command, environment = python("-m", "sim", *args.options)
    sys.stdout.flush()
    os.execve(command[0], command, environment)
