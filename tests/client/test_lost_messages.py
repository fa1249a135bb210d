"""Messages that a subscriber did not receive: the client counts them, and reports the first."""

from __future__ import annotations

import threading
from typing import Any

import pytest
import zenoh

from support.cell import until
from thirdhand.client import Publisher, UnreachableError, Watch, endpoints, open_session
from thirdhand.client.streams import wait_until_heard
from thirdhand.contract import channels
from thirdhand.daemon.cell_streams import Arrivals, CellStreams
from thirdhand.settings.config import Settings

# 100 MB, more than sockets and queues hold
COUNT = 2000
BYTES = 50_000


class Starved(Watch):
    """A watch whose program takes no messages before `free` is set."""

    def __init__(self, *arguments: Any, free: threading.Event) -> None:
        self.free = free
        self.taken = 0
        super().__init__(*arguments)

    def _decoded(self, sample: zenoh.Sample) -> Any:
        self.free.wait(60)
        self.taken += 1
        raise ValueError("its content is of no interest")


def test_a_starved_subscriber_knows_how_many_messages_it_lost(
    capsys: pytest.CaptureFixture[str],
) -> None:
    free = threading.Event()
    with open_session(listen=["tcp/127.0.0.1:0"]) as daemon:
        streams = CellStreams(
            daemon, Settings(), arrivals={c: Arrivals() for c in channels.BY_KEY}, failed=print
        )
        with (
            open_session(connect=endpoints(daemon)) as session,
            Starved(session, "thirdhand", "joints/command", free=free) as watch,
        ):
            until(lambda: streams.is_followed)
            for _ in range(COUNT):
                streams.publish("joints/command", bytes(BYTES))
            free.set()

            def all_counted() -> bool:
                if (
                    watch.taken > 1
                    and watch.lost > 0
                    and watch.taken + watch.lost == COUNT + len(sent)
                ):
                    return True
                # losses are counted when the next message arrives
                streams.publish("joints/command", b"")
                sent.append(1)
                return False

            sent: list[int] = []
            until(all_counted)
    assert watch.lost > COUNT / 10
    warning = (
        "messages on thirdhand/joints/command are lost: this program or its network is too slow"
    )
    assert [line for line in capsys.readouterr().err.splitlines() if "lost" in line] == [warning]


def test_slow_loop_counts_what_its_queue_dropped(listener: zenoh.Session) -> None:
    """Message numbers may wrap around."""
    publisher = listener.declare_publisher("thirdhand/clutch")
    true = channels.BY_KEY["clutch"].codec.encode(True)
    with Watch(listener, "thirdhand", "clutch") as watch:
        for number in (2**32 - 2, 2**32 - 1, 0, 3):
            publisher.put(true, source_info=zenoh.SourceInfo(publisher.id, number))
        until(lambda: watch.lost == 2)
        for number in range(4, 260):
            publisher.put(true, source_info=zenoh.SourceInfo(publisher.id, number))
        until(lambda: watch.lost == 6)  # the queue holds 256 of 260


@pytest.mark.parametrize(
    ("suffix", "setting"),
    [("tool/wish", r', with `\[skill\] source = "tool/wish"`'), ("hands/left", "")],
)
def test_who_is_not_heard_is_told_the_setting(
    suffix: str, setting: str, listener: zenoh.Session
) -> None:
    with pytest.raises(UnreachableError, match=f"nobody listens.* in this cell{setting}\\?"):
        wait_until_heard(Publisher(listener, "bench", suffix), timeout_s=0.1)
