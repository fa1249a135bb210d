"""`thirdhand sim`: the simulated bench, the same as `python -m thirdhand_sim`."""

from __future__ import annotations

import argparse
import os
import sys
from typing import NoReturn

from thirdhand.daemon.launch import engine_of
from thirdhand.process.child import python


def sim(args: argparse.Namespace) -> NoReturn:
    """Replace this process by `python -m thirdhand_sim` with the same options."""
    if not {"-h", "--help", "--via-points", "--hands-only"} & set(args.options):
        engine_of()
    command = python("-m", "thirdhand_sim", *args.options)
    sys.stdout.flush()
    os.execv(command[0], command)
