"""Two trackers that publish one hand: the first one counts until it is silent."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator
from typing import TypeAlias

import pytest
import zenoh

from support.cell import until
from thirdhand.client import Publisher, endpoints, open_session
from thirdhand.contract import cdr, channels, ros2
from thirdhand.contract.messages import BASE, PoseStamped
from thirdhand.daemon.cell_streams import TAKEOVER_S, Arrivals, CellStreams, SolePublisher, heard
from thirdhand.settings.config import Settings

KEY = "thirdhand/hands/left"
Put: TypeAlias = Callable[[bytes], object]


def named(session: zenoh.Session) -> Put:
    """A tracker of this library."""
    return Publisher(session, "thirdhand", "hands/left").put


def nameless(session: zenoh.Session) -> Put:
    """A tracker that publishes by Zenoh alone."""
    publisher = session.declare_publisher(KEY)
    return publisher.put


def ros2_node(session: zenoh.Session) -> Put:
    """A node behind rmw_zenoh, which names its publisher in an attachment."""
    publisher = session.declare_publisher(KEY)
    attachment = ros2.encode_attachment(1, 0, ros2.gid("node"))
    return lambda message: publisher.put(message, attachment=attachment)


@pytest.fixture
def cell() -> Iterator[tuple[CellStreams, Arrivals, zenoh.Session]]:
    """A cell's streams, the arrivals of the left hand, and a session of trackers."""
    settings = Settings()
    with open_session(listen=["tcp/127.0.0.1:0"]) as listening:
        arrivals = {channel.key: Arrivals() for channel in heard(settings)}
        streams = CellStreams(listening, settings, arrivals=arrivals, failed=print)
        with open_session(connect=list(endpoints(listening))) as session:
            yield streams, arrivals["hands/left"], session
        streams.close()


def received_by(streams: CellStreams, arrivals: Arrivals, put: Put, message: bytes) -> list[float]:
    """The x [m] of the samples that the cell accepts after a tracker has published a message."""
    before = arrivals.count
    accepted: list[float] = []

    def is_taken() -> bool:
        accepted.extend(event.value.position[0] for event in streams.receive())
        return arrivals.count > before

    put(message)
    until(is_taken)
    return accepted


numbers = itertools.count(1)


def sample(x: float) -> bytes:
    return cdr.encode_pose(PoseStamped(next(numbers), BASE, (x, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0)))


PAIRS = [
    (named, named),
    (named, nameless),
    (nameless, named),
    (named, ros2_node),
    (ros2_node, nameless),
]


@pytest.mark.parametrize(("first", "second"), PAIRS)
def test_second_publisher_is_refused(
    cell: tuple[CellStreams, Arrivals, zenoh.Session],
    first: Callable[[zenoh.Session], Put],
    second: Callable[[zenoh.Session], Put],
) -> None:
    """The second publisher's samples are refused even if they are near, and with any stamps."""
    streams, arrivals, session = cell
    put = first(session)
    put_other = second(session)
    until(lambda: put(sample(0.4)) or list(streams.receive()))  # until it is connected
    put(sample(0.45))
    until(lambda: 0.45 in [event.value.position[0] for event in streams.receive()])
    others = arrivals.others
    for _ in range(20):
        assert received_by(streams, arrivals, put, sample(0.5)) == [0.5]
        assert received_by(streams, arrivals, put_other, sample(0.501)) == []
    assert arrivals.others == others + 20

    # A message that cannot be decoded does not make its publisher the accepted one.
    assert received_by(streams, arrivals, put_other, b"nonsense") == []
    assert received_by(streams, arrivals, put, sample(0.5)) == [0.5]

    # Once the first publisher is silent, the second one is accepted.
    until(
        lambda: received_by(streams, arrivals, put_other, sample(0.7)) == [0.7],
        within_s=20 * TAKEOVER_S,
    )
    assert received_by(streams, arrivals, put, sample(0.5)) == []


def test_publisher_is_heard_until_it_is_silent() -> None:
    sole = SolePublisher()
    assert not sole.is_other("one", 10.0)
    assert sole.is_other("other", 10.0 + 0.99 * TAKEOVER_S)
    assert not sole.is_other("one", 10.0 + 2 * TAKEOVER_S)  # the same publisher after a pause
    assert sole.is_other("other", 10.0 + 2.99 * TAKEOVER_S)
    assert not sole.is_other("other", 10.0 + 3.01 * TAKEOVER_S)
    assert sole.is_other("one", 10.0 + 3.02 * TAKEOVER_S)


def test_messages_of_every_channel_are_named() -> None:
    """A publisher numbers its messages, so that receivers can count losses."""
    with open_session(listen=["tcp/127.0.0.1:0"]) as session:
        came: list[zenoh.Sample] = []
        subscriber = session.declare_subscriber("cell/**", came.append)
        inputs = [channel.key for channel in channels.CHANNELS if channel.direction == "in"]
        publishers = [Publisher(session, "cell", key) for key in inputs]
        for _, publisher in itertools.product(range(2), publishers):
            publisher.put(b"")
        until(lambda: len(came) == 2 * len(inputs))
        subscriber.undeclare()  # type: ignore[no-untyped-call]
    sources = [message.source_info for message in came]
    assert [source.source_sn for source in sources] == [0] * len(inputs) + [1] * len(inputs)
    assert len({str(source.source_id) for source in sources}) == len(inputs)
