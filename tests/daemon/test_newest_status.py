"""Each status that arrives after the answer to a request shows the request's effect, published or
queried.
"""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import Any

import pytest

from support.cell import Daemon, Tracker, serving
from thirdhand.client import Client
from thirdhand_sim.scene import Scene

ROUNDS = 12


@pytest.fixture(scope="module")
def daemon(tmp_path_factory: pytest.TempPathFactory) -> Any:
    folder: Path = tmp_path_factory.mktemp("newest")
    with serving(folder, "--joints", "assumed") as running, Tracker(running.session):
        running.until(lambda status: status["mode"] == "follow")
        yield running


def shown(status: dict[str, Any], request: str, reply: dict[str, Any]) -> bool:
    """True if a status shows the effect of a request."""
    if request in ("hold", "resume", "reset"):
        return status["tick"] >= reply["tick"] and (status["reason"] == "operator") == (
            request == "hold"
        )
    if request == "segment":
        return bool(status["segment"]) and status["segment"][0] == "glass"
    return status["via_points"] == [point["name"] for point in reply["points"]]


VIA_POINTS = [
    {"name": p.name, "left": p.left, "right": p.right, "tool": p.tool, "std": 0.01}
    for p in Scene().via_points()
]
REQUESTS: list[tuple[str, dict[str, Any]]] = [
    ("hold", {}),
    ("resume", {}),
    ("hold", {}),
    ("reset", {}),
    ("resume", {}),
    ("segment", {"name": "glass"}),
    ("via_points", {"op": "add", "points": VIA_POINTS[:1]}),
    ("via_points", {"op": "remove", "names": [VIA_POINTS[0]["name"]]}),
    ("via_points", {"op": "add", "points": VIA_POINTS[1:2]}),
    ("via_points", {"op": "clear"}),
    ("skill", {"name": "soldering"}),
]


@pytest.mark.parametrize("way", ["queryable", "Client", "published"])
@pytest.mark.one_case
def test_what_a_request_did_is_in_every_later_status(daemon: Daemon, way: str) -> None:
    published: list[dict[str, Any]] = []
    subscriber = daemon.session.declare_subscriber(
        "thirdhand/status", lambda sample: published.append(json.loads(sample.payload.to_bytes()))
    )
    client = Client(daemon.session)
    for round_ in range(ROUNDS if way != "published" else 4):
        for request, body in REQUESTS if round_ == 0 else REQUESTS[:5]:
            if request == "reset":
                continue  # without a fault, `reset` has no effect to show
            reply = daemon.client.ask(request, body)
            if way == "queryable":
                (answer,) = daemon.session.get("thirdhand/status", timeout=10.0)
                assert answer.ok is not None
                status = json.loads(answer.ok.payload.to_bytes())
            elif way == "Client":
                status = json.loads(json.dumps(client.ask("status")))
            else:
                before = len(published)
                end = time.monotonic() + 5.0
                while len(published) < before + 3 and time.monotonic() < end:
                    time.sleep(0.01)
                assert all(message["tick"] >= reply["tick"] for message in published[before:]), (
                    request
                )
                status = published[before]
                if request != "segment":  # the hands soon determine the segment again
                    assert all(shown(message, request, reply) for message in published[before:]), (
                        request
                    )
            assert shown(status, request, reply), (request, status)
            time.sleep(0.013 * round_ % 0.1)  # at any phase of the published statuses
    subscriber.undeclare()
