"""Who may do what on a network: certificates made by the command, and real sessions of each role
that try everything.
"""

from __future__ import annotations

import contextlib
import datetime
import itertools
import json
import os
import re
import shutil
import stat
import time
from collections.abc import Iterable, Iterator
from pathlib import Path

import pytest
import zenoh
from cryptography import x509

from service.cli.main import main
from service.client import Client, UnreachableError, cells, endpoints, living, open_session
from service.client.session import CertificateError, valid_until
from service.contract import cdr, channels, ros2
from service.contract.messages import PoseStamped
from service.contract.roles import DAEMON, ROLES, ROUTER, TOPICS, access_control, names
from service.daemon.launch import launched
from service.daemon.single_instance import NETWORK_BOUNDS, occupy
from support.cell import LEFT, Tracker, thirdhand, told, until

CELL = "bench"
NOT_DEMONSTRATED = ("objects", "clutch", "gripper/wish")
INPUTS = ("hands/left", "hands/right", "joints/state", "joints/guided", "gripper/state", "tool/pose", *NOT_DEMONSTRATED)
OUTPUTS = tuple(channel.key for channel in channels.CHANNELS if channel.direction == "out")
REQUESTS = tuple(channel.key for channel in channels.CHANNELS if channel.queryable)
DOMAIN = 3  # of ROS 2
PATIENCE_S = 1.0  # what is refused is only seen by waiting


@pytest.fixture(scope="module")
def secrets(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What the command makes."""
    folder = tmp_path_factory.mktemp("certificates") / "secrets"
    made = thirdhand("certificates", str(folder))
    assert made.returncode == 0, made.stderr
    assert "operator: its holder may send requests" in made.stdout
    return folder


def keys(suffixes: Iterable[str]) -> set[str]:
    """The keys of streams, in the cell and in the ROS 2 domain."""
    plain = {channels.key(CELL, suffix) for suffix in suffixes}
    return plain | {
        ros2.key(DOMAIN, ros2.of_channel(CELL, channels.BY_KEY[suffix]))
        for suffix in suffixes
        if channels.BY_KEY[suffix] in TOPICS
    }


class Guarded:
    """A session in the daemon's place: takes in, publishes and answers as a daemon does."""

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
        own = str(self.session.zid())
        topics = ros2.tokens(DOMAIN, CELL, own, [ros2.of_channel(CELL, one) for one in TOPICS]).values()
        self._tokens = [
            self.session.liveliness().declare_token(token) for token in (channels.presence(CELL, own), *topics)
        ]
        self._answering = [self.session.declare_queryable(channels.key(CELL, key), self._answer) for key in REQUESTS]

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

        def hear(sample: zenoh.Sample) -> None:  # its own words it hears too
            got.update([str(sample.key_expr)] if bytes(sample.payload) == b"out" else [])
            passed_on.update([str(sample.key_expr)] if bytes(sample.payload) == b"from the bench" else [])

        def observe(sample: zenoh.Sample) -> None:
            forged.extend([str(sample.key_expr)] if bytes(sample.payload) != b"out" else [])

        streams = keys((*INPUTS, *OUTPUTS))
        heard = [session.declare_subscriber(key, hear) for key in (*full.values(), *streams, "**")]
        false_token = session.liveliness().declare_token(channels.presence(CELL, "f00"))
        false_answers = [session.declare_queryable(full[key], lambda query: query.drop()) for key in REQUESTS]
        seen = [observer.declare_subscriber(key, observe) for key in keys(OUTPUTS)]
        until(lambda: Client(operator, CELL, timeout_s=1.0).ask("status") == {})
        end = time.monotonic() + PATIENCE_S
        while time.monotonic() < end:
            for key in streams:  # every input, and every output in the daemon's place
                session.put(key, b"from a client")
            for key in INPUTS:
                bench.put(channels.key(CELL, key), b"from the bench")
            guarded.publish()
            time.sleep(0.05)
        own = {str(guarded.session.zid())}
        until(lambda: living(session, CELL) == own | {"f00"})  # its own words it hears too
        assert living(observer, CELL) == (own | {"f00"} if name == ROUTER else own)
        listed = session.liveliness().get(ros2.all_tokens(DOMAIN), timeout=5.0)
        assert len({str(reply.ok.key_expr) for reply in listed if reply.ok}) == 1 + len(TOPICS)
        false_token.undeclare()
        asked = [session.get(full[key], payload=b"{}", timeout=PATIENCE_S) for key in REQUESTS]
        answered = sum(reply.ok is not None for replies in asked for reply in replies)
        for declared in (*heard, *seen, *false_answers):
            declared.undeclare()
    assert guarded.taken == keys(role.publishes)
    assert got == (keys(OUTPUTS) if role.hears else set())
    assert passed_on == (
        {channels.key(CELL, key) for key in INPUTS if key not in NOT_DEMONSTRATED} if role.hears_inputs else set()
    )
    assert forged == []
    assert answered == (len(REQUESTS) if role.asks else 1)  # the status is for all
    assert guarded.asked == ({full[key] for key in REQUESTS} if role.asks else {full["status"]})


def test_a_certificate_is_revoked_by_its_name_and_its_sibling_is_not(secrets: Path) -> None:
    """Sessions of two trackers and two operators; of each the second was revoked."""
    for role in ("tracker", "operator"):
        made = told("certificates", str(secrets), "--role", role)
        assert made.returncode == 0, made.stderr
        assert f"{secrets / role}-2: {role}-2, of role {role}; valid until 20" in made.stdout
    full = {key: channels.key(CELL, key) for key in (*INPUTS, *OUTPUTS, *REQUESTS)}
    daemon = Guarded(secrets, revoked=("tracker-2", "operator-2"))
    with contextlib.ExitStack() as closing:
        closing.callback(daemon.close)
        sessions = {
            name: closing.enter_context(open_session(connect=[daemon.endpoint], certificate=secrets / name))
            for name in ("tracker", "tracker-2", "operator", "operator-2")
        }
        got: dict[str, set[str]] = {name: set() for name in sessions}
        said: dict[str, set[bytes]] = {}
        for name, session in sessions.items():

            def hear(sample: zenoh.Sample, name: str = name) -> None:
                got[name].update([str(sample.key_expr)] if bytes(sample.payload) == b"out" else [])

            for key in (*full.values(), "**"):
                closing.callback(session.declare_subscriber(key, hear).undeclare)
        taken = daemon.session.declare_subscriber(
            f"{CELL}/**", lambda s: said.setdefault(str(s.key_expr), set()).add(bytes(s.payload))
        )
        closing.callback(taken.undeclare)
        until(lambda: Client(sessions["operator"], CELL, timeout_s=1.0).ask("status") == {})
        end = time.monotonic() + PATIENCE_S
        while time.monotonic() < end:
            for name, session in sessions.items():
                for key in (*INPUTS, *OUTPUTS):
                    session.put(full[key], name.encode())
            daemon.publish()
            time.sleep(0.05)
        daemon.asked.clear()
        asked = [sessions["operator-2"].get(full[key], payload=b"{}", timeout=PATIENCE_S) for key in REQUESTS]
        assert not any(reply.ok for replies in asked for reply in replies)
        assert daemon.asked == set()
        assert Client(sessions["operator"], CELL).ask("hold") == {}
    tracked = {full[key] for key in ROLES["tracker"].publishes}
    assert {key for key, names in said.items() if b"tracker" in names} == tracked
    assert {key for key, names in said.items() if names & {b"tracker-2", b"operator", b"operator-2"}} == set()
    assert got["tracker-2"] == got["operator-2"] == set()
    assert got["operator"] == {full[key] for key in OUTPUTS}


@contextlib.contextmanager
def serving_cell(secrets: Path, cell: str, *, listen: Iterable[str] = (), connect: Iterable[str] = ()) -> Iterator[str]:
    """A session of a cell's daemon, which answers a request for its status with the cell's name;
    its endpoint.
    """
    more = NETWORK_BOUNDS | access_control(cell)
    with open_session(listen=[*listen], connect=[*connect], certificate=secrets / DAEMON, more=more) as session:
        token = occupy(session, cell)  # noqa: F841  # the cell is free when the token is deleted
        answering = session.declare_queryable(
            channels.key(cell, "status"), lambda query: query.reply(query.key_expr, cell.encode())
        )
        yield "".join(endpoints(session))
        answering.undeclare()


@pytest.mark.parametrize("by_router", [True, False], ids=["by a router", "directly"])
@pytest.mark.parametrize("listens", [True, False], ids=["listening", "connecting only"])
@pytest.mark.one_case
def test_every_role_sees_all_cells_that_are_connected(secrets: Path, by_router: bool, listens: bool) -> None:
    here = ["tls/127.0.0.1:0"]
    with contextlib.ExitStack() as stack:
        meeting: tuple[str, ...] = ()
        if by_router:
            router = open_session(listen=here, certificate=secrets / ROUTER, more={"mode": "router"})
            meeting = endpoints(stack.enter_context(router))
        first = stack.enter_context(serving_cell(secrets, "lab/a", listen=here, connect=meeting))
        second = serving_cell(secrets, "lab/b", listen=here * listens, connect=meeting or [first])
        for at in filter(None, (*meeting, first, stack.enter_context(second))):
            with open_session(connect=[at], certificate=secrets / "tracker") as session:
                until(lambda session=session: {cell.name for cell in cells(session)} == {"lab/a", "lab/b"})
                for cell in ("lab/a", "lab/b"):
                    replies = session.get(channels.key(cell, "status"), payload=b"{}", timeout=10.0)
                    assert [reply.ok and reply.ok.payload.to_bytes() for reply in replies] == [cell.encode()]
                refused = session.get(channels.key("lab/b", "hold"), payload=b"{}", timeout=PATIENCE_S)
                assert [reply.ok for reply in refused if reply.ok] == []


def test_what_is_revoked_whole_lets_nobody_in_by_default() -> None:
    """A subject without a name would be everybody."""
    told = access_control(CELL, names("tracker"))["access_control"]
    assert all(subject["cert_common_names"] for subject in told["subjects"])
    assert "tracker" not in [subject["id"] for subject in told["subjects"]]
    assert {name for policy in told["policies"] for name in policy["subjects"]} == {s["id"] for s in told["subjects"]}


@pytest.mark.parametrize(
    ("arguments", "code", "words"),
    [
        (("--role", "tracker", "--name", "left-camera"), 2, "tracker with a number needed, tracker-2 to tracker-99"),
        (("--name", "tracker-2"), 2, "--role needed with it"),
        (("--role", "tracker", "--name", "tracker"), 1, "a new name needed"),
        (("--role", "nobody"), 2, "invalid choice"),
        (("--role", "tracker", "--host", "not plain \u00fc"), 2, "a name in plain letters, or an address, needed"),
        (("--role", "daemon", "--days", "0"), 2, "--days: 0 given, 1 to 36500 needed"),
    ],
)
def test_one_more_certificate_that_cannot_be_is_refused_in_words(
    secrets: Path, arguments: tuple[str, ...], code: int, words: str
) -> None:
    done = told("certificates", str(secrets), *arguments)
    assert done.returncode == code
    assert words in done.stderr
    nowhere = told("certificates", str(secrets / "none"), "--role", "tracker")
    assert nowhere.returncode == 1
    assert "no authority in" in nowhere.stderr


def test_a_name_that_was_given_is_not_given_again_when_its_folder_went_to_its_machine(secrets: Path) -> None:
    made = [told("certificates", str(secrets), "--role", "bench") for _ in range(2) if _moved(secrets / "bench-2")]
    assert [done.returncode for done in made] == [0, 0]
    assert (secrets / "bench-3").is_dir()
    assert not (secrets / "bench-2").exists()


def _moved(folder: Path) -> bool:
    if folder.exists():
        folder.rename(folder.parent.parent / folder.name)
    return True


def test_the_daemons_certificate_can_be_made_anew(secrets: Path) -> None:
    made = told("certificates", str(secrets), "--role", "daemon", "--name", "daemon-7", "--host", "bench.local")
    assert made.returncode == 0, made.stderr
    certificate = x509.load_pem_x509_certificate((secrets / "daemon-7" / "certificate.pem").read_bytes())
    hosts = certificate.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    assert "bench.local" in hosts.get_values_for_type(x509.DNSName)
    with (
        open_session(listen=["tls/127.0.0.1:0"], certificate=secrets / "daemon-7") as renewed,
        open_session(connect=endpoints(renewed), certificate=secrets / "operator"),
    ):
        pass


def test_a_certificate_out_of_its_time_is_told_in_words(
    guarded: Guarded, secrets: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Made by the command, with its clock 30 days off."""
    shutil.copytree(secrets, tmp_path / "own")
    today = datetime.datetime.now(datetime.UTC)
    for days, name, words in (
        (-30, "tracker-5", r"certificate\.pem expired on 20.* UTC: a new certificate needed"),
        (30, "tracker-6", r"certificate\.pem is valid from 20.* UTC on, but the clock here shows"),
    ):
        made = today + datetime.timedelta(days=days)
        monkeypatch.setattr("service.cli.certificates.now", lambda made=made: made)
        assert main(["certificates", str(tmp_path / "own"), "--role", "tracker", "--name", name, "--days", "3"]) == 0
        with pytest.raises(UnreachableError, match=words):
            open_session(connect=[guarded.endpoint], certificate=tmp_path / "own" / name, timeout_s=1.0)
    (tmp_path / "own" / "tracker" / "certificate.pem").write_text("nothing")
    with pytest.raises(UnreachableError, match="does not hold a certificate"):
        open_session(connect=[guarded.endpoint], certificate=tmp_path / "own" / "tracker", timeout_s=1.0)


def test_certificates_are_renewed_with_their_names_and_keys_and_old_and_new_ones_meet(
    secrets: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also where some machines have the old ones, and where only a certificate came back."""
    old, own = tmp_path / "old", tmp_path / "own"
    assert told("certificates", str(own), "--host", "bench.local", "--days", "20").returncode == 0
    shutil.copytree(own, old)
    (own / "tracker" / "key.pem").unlink()
    done = told("certificates", str(own), "--renew", "--days", "400")
    assert done.returncode == 0, done.stderr
    assert len(re.findall("renewed; valid until", done.stdout)) == len(list(own.glob("*/certificate.pem")))
    assert f"{datetime.datetime.now(datetime.UTC) + datetime.timedelta(days=400):%Y-%m-%d}" in done.stdout
    before, after = (
        x509.load_pem_x509_certificate((folder / "daemon" / "certificate.pem").read_bytes()) for folder in (old, own)
    )
    assert (before.subject, before.public_key()) == (after.subject, after.public_key())
    hosts = after.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    assert "bench.local" in hosts.get_values_for_type(x509.DNSName)
    assert (valid_until(own / "daemon") - valid_until(old / "daemon")).days == 380
    shutil.copy(old / "tracker" / "key.pem", own / "tracker")
    for daemons, clients in ((own, old), (old, own), (own, own)):
        with (
            open_session(listen=["tls/127.0.0.1:0"], certificate=daemons / "daemon") as daemon,
            open_session(connect=endpoints(daemon), certificate=clients / "tracker"),
        ):
            pass
    assert not list(own.rglob("*.new"))
    for path in own.rglob("*.pem"):
        assert stat.S_IMODE(path.stat().st_mode) == 0o600
    shutil.copytree(secrets / "operator", own / "operator-7")
    refused = told("certificates", str(own), "--renew")
    assert (refused.returncode, "operator-7/certificate.pem is not by the authority" in refused.stderr) == (1, True)
    assert told("certificates", str(own), "--renew", "--role", "arm").returncode == 2
    later = datetime.datetime.now(datetime.UTC) + datetime.timedelta(days=500)  # the authority has expired
    monkeypatch.setattr("service.cli.certificates.now", lambda: later)
    shutil.rmtree(own / "operator-7")
    assert told("certificates", str(own), "--role", "arm").returncode == 1
    assert told("certificates", str(own), "--renew").returncode == 0


def test_a_certificate_that_ends_soon_is_reported_by_daemon_doctor_and_cells(tmp_path: Path) -> None:
    own = tmp_path / "own"
    assert told("certificates", str(own), "--days", "20").returncode == 0
    config = f'[network]\nlisten = ["tls/127.0.0.1:0"]\ncertificate = "{own}/daemon"\n'
    with launched(tmp_path, "--joints", "assumed", network=config) as service:
        at = ("--connect", service.endpoint, "--certificate", str(own / "operator"))
        assert "certificate ends in 20 days" in told("cells", *at).stdout
        assert re.search(r"note +certificate +ends in 20 days\n.*\n.*--renew", told("doctor", *at).stdout)
        until(lambda: "the certificate ends on" in service.log.read_text())


@pytest.mark.thorough
def test_each_refusal_names_the_certificate_and_what_is_wrong_with_it(
    secrets: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without the checks of the own files' dates, as if the clocks of both machines differed."""
    own, other, ago = tmp_path / "own", tmp_path / "other", datetime.datetime.now(datetime.UTC)
    shutil.copytree(secrets, own)
    assert told("certificates", str(other)).returncode == 0
    ago -= datetime.timedelta(days=30)
    monkeypatch.setattr("service.cli.certificates.now", lambda: ago)
    for role, name in (("daemon", "daemon-8"), ("operator", "operator-8")):
        assert told("certificates", str(own), "--role", role, "--name", name, "--days", "3").returncode == 0
    shutil.copytree(other / "operator", own / "operator-9")
    shutil.copy(own / "operator" / "authority.pem", own / "operator-9")
    monkeypatch.setattr("service.client.session.check_dates", lambda path: None)
    for daemon, client, words in (
        ("daemon", None, "requires a certificate, and none was given"),
        (
            "daemon",
            other / "operator",
            "the certificate of the daemon .* is not from the authority in .*other/operator",
        ),
        ("daemon", own / "operator-8", "refuses the certificate in .*operator-8, which has expired by the clock there"),
        (
            "daemon",
            own / "operator-9",
            "refuses the certificate in .*operator-9, which is not from the authority there",
        ),
        ("daemon-8", own / "operator", "the certificate of the daemon .* has expired"),
    ):
        with open_session(listen=["tls/127.0.0.1:0"], certificate=own / daemon) as session:
            for timeout_s in (0.3, None):  # with None, other errors are waited for
                with pytest.raises(CertificateError, match=words):
                    open_session(connect=endpoints(session), certificate=client or "", timeout_s=timeout_s)
            (secured,) = endpoints(session)
            plain = secured.replace("tls/", "tcp/")
            with pytest.raises(
                CertificateError, match=f"{plain} accepts TLS only: {secured}, and a certificate, needed"
            ):
                open_session(connect=[plain], certificate=client or "", timeout_s=0.3)
    with (
        open_session(listen=["tls/127.0.0.2:0"], certificate=own / "daemon") as session,
        pytest.raises(CertificateError, match=r"the certificate of the daemon .* is not for this address"),
    ):
        open_session(connect=endpoints(session), certificate=own / "operator", timeout_s=0.3)


@pytest.mark.thorough
def test_daemons_of_two_cells_see_each_other_by_their_certificates(secrets: Path, tmp_path: Path) -> None:
    """Of which one connects to the other; a third is of another authority, a fourth has none."""
    at, operator = "", ("--certificate", str(secrets / "operator"))
    with contextlib.ExitStack() as closing:
        endpoints_of: dict[str, str] = {}
        for name in ("lab/a", "lab/b"):
            folder = tmp_path / name
            folder.mkdir(parents=True)
            network = f'[network]\nlisten = ["tls/127.0.0.1:0"]\ncertificate = "{secrets}/daemon"\nconnect = [{at}]\n'
            arguments = ("--cell", name, "--joints", "assumed", "--rate", "100")
            service = closing.enter_context(launched(folder, *arguments, network=network))
            endpoints_of[name], at = service.endpoint, f'"{service.endpoint}"'
        for endpoint in endpoints_of.values():
            shown = until(
                lambda endpoint=endpoint: (
                    shown
                    if len(shown := json.loads(told("cells", "--json", "--connect", endpoint, *operator).stdout)) == 2
                    and all(cell["status"] for cell in shown)
                    else None
                )
            )
            for cell in (cell["status"] for cell in shown):
                assert (cell["mode"], cell["reason"], cell["skill"]) == ("hold", "no_hands", "soldering")
                assert cell["version"]
                assert cell["lateness_us"]["p99"] > 0
        assert told("certificates", str(tmp_path / "other")).returncode == 0
        serve = ("serve", "--cell", "lab/c", "--joints", "assumed", "--connect", endpoint)
        config = tmp_path / "c.toml"
        config.write_text(f'[network]\nlisten = []\ncertificate = "{tmp_path}/other/daemon"\n')
        foreign = told(*serve, "--config", str(config))
        assert (foreign.returncode, foreign.stdout) == (1, "")
        assert re.search(
            "^thirdhand serve: the certificate of the daemon .* is not from the authority in", foreign.stderr
        )
        without = thirdhand("cells", "--connect", endpoint)
        assert (without.returncode, without.stdout) == (1, "")
        assert re.search("^thirdhand cells: .* requires a certificate, and none was given", without.stderr)


def test_a_stranger_does_not_get_in(guarded: Guarded, tmp_path: Path) -> None:
    assert told("certificates", str(tmp_path / "own")).returncode == 0
    for certificate, words in ((tmp_path / "own" / "operator", "is not from the authority"), (None, "none was given")):
        with pytest.raises(UnreachableError, match=words):
            open_session(connect=[guarded.endpoint], certificate=certificate, timeout_s=1.0)
    with pytest.raises(UnreachableError):
        open_session(connect=[guarded.endpoint.replace("tls/", "tcp/")], timeout_s=1.0)


def test_nobody_passes_for_the_daemon(secrets: Path) -> None:
    """A role's certificate is no daemon's: clients do not talk to who listens with it."""
    with (
        open_session(listen=["tls/127.0.0.1:0"], certificate=secrets / "operator") as false,
        pytest.raises(CertificateError, match="is that of another role"),
    ):
        open_session(connect=endpoints(false), certificate=secrets / "tracker", timeout_s=1.0)


def test_what_the_command_makes_is_private_and_not_written_over(secrets: Path) -> None:
    for path in itertools.chain([secrets], secrets.rglob("*")):
        assert stat.S_IMODE(path.stat().st_mode) == (0o700 if path.is_dir() else 0o600), path
    again = told("certificates", str(secrets))
    assert again.returncode == 1
    assert "not overwritten" in again.stderr


def test_a_daemon_and_its_commands_by_certificates(secrets: Path, tmp_path: Path) -> None:
    config = f'[network]\nlisten = ["tls/127.0.0.1:0"]\ncertificate = "{secrets}/daemon"\n'
    with launched(tmp_path, "--joints", "assumed", "--record", str(tmp_path / "records"), network=config) as service:
        at = ("--connect", service.endpoint, "--certificate")
        assert service.endpoint.startswith("tls/127.0.0.1:")
        held = thirdhand("hold", *at, str(secrets / "operator"))
        assert held.returncode == 0, held.stderr
        from_shell = thirdhand("status", *at[:2], env=os.environ | {"THIRDHAND_CERTIFICATE": str(secrets / "operator")})
        assert from_shell.returncode == 0, from_shell.stderr
        refused = told("resume", *at, str(secrets / "observer"))
        assert refused.returncode == 1
        assert "nobody answers" in refused.stderr
        with (
            open_session(connect=[service.endpoint], certificate=secrets / "tracker") as tracking,
            open_session(connect=[service.endpoint], certificate=secrets / "operator") as operating,
            Tracker(tracking),
        ):
            client = Client(operating)
            client.ask("resume")
            until(lambda: client.status().mode == "follow")
            operating.put("thirdhand/hands/left", cdr.encode_pose(PoseStamped(1, "base", LEFT, (0.0, 0.0, 0.0, 1.0))))
        assert service.stop() == 0
    written = [path for path in (tmp_path / "records").rglob("*") if path.is_file()]
    assert written
    for path in (tmp_path / "records", *written):
        assert stat.S_IMODE(path.stat().st_mode) & 0o077 == 0, path
