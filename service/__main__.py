"""`thirdhand ...`, also `python -m service ...`."""

from __future__ import annotations

from service import one_blas_thread  # noqa: F401

# isort: split
import sys

from service.cli.main import main

__all__ = ["main"]

if __name__ == "__main__":
    sys.exit(main())
