"""`thirdhand completion`: what lets a shell complete commands and options."""

from __future__ import annotations

import argparse

from service.contract.explain import ExplainedError


def completion(args: argparse.Namespace) -> int:
    """Exit code 0 once the shell's script is printed."""
    from service.cli.main import parser  # which names this module

    try:
        import shtab
    except ModuleNotFoundError:
        raise ExplainedError("shtab is not installed: pip install shtab") from None
    print(shtab.complete(parser(), shell=args.shell))
    return 0
