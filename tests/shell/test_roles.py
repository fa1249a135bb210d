"""Who may do what on a network: certificates made by the command, and real sessions of each role
that try everything.
"""

from __future__ import annotations

import itertools
import os
import stat
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import zenoh
from cell import LEFT, Tracker, thirdhand

from service.client import Client, UnreachableError, endpoints, open_session
from service.contract import cdr, channels
from service.contract.messages import PoseStamped
from service.contract.roles import ROLES, access_control
from service.launch import launched
from service.shell.door import BOUNDS

CELL = "bench"
INPUTS = ("hands/left", "hands/right", "joints/state")
OUTPUTS = tuple(channel.key for channel in channels.CHANNELS if channel.direction == "out")
REQUESTS = tuple(channel.key for channel in channels.CHANNELS if channel.queryable)
PATIENCE_S = 1.0  # what is refused is only seen by waiting


@pytest.fixture(scope="module")
def secrets(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What the command makes."""
    folder = tmp_path_factory.mktemp("certificates") / "secrets"
    made = thirdhand("certificates", str(folder))
    assert made.returncode == 0, made.stderr
    assert "operator: its holder may send requests" in made.stdout
    return folder


class Guarded:
    """A session in the daemon's place: takes in, publishes and answers as a daemon does."""

    def __init__(self, secrets: Path) -> None:
        self.session = open_session(
            listen=["tls/127.0.0.1:0"], certificate=secrets / "daemon", more=BOUNDS | access_control(CELL)
        )
        (self.endpoint,) = endpoints(self.session)
        self.taken: set[str] = set()
        self.asked: set[str] = set()
        self._declared = [
            self.session.declare_subscriber(channels.key(CELL, key), lambda s: self.taken.add(str(s.key_expr)))
            for key in INPUTS
        ]
        self._publishers = [self.session.declare_publisher(channels.key(CELL, key)) for key in OUTPUTS]
        self._answering = [self.session.declare_queryable(channels.key(CELL, key), self._answer) for key in REQUESTS]

    def _answer(self, query: zenoh.Query) -> None:
        with query:
            self.asked.add(str(query.key_expr))
            query.reply(query.key_expr, b"{}")

    def publish(self) -> None:
        for publisher in self._publishers:
            publisher.put(b"out")

    def close(self) -> None:
        for declared in (*self._declared, *self._answering):
            declared.undeclare()
        self.session.close()


@pytest.fixture(scope="module")
def guarded(secrets: Path) -> Iterator[Guarded]:
    daemon = Guarded(secrets)
    yield daemon
    daemon.close()


def within(what: Callable[[], bool]) -> bool:
    end = time.monotonic() + 10
    while not what():
        if time.monotonic() > end:
            return False
        time.sleep(0.02)
    return True


@pytest.mark.parametrize("name", ROLES)
def test_a_role_can_do_its_own_and_nothing_else(guarded: Guarded, secrets: Path, name: str) -> None:
    role = ROLES[name]
    full = {key: channels.key(CELL, key) for key in (*INPUTS, *OUTPUTS, *REQUESTS)}
    guarded.taken.clear()
    guarded.asked.clear()
    with (
        open_session(connect=[guarded.endpoint], certificate=secrets / name) as session,
        open_session(connect=[guarded.endpoint], certificate=secrets / "operator") as operator,
        open_session(connect=[guarded.endpoint], certificate=secrets / "observer") as observer,
    ):
        got: set[str] = set()
        forged: list[str] = []

        def hear(sample: zenoh.Sample) -> None:  # its own words it hears too
            got.update([str(sample.key_expr)] if bytes(sample.payload) == b"out" else [])

        def observe(sample: zenoh.Sample) -> None:
            forged.extend([str(sample.key_expr)] if bytes(sample.payload) != b"out" else [])

        heard = [session.declare_subscriber(key, hear) for key in (*full.values(), "**")]
        false_answers = [session.declare_queryable(full[key], lambda query: query.drop()) for key in REQUESTS]
        seen = [observer.declare_subscriber(full[key], observe) for key in OUTPUTS]
        assert within(lambda: Client(operator, CELL, timeout_s=1.0).ask("status") == {})
        end = time.monotonic() + PATIENCE_S
        while time.monotonic() < end:
            for key in (*INPUTS, *OUTPUTS):  # every input, and every output in the daemon's place
                session.put(full[key], b"from a client")
            guarded.publish()
            time.sleep(0.05)
        asked = [session.get(full[key], payload=b"{}", timeout=PATIENCE_S) for key in REQUESTS]
        answered = sum(reply.ok is not None for replies in asked for reply in replies)
        for declared in (*heard, *seen, *false_answers):
            declared.undeclare()
    assert guarded.taken == {full[key] for key in role.publishes}
    assert got == ({full[key] for key in OUTPUTS} if role.hears else set())
    assert forged == []
    assert answered == (len(REQUESTS) if role.asks else 0)
    assert guarded.asked == ({full[key] for key in REQUESTS} if role.asks else {full["status"]})


def test_a_stranger_does_not_get_in(guarded: Guarded, tmp_path: Path) -> None:
    assert thirdhand("certificates", str(tmp_path / "own")).returncode == 0
    for certificate in (tmp_path / "own" / "operator", None):
        with pytest.raises(UnreachableError, match="nobody answers"):
            open_session(connect=[guarded.endpoint], certificate=certificate, timeout_s=1.0)
    with pytest.raises(UnreachableError):
        open_session(connect=[guarded.endpoint.replace("tls/", "tcp/")], timeout_s=1.0)


def test_nobody_passes_for_the_daemon(secrets: Path) -> None:
    """A role's certificate is no daemon's: clients do not talk to who listens with it."""
    with (
        open_session(listen=["tls/127.0.0.1:0"], certificate=secrets / "operator") as false,
        pytest.raises(UnreachableError),
    ):
        open_session(connect=endpoints(false), certificate=secrets / "tracker", timeout_s=1.0)


def test_what_the_command_makes_is_private_and_not_written_over(secrets: Path) -> None:
    for path in itertools.chain([secrets], secrets.rglob("*")):
        assert stat.S_IMODE(path.stat().st_mode) == (0o700 if path.is_dir() else 0o600), path
    again = thirdhand("certificates", str(secrets))
    assert again.returncode == 1
    assert "not written over" in again.stderr


def test_a_daemon_and_its_commands_by_certificates(secrets: Path, tmp_path: Path) -> None:
    config = f'[network]\nlisten = ["tls/127.0.0.1:0"]\ncertificate = "{secrets}/daemon"\n'
    with launched(tmp_path, "--arm", "assumed", "--record", str(tmp_path / "records"), network=config) as service:
        at = ("--connect", service.endpoint, "--certificate")
        assert service.endpoint.startswith("tls/127.0.0.1:")
        held = thirdhand("hold", *at, str(secrets / "operator"))
        assert held.returncode == 0, held.stderr
        from_shell = thirdhand("status", *at[:2], env=os.environ | {"THIRDHAND_CERTIFICATE": str(secrets / "operator")})
        assert from_shell.returncode == 0, from_shell.stderr
        refused = thirdhand("resume", *at, str(secrets / "observer"))
        assert refused.returncode == 1
        assert "nobody answers" in refused.stderr
        with (
            open_session(connect=[service.endpoint], certificate=secrets / "tracker") as tracking,
            open_session(connect=[service.endpoint], certificate=secrets / "operator") as operating,
            Tracker(tracking),
        ):
            client = Client(operating)
            client.ask("resume")
            assert within(lambda: client.status()["mode"] == "follow")
            operating.put("thirdhand/hands/left", cdr.encode_pose(PoseStamped(1, "base", LEFT, (0.0, 0.0, 0.0, 1.0))))
        assert service.stop() == 0
    written = [path for path in (tmp_path / "records").rglob("*") if path.is_file()]
    assert written
    for path in (tmp_path / "records", *written):
        assert stat.S_IMODE(path.stat().st_mode) & 0o077 == 0, path
