"""A skill whose names contain control sequences of terminals, tables and browsers."""

from __future__ import annotations

import io

import msgspec
import numpy as np

from kmp.storage import checksum
from support.paths import RECORDINGS

WICKED = "a\nb\x1b[31mred\x07\u202egnirts\r<b>|`*_$x$"


def wicked_skill() -> bytes:
    """The file of the shipped skill with such names of skill and take, and such a warning."""
    with np.load(RECORDINGS / "soldering.npz", allow_pickle=False) as archive:
        arrays = dict(archive)
    figures = msgspec.json.decode(str(arrays["figures"]))
    figures["demonstrations"] = [
        {"name": WICKED, "error_mm": 1.0, "worst_mm": 2.0, "within_95": 95.0}
    ]
    figures["warnings"] = [WICKED]
    arrays |= {"name": np.array(WICKED), "figures": np.array(msgspec.json.encode(figures).decode())}
    arrays["checksum"] = np.array(checksum(arrays))
    out = io.BytesIO()
    np.savez(out, allow_pickle=False, **arrays)
    return out.getvalue()
