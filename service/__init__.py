"""The daemon that turns live hand poses into safe joint commands, and what its clients import."""

import sys
from pathlib import Path

_vendored = Path(__file__).parent / "_vendor"  # in a wheel, where it holds kmp; not in a clone
if _vendored.is_dir():
    sys.path.insert(0, str(_vendored))
