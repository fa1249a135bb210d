"""The client's side: sessions between named endpoints, and requests as calls that return an answer
or raise an error with words.
"""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
import zenoh

from support.cell import until
from support.statuses import holding
from thirdhand.client import (
    Client,
    Connection,
    RefusedError,
    UncertainError,
    UnreachableError,
    endpoints,
    living,
    open_session,
)
from thirdhand.client.presence import is_connected
from thirdhand.contract import channels, requests
from thirdhand.contract.requests import ViaPoint
from thirdhand.workbench.trackers.cell_view import carried_out
from thirdhand_sim.sockets import CountingRelay

Answer = Callable[[zenoh.Query], object]
Answering = Callable[[str, Answer], None]  # declares a queryable with this key
Breaking = tuple[zenoh.Session, Callable[[], None]]  # a session, and a call that cuts it off


@pytest.fixture(scope="module")
def session(listener: zenoh.Session) -> Iterator[zenoh.Session]:
    """A session that is connected to it."""
    with open_session(connect=endpoints(listener)) as connected:
        yield connected


@pytest.fixture
def answering(listener: zenoh.Session) -> Iterator[Answering]:
    """Declare queryables, until the test ends."""
    declared: list[Any] = []

    def answer(key: str, with_what: Answer) -> None:
        cell = key.rsplit("/", 1)[0]
        if not living(listener, cell):
            declared.append(
                listener.liveliness().declare_token(channels.presence(cell, str(listener.zid())))
            )

        def reply(query: zenoh.Query) -> None:
            with query:
                with_what(query)

        declared.append(listener.declare_queryable(key, reply))

    yield answer
    for queryable in declared:
        queryable.undeclare()


STATUS = holding("bench", 3)


def ready(query: zenoh.Query) -> None:
    query.reply(query.key_expr, requests.encode_json(STATUS))


# --- sessions ------------------------------------------------------------------------------------


def test_sessions_find_each_other_by_name_only(
    listener: zenoh.Session, session: zenoh.Session
) -> None:
    """There is no scouting: a session connects only to endpoints that it was given."""
    with open_session(listen=["tcp/127.0.0.1:0"]) as stranger:
        time.sleep(0.5)
        assert list(session.info.peers_zid()) == [listener.zid()]
        assert list(stranger.info.peers_zid()) + list(stranger.info.routers_zid()) == []
        assert stranger.zid() not in list(listener.info.peers_zid())


# --- requests ------------------------------------------------------------------------------------


def test_a_refusal_is_raised_with_the_daemons_words(
    session: zenoh.Session, answering: Answering
) -> None:
    answering("bench/status", ready)
    answering("bench/hold", lambda query: query.reply_err("not now: º".encode()))
    client = Client(session, "bench")
    client.wait_until_ready()
    with pytest.raises(RefusedError, match=r"^not now: º$"):
        client.ask("hold")


def test_via_points_are_asked_for_as_the_wire_says(
    session: zenoh.Session, answering: Answering
) -> None:
    asked: list[bytes] = []

    def take(query: zenoh.Query) -> None:
        assert query.payload is not None
        asked.append(query.payload.to_bytes())
        query.reply(query.key_expr, b'{"tick": 3}')

    answering("bench/status", ready)
    answering("bench/via_points", take)
    client = Client(session, "bench")
    client.wait_until_ready()
    point = ViaPoint("there", (0.1, 0.2, 0.3), (0.4, 0.5, 0.6), (0.7, 0.8, 0.9))
    assert client.add([point], tolerance=0.1) == requests.Reply(3)
    request = json.loads(asked[0])
    assert (request["op"], request["tolerance"]) == ("add", 0.1)
    assert request["points"][0]["left"] == [0.1, 0.2, 0.3]


def test_points_with_numbers_of_numpy_are_taught(
    listener: zenoh.Session, session: zenoh.Session, answering: Answering
) -> None:
    taught: list[requests.Add] = []

    def take(query: zenoh.Query) -> None:
        assert query.payload is not None
        taught.append(requests.decode_request(query.payload.to_bytes(), requests.Add))
        query.reply(query.key_expr, b'{"tick": 3}')

    answering("bench/via_points", take)
    cell = Connection(session, "bench")
    numbers: dict[str, Any] = {"std": np.float64(0.01), "radius": np.float32(0.125)}
    numbers |= dict.fromkeys(("left", "right", "tool"), np.full(3, 0.5))
    numbers["orientation"] = np.array([0, 0, 0, 1])
    assert cell.teach("there", **numbers, corrections=np.int64(2)) == requests.Reply(3)
    assert cell.add([ViaPoint("there", **numbers)]) == requests.Reply(3)
    for request in taught:
        assert request.points[0].left == (0.5, 0.5, 0.5)
        assert request.points[0].orientation == (0.0, 0.0, 0.0, 1.0)
        assert (request.points[0].std, request.points[0].radius) == (0.01, 0.125)


def test_where_nobody_answers_the_cell_is_named(session: zenoh.Session) -> None:
    with pytest.raises(UnreachableError, match=r"nobody answers on nowhere/status: .*cell's name"):
        Client(session, "nowhere", timeout_s=0.5).status()
    with pytest.raises(UnreachableError, match="nowhere/status"):
        Client(session, "nowhere", timeout_s=0.1).wait_until_ready(timeout_s=0.0)
    with pytest.raises(UnreachableError, match="nowhere/resume") as failed:
        Client(session, "nowhere").resume()
    assert not isinstance(failed.value, UncertainError), "it was not carried out"


@pytest.mark.parametrize("suffix", ["hold", "status"])
def test_lost_query_is_repeated_if_that_is_safe(
    listener: zenoh.Session,
    session: zenoh.Session,
    answering: Answering,
    suffix: str,
) -> None:
    """A lost query is repeated only if repeating it does nothing twice."""
    lost: list[zenoh.Query] = []
    client = Client(session, "bench", timeout_s=2.0)
    with listener.declare_queryable("bench/resume", lost.append):
        answering("bench/via_points", ready)
        client.ask("via_points", {"op": "list"})

        def lose_first(query: zenoh.Query) -> None:
            if lost:
                ready(query)
            else:
                lost.append(query)

        answering(f"bench/{suffix}", lose_first)
        assert client.ask(suffix) == json.loads(requests.encode_json(STATUS))
        assert len(lost) == 1
        with pytest.raises(UncertainError, match=r"bench/resume: .*may have been carried out"):
            client.resume()
        assert len(lost) == 2
    for query in lost:
        query.drop()


# --- connections that break ----------------------------------------------------------------------


@pytest.fixture
def breaking(listener: zenoh.Session) -> Iterator[Breaking]:
    """A session to the listener, and a call that breaks its connection for 0.3 s."""
    (target,) = endpoints(listener)
    relays = [CountingRelay(target)]
    timers = list[threading.Timer]()
    endpoint = relays[0].endpoint

    def cut() -> None:
        relays[-1].__exit__()
        timers.append(
            threading.Timer(
                0.3, lambda: relays.append(CountingRelay(target, int(endpoint.rpartition(":")[2])))
            )
        )
        timers[-1].start()

    with open_session(connect=[endpoint]) as session:
        yield session, cut
    for timer in timers:
        timer.join()
    for relay in relays:
        relay.__exit__()


def test_requests_survive_a_broken_connection(breaking: Breaking, answering: Answering) -> None:
    """`status`, `via_points` and `hold` survive a connection that breaks before the answer."""
    session, cut = breaking
    asked: list[str] = []

    def cut_first(query: zenoh.Query) -> None:
        asked.append(str(query.key_expr))
        if asked.count(asked[-1]) == 1:
            cut()
        if asked[-1] == "bench/status":
            ready(query)
        else:
            query.reply(query.key_expr, b'{"tick": 3}')

    answering("bench/status", cut_first)
    answering("bench/via_points", cut_first)
    answering("bench/hold", cut_first)
    client = Client(session, "bench")
    assert client.status() == STATUS
    assert client.hold() == requests.Reply(3)
    assert client.via_points() == ()
    assert client.ask("via_points", {"op": "list"}) == {"tick": 3}
    assert asked == ["bench/status"] * 2 + ["bench/hold"] * 2 + ["bench/via_points"] * 3


def test_order_with_a_lost_answer_is_not_repeated(breaking: Breaking, answering: Answering) -> None:
    """The order may have been carried out."""
    session, cut = breaking
    resumed: list[str] = []

    def cut_first(query: zenoh.Query) -> None:
        resumed.append("resume")
        if len(resumed) == 1:
            cut()
        query.reply(query.key_expr, b'{"tick": 3}')

    answering("bench/resume", cut_first)
    client = Client(session, "bench")
    with pytest.raises(UncertainError, match="The request may have been carried out"):
        client.resume()
    assert len(resumed) == 1
    assert client.resume() == requests.Reply(3)  # the call waits for the connection
    assert len(resumed) == 2
    cut()
    until(lambda: not is_connected(session))
    assert carried_out(client, "resume")[0]
    assert len(resumed) == 3


def test_known_daemon_is_not_asked_again(listener: zenoh.Session, session: zenoh.Session) -> None:
    """The answer of a known daemon counts, though its liveliness token has disappeared."""
    with listener.declare_queryable(
        "bench/status", lambda query: query.reply(query.key_expr, encoded)
    ):
        client = Client(session, "bench", timeout_s=1.0)
        encoded = requests.encode_json(STATUS)
        with listener.liveliness().declare_token(channels.presence("bench", str(listener.zid()))):
            assert client.wait_until_ready() == STATUS
        assert client.status() == STATUS
        with pytest.raises(UnreachableError, match="A Zenoh storage answered"):
            Client(session, "bench", timeout_s=1.0).status()
