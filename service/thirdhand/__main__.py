"""`thirdhand ...`, also `python -m thirdhand ...`."""

import signal  # before all else: until the next statement, Ctrl-C shows a traceback

if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
    # Ctrl-C ends it without a traceback, until it is watched for
    signal.signal(signal.SIGINT, signal.SIG_DFL)

# isort: split
from thirdhand.process import one_blas_thread  # noqa: F401

# isort: split
import sys

from thirdhand.process import interrupt, output

__all__ = ["main"]


def main() -> int:
    """The exit code of the command that the command line names."""
    interrupt.watch()
    output.accept_all_characters()
    from thirdhand.command_line import main as run  # takes a while, and may be interrupted

    code = run()
    interrupt.too_late()
    return code


if __name__ == "__main__":
    sys.exit(main())
