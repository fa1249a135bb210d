"""Foreign images reach the scribe beside the loop; messages that are no image are counted."""

from __future__ import annotations

import functools
import time

import zenoh

from support.cell import until
from support.pictures import grey
from thirdhand.contract.images import decode_image, image_in
from thirdhand.daemon.cell_streams import Arrivals
from thirdhand.daemon.side_streams import SideStream


def test_images_are_passed_on_in_order_and_the_rest_is_counted(
    sessions: tuple[zenoh.Session, zenoh.Session],
) -> None:
    near, far = sessions
    came: list[tuple[str, bytes]] = []
    arrivals = {key: Arrivals() for key in ("camera/front", "camera/side")}

    def pass_on(key: str, payload: bytes, now_ns: int) -> None:
        came.append((key, image_in(payload, now_ns)))

    streams = [
        SideStream(near, key, functools.partial(pass_on, key), counted, needed="JPEG", waiting=32)
        for key, counted in arrivals.items()
    ]
    sent = [
        ("camera/front", grey(10)),
        ("camera/front", b"nonsense"),
        ("camera/front", b"nonsense"),
    ]
    sent += [
        ("camera/front", grey(20)),
        ("camera/side", grey(30, kind="PNG")),
        ("camera/other", grey(40)),
    ]

    def are_passed_on() -> bool:
        if not came:
            for key, payload in sent:
                far.put(key, payload)
            time.sleep(0.3)
        for stream in streams:
            stream.poll(time.time_ns())
        return len(came) >= 3

    until(are_passed_on)
    assert [(key, decode_image(data).data) for key, data in came[:3]] == [
        (key, payload) for key, payload in sent[:-1] if payload != b"nonsense"
    ]
    front, side = arrivals.values()
    assert str(front.refusal) == (
        "an image that begins with 6e 6f 6e 73 65 6e 73 65, neither JPEG nor PNG; JPEG needed"
    )
    assert front.count >= front.malformed + 2
    assert (front.malformed >= 2, side.malformed) == (True, 0)
