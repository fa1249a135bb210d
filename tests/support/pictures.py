"""Grey pictures, as a camera publishes them."""

from __future__ import annotations

import io

from PIL import Image


def grey(level: int, *, kind: str = "JPEG") -> bytes:
    """The file of a uniformly grey picture of 64 x 48 pixels; grey is 0 to 255."""
    out = io.BytesIO()
    Image.new("RGB", (64, 48), (level, level, level)).save(out, kind)
    return out.getvalue()
