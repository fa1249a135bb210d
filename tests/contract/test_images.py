"""Images of foreign streams are ROS 2 messages or image files; anything else is refused."""

from __future__ import annotations

import numpy as np
import pytest
from rosbags.typesys import Stores, get_typestore

from support.pictures import grey
from thirdhand.contract.images import (
    COMPRESSED_IMAGE,
    CompressedImage,
    decode_image,
    encode_image,
    image_in,
)
from thirdhand.contract.messages import WireError

ROS = get_typestore(Stores.ROS2_HUMBLE)


@pytest.mark.parametrize("kind", ["jpeg", "png"])
def test_an_image_has_the_bytes_that_ros_2_gives_it(kind: str) -> None:
    file = grey(90, kind=kind.upper())
    kinds = ROS.types
    stamp = kinds["builtin_interfaces/msg/Time"](sec=7, nanosec=5)
    header = kinds["std_msgs/msg/Header"](stamp=stamp, frame_id="lens")
    message = kinds[COMPRESSED_IMAGE](
        header=header, format=kind, data=np.frombuffer(file, np.uint8)
    )
    theirs = bytes(ROS.serialize_cdr(message, COMPRESSED_IMAGE))
    image = CompressedImage(7_000_000_005, "lens", kind, file)
    assert encode_image(image) == theirs.rstrip(b"\0") + bytes(
        len(encode_image(image)) - len(theirs.rstrip(b"\0"))
    )
    assert decode_image(theirs) == image
    assert image_in(theirs, 1) == theirs
    assert decode_image(image_in(file, 9)) == CompressedImage(9, "", kind, file)


@pytest.mark.parametrize(
    "payload",
    [
        b"",
        b"nonsense",
        grey(1)[1:],
        b"\0\1\0\0",
        encode_image(CompressedImage(1, "", "h264", b"\0\0\0\1")),
    ],
)
def test_what_is_no_image_is_refused(payload: bytes) -> None:
    with pytest.raises(WireError):
        image_in(payload, 1)
