"""The daemon that turns live hand poses into safe joint commands, and what its clients import."""

import os
import sys

_vendored = os.path.join(os.path.dirname(__file__), "_vendor")  # in a wheel, where it holds kmp; not in a clone
if os.path.isdir(_vendored):
    sys.path.insert(0, _vendored)
