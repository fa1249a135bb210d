"""Images of foreign streams: `sensor_msgs/msg/CompressedImage` in CDR, or JPEG and PNG as they are.

A recording holds all of them as CompressedImage.
"""

from __future__ import annotations

import struct
from typing import NamedTuple

from thirdhand.contract.cdr import Reader, Writer
from thirdhand.contract.messages import WireError

COMPRESSED_IMAGE = "sensor_msgs/msg/CompressedImage"
_LENGTH = struct.Struct("<I")
# first bytes of a file, and its format
_MAGIC = {
    b"\xff\xd8\xff": "jpeg",
    b"\x89PNG\r\n\x1a\n": "png",
}


class CompressedImage(NamedTuple):
    """An image: the time of its stamp [ns], the frame of its camera, `jpeg` or `png`, its file."""

    stamp_ns: int
    frame_id: str
    format: str
    data: bytes


def encode_image(image: CompressedImage) -> bytes:
    """CDR bytes of a CompressedImage."""
    out = Writer()
    out.header(image.stamp_ns, image.frame_id)
    out.string(image.format)
    out.pack(_LENGTH, len(image.data), align=4)
    return bytes(out) + image.data


def decode_image(data: bytes) -> CompressedImage:
    """The image in the CDR bytes of a CompressedImage. Raises WireError for other formats."""
    reader = Reader(data)
    stamp_ns, frame_id = reader.header()
    reader.string()  # writers name the format in many ways; the file's first bytes are clear
    size = reader.length()
    file = reader.unpack(struct.Struct(f"{size}s"), 1)[0]
    reader.end()
    return CompressedImage(stamp_ns, frame_id, _format_of(file), file)


def image_in(payload: bytes, time_ns: int) -> bytes:
    """A payload as CDR bytes of a CompressedImage: a JPEG or PNG file gets the stamp `time_ns`.

    Raises WireError.
    """
    if payload.startswith(b"\0"):  # as every message in CDR
        decode_image(payload)
        return payload
    return encode_image(CompressedImage(time_ns, "", _format_of(payload), payload))


def _format_of(file: bytes) -> str:
    for magic, name in _MAGIC.items():
        if file.startswith(magic):
            return name
    raise WireError(
        f"an image that begins with {file[:8].hex(' ') or 'nothing'}, neither JPEG nor PNG"
    )
