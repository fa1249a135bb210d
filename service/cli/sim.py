"""`thirdhand sim`: the bench, for those who installed it without knowing its modules."""

from __future__ import annotations

import argparse
import os
import sys
from typing import NoReturn

from service.child import python
from service.launch import check_bench


def sim(args: argparse.Namespace) -> NoReturn:
    """Becomes `python -m sim` with the same options: signals and exit code are its own."""
    if not {"-h", "--help", "--via-points"} & set(args.options):
        check_bench()
    command, environment = python("-m", "sim", *args.options)
    sys.stdout.flush()
    os.execve(command[0], command, environment)
