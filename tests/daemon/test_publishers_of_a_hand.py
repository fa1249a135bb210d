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


@pytest.mark.parametrize(("ahead_s", "until_s"), [(0.9, 10.9), (-0.5, 10.0), (5.0, 0), (-5.0, 0)])
def test_publisher_of_wishes_is_heard_until_the_last_is_due(ahead_s: float, until_s: float) -> None:
    """One whose clock is wrong, so that its wishes are rejected, keeps nobody out."""
    sole = SolePublisher()
    assert not sole.is_other("one", 10.0, ahead_s)
    kept_out = until_s + TAKEOVER_S
    assert sole.is_other("other", kept_out - 0.01) == bool(until_s)
    assert not sole.is_other("other", max(kept_out, 10.0) + 0.01)


def test_a_lost_hand_is_one_of_its_own_publisher(
    cell: tuple[CellStreams, Arrivals, zenoh.Session],
) -> None:
    """After a tracker whose hand was lost, a program's hand may rest."""
    streams, arrivals, session = cell
    put = named(session)
    until(lambda: put(sample(0.4)) or list(streams.receive()))  # until it is connected
    for n in range(300):
        at_ns = 10**9 + n * 10**7
        pose = PoseStamped(at_ns, BASE, (0.41 + 1e-4 * (n % 7), 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))
        received_by(streams, arrivals, put, cdr.encode_pose(pose))
    put_other = named(session)
    until(lambda: received_by(streams, arrivals, put_other, sample(0.8)), within_s=20 * TAKEOVER_S)
    for n in range(200):
        pose = PoseStamped(10**10 + n * 10**7, BASE, (0.8, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))
        assert received_by(streams, arrivals, put_other, cdr.encode_pose(pose))
    assert arrivals.frozen == 0


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
