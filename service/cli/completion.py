"""`thirdhand completion`: the script by which a shell completes commands and options."""

from __future__ import annotations

import argparse
from pathlib import Path

from service.cli.usage import check_writable
from service.contract.explain import ExplainedError
from service.process.progress import say
from service.settings.whole_file import whole


def completion(args: argparse.Namespace) -> int:
    """Print or write the shell's script; exit code 0."""
    from service.cli.main import parser  # here, because `main` imports this module

    try:
        import shtab
    except ModuleNotFoundError:
        raise ExplainedError("shtab is not installed: pip install shtab") from None
    script = shtab.complete(parser(), shell=args.shell)
    if args.output:
        path: Path = args.output.expanduser()
        path.parent.mkdir(parents=True, exist_ok=True)
        check_writable(path)
        with whole(path) as part:
            part.write_text(script, encoding="utf-8")
        say(f"{path} written; the next shell uses it")
    else:
        print(script)
    return 0
