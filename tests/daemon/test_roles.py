"""Rights of each role on a network: certificates made by the commands in docs/access.md, and a real
session of each role that tries everything.
"""

from __future__ import annotations

import contextlib
import shutil
import stat
import time
from collections.abc import Iterable, Iterator
from pathlib import Path

import pytest
import zenoh

from support.cell import LEFT, Tracker, thirdhand, until
from support.cell_commands import assert_refused, succeeded
from support.certificates import make_certificates
from thirdhand.client import Client, endpoints, living, open_session
from thirdhand.client.session import CertificateError
from thirdhand.contract import cdr, channels, ros2
from thirdhand.contract.messages import PoseStamped
from thirdhand.contract.roles import ROLES, ROUTER, TOPICS, access_control, names
from thirdhand.daemon.launch import launched
from thirdhand.daemon.single_instance import NETWORK_BOUNDS

CELL = "bench"
NOT_DEMONSTRATED = ("objects", "clutch", "gripper/wish", "tool/wish")
INPUTS = (
    "hands/left",
    "hands/right",
    "joints/state",
    "joints/guided",
    "gripper/state",
    "tool/pose",
    *NOT_DEMONSTRATED,
)
OUTPUTS = tuple(channel.key for channel in channels.CHANNELS if channel.direction == "out")
REQUESTS = tuple(channel.key for channel in channels.CHANNELS if channel.queryable)
DOMAIN = 3  # ROS 2 domain
PATIENCE_S = 1.0  # a refusal is only seen by waiting


@pytest.fixture(scope="module")
def secrets(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Certificates of one authority, with a second tracker and a second operator."""
    return make_certificates(tmp_path_factory.mktemp("certificates"), "tracker-2", "operator-2")


def keys(suffixes: Iterable[str]) -> set[str]:
    """The keys of streams, in the cell and in the ROS 2 domain."""
    plain = {channels.key(CELL, suffix) for suffix in suffixes}
    return plain | {
        ros2.key(DOMAIN, ros2.of_channel(CELL, channels.BY_KEY[suffix]))
        for suffix in suffixes
        if channels.BY_KEY[suffix] in TOPICS
    }


class Guarded:
    """A session in the daemon's place, which receives, publishes and answers as a daemon does."""

    def __init__(self, secrets: Path, revoked: tuple[str, ...] = ()) -> None:
        self.session = open_session(
            listen=["tls/127.0.0.1:0"],
            certificate=secrets / "daemon",
            more=NETWORK_BOUNDS | access_control(CELL, revoked, DOMAIN),
        )
        (self.endpoint,) = endpoints(self.session)
        self.taken: set[str] = set()
        self.asked: set[str] = set()
        self._declared = [self.session.declare_subscriber(key, self._take) for key in keys(INPUTS)]
        self._publishers = [self.session.declare_publisher(key) for key in keys(OUTPUTS)]
        session_id = str(self.session.zid())
        topics = ros2.tokens(
            DOMAIN, CELL, session_id, [ros2.of_channel(CELL, channel) for channel in TOPICS]
        ).values()
        self._tokens = [
            self.session.liveliness().declare_token(token)
            for token in (channels.presence(CELL, session_id), *topics)
        ]
        self._answering = [
            self.session.declare_queryable(channels.key(CELL, key), self._answer)
            for key in REQUESTS
        ]

    def _take(self, sample: zenoh.Sample) -> None:
        if bytes(sample.payload) != b"from the bench":
            self.taken.add(str(sample.key_expr))

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


@pytest.mark.parametrize("name", ROLES)
@pytest.mark.one_case
def test_a_role_can_do_its_own_and_nothing_else(guarded: Guarded, secrets: Path, name: str) -> None:
    role = ROLES[name]
    full = {key: channels.key(CELL, key) for key in REQUESTS}
    guarded.taken.clear()
    guarded.asked.clear()
    with (
        open_session(connect=[guarded.endpoint], certificate=secrets / name) as session,
        open_session(connect=[guarded.endpoint], certificate=secrets / "operator") as operator,
        open_session(connect=[guarded.endpoint], certificate=secrets / "observer") as observer,
        open_session(connect=[guarded.endpoint], certificate=secrets / "bench") as bench,
    ):
        got: set[str] = set()
        passed_on: set[str] = set()
        forged: list[str] = []

        def hear(sample: zenoh.Sample) -> None:  # a session hears its own messages too
            got.update([str(sample.key_expr)] if bytes(sample.payload) == b"out" else [])
            passed_on.update(
                [str(sample.key_expr)] if bytes(sample.payload) == b"from the bench" else []
            )

        def observe(sample: zenoh.Sample) -> None:
            forged.extend([str(sample.key_expr)] if bytes(sample.payload) != b"out" else [])

        streams = keys((*INPUTS, *OUTPUTS))
        heard = [session.declare_subscriber(key, hear) for key in (*full.values(), *streams, "**")]
        false_token = session.liveliness().declare_token(channels.presence(CELL, "f00"))
        false_answers = [
            session.declare_queryable(full[key], lambda query: query.drop()) for key in REQUESTS
        ]
        observed = [observer.declare_subscriber(key, observe) for key in keys(OUTPUTS)]
        until(lambda: Client(operator, CELL, timeout_s=1.0).ask("status") == {})
        end = time.monotonic() + PATIENCE_S
        while time.monotonic() < end:
            for key in streams:  # every input, and every output in the daemon's place
                session.put(key, b"from a client")
            for key in INPUTS:
                bench.put(channels.key(CELL, key), b"from the bench")
            guarded.publish()
            time.sleep(0.05)
        daemon_ids = {str(guarded.session.zid())}
        until(lambda: living(session, CELL) == daemon_ids | {"f00"})  # it hears its own token too
        assert living(observer, CELL) == (daemon_ids | {"f00"} if name == ROUTER else daemon_ids)
        listed = session.liveliness().get(ros2.all_tokens(DOMAIN), timeout=5.0)
        assert len({str(reply.ok.key_expr) for reply in listed if reply.ok}) == 1 + len(TOPICS)
        false_token.undeclare()
        asked = [session.get(full[key], payload=b"{}", timeout=PATIENCE_S) for key in REQUESTS]
        answered = sum(reply.ok is not None for replies in asked for reply in replies)
        for declared in (*heard, *observed, *false_answers):
            declared.undeclare()
    assert guarded.taken == keys(role.publishes)
    assert got == (keys(OUTPUTS) if role.hears else set())
    assert passed_on == (
        {channels.key(CELL, key) for key in INPUTS if key not in NOT_DEMONSTRATED}
        if role.hears_inputs
        else set()
    )
    assert forged == []
    assert answered == (len(REQUESTS) if role.asks else 1)  # all roles may read the status
    assert guarded.asked == ({full[key] for key in REQUESTS} if role.asks else {full["status"]})


def test_certificate_is_revoked_by_its_name(secrets: Path) -> None:
    """There are two trackers and two operators; the second of each is revoked."""
    daemon = Guarded(secrets, revoked=("tracker-2", "operator-2"))
    revoked: set[bytes] = set()
    with contextlib.ExitStack() as closing:
        closing.callback(daemon.close)
        sessions = {
            name: closing.enter_context(
                open_session(connect=[daemon.endpoint], certificate=secrets / name)
            )
            for name in ("tracker", "tracker-2", "operator", "operator-2")
        }
        got: dict[str, set[bytes]] = {name: set() for name in sessions}
        for name, session in sessions.items():

            def hear(sample: zenoh.Sample, name: str = name) -> None:
                got[name].add(bytes(sample.payload))

            for key in ("**", *(channels.key(CELL, key) for key in OUTPUTS)):
                closing.callback(session.declare_subscriber(key, hear).undeclare)
        taken = daemon.session.declare_subscriber(
            f"{CELL}/**", lambda sample: revoked.add(bytes(sample.payload))
        )
        closing.callback(taken.undeclare)
        until(lambda: Client(sessions["operator"], CELL, timeout_s=1.0).ask("status") == {})
        end = time.monotonic() + PATIENCE_S
        while time.monotonic() < end:
            for name, session in sessions.items():
                for key in (*INPUTS, *OUTPUTS):
                    session.put(channels.key(CELL, key), name.encode())
            daemon.publish()
            time.sleep(0.05)
        daemon.asked.clear()
        requests = [channels.key(CELL, key) for key in REQUESTS]
        asked = [
            sessions["operator-2"].get(key, payload=b"{}", timeout=PATIENCE_S) for key in requests
        ]
        assert not any(reply.ok for replies in asked for reply in replies)
        assert daemon.asked == set()
        assert Client(sessions["operator"], CELL).ask("hold") == {}
    assert revoked == {b"out", b"tracker"}
    assert b"out" in got["operator"]
    # except its own messages
    assert [got[name] - {name.encode()} for name in ("tracker-2", "operator-2")] == [set(), set()]


def test_what_is_revoked_whole_lets_nobody_in_by_default() -> None:
    """A subject without a name would match everybody."""
    access = access_control(CELL, names("tracker"))["access_control"]
    assert all(subject["cert_common_names"] for subject in access["subjects"])
    assert "tracker" not in [subject["id"] for subject in access["subjects"]]
    assert {name for policy in access["policies"] for name in policy["subjects"]} == {
        s["id"] for s in access["subjects"]
    }


@pytest.mark.thorough
def test_refusals_name_the_certificate_and_its_fault(tmp_path: Path) -> None:
    """Two certificates have expired, and one is of another authority."""
    certificates = make_certificates(tmp_path, expired="daemon-8 operator-8")
    other = make_certificates(tmp_path / "other")
    shutil.copytree(other / "operator", certificates / "operator-9")
    shutil.copy(certificates / "operator" / "authority.pem", certificates / "operator-9")
    for daemon, client, words in (
        ("daemon", None, "requires a certificate, and none was given"),
        (
            "daemon",
            other / "operator",
            "the certificate of the daemon .* is not from the authority in "
            ".*other/secrets/operator",
        ),
        (
            "daemon",
            certificates / "operator-8",
            "refuses the certificate in .*operator-8, which has expired by the clock there",
        ),
        (
            "daemon",
            certificates / "operator-9",
            "refuses the certificate in .*operator-9, which is not from the authority there",
        ),
        ("daemon-8", certificates / "operator", "the certificate of the daemon .* has expired"),
    ):
        with open_session(listen=["tls/127.0.0.1:0"], certificate=certificates / daemon) as session:
            for timeout_s in (0.3, None):  # None waits through other errors
                with pytest.raises(CertificateError, match=words):
                    open_session(
                        connect=endpoints(session), certificate=client or "", timeout_s=timeout_s
                    )
            (secured,) = endpoints(session)
            plain = secured.replace("tls/", "tcp/")
            with pytest.raises(
                CertificateError,
                match=f"{plain} accepts TLS only: {secured}, and a certificate, needed",
            ):
                open_session(connect=[plain], certificate=client or "", timeout_s=0.3)
    with (
        open_session(listen=["tls/127.0.0.2:0"], certificate=certificates / "daemon") as session,
        pytest.raises(
            CertificateError, match=r"the certificate of the daemon .* is not for this address"
        ),
    ):
        open_session(
            connect=endpoints(session), certificate=certificates / "operator", timeout_s=0.3
        )


def test_nobody_passes_for_the_daemon(secrets: Path) -> None:
    """Clients refuse a listener whose certificate is that of another role."""
    with (
        open_session(listen=["tls/127.0.0.1:0"], certificate=secrets / "operator") as false,
        pytest.raises(CertificateError, match="is that of another role"),
    ):
        open_session(connect=endpoints(false), certificate=secrets / "tracker", timeout_s=1.0)


def test_a_daemon_and_its_commands_by_certificates(
    secrets: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = f'[network]\nlisten = ["tls/127.0.0.1:0"]\ncertificate = "{secrets}/daemon"\n'
    with launched(
        tmp_path, "--joints", "assumed", "--record", str(tmp_path / "records"), network=config
    ) as service:
        connect = ("--connect", service.endpoint)
        assert service.endpoint.startswith("tls/127.0.0.1:")
        monkeypatch.setenv("THIRDHAND_CERTIFICATE", str(secrets / "operator"))
        succeeded("hold", *connect)
        from_shell = thirdhand("status", *connect)
        assert from_shell.returncode == 0, from_shell.stderr
        monkeypatch.setenv("THIRDHAND_CERTIFICATE", str(secrets / "observer"))
        assert_refused(1, "nobody answers", "resume", *connect)
        with (
            open_session(connect=[service.endpoint], certificate=secrets / "tracker") as tracking,
            open_session(connect=[service.endpoint], certificate=secrets / "operator") as operating,
            Tracker(tracking),
        ):
            client = Client(operating)
            client.ask("resume")
            until(lambda: client.status().mode == "follow")
            operating.put(
                "thirdhand/hands/left",
                cdr.encode_pose(PoseStamped(1, "base", LEFT, (0.0, 0.0, 0.0, 1.0))),
            )
        assert service.stop() == 0
    written = [path for path in (tmp_path / "records").rglob("*") if path.is_file()]
    assert written
    for path in (tmp_path / "records", *written):
        assert stat.S_IMODE(path.stat().st_mode) & 0o077 == 0, path
