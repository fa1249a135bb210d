"""`thirdhand bundle`: the archive's content, without secrets; it is complete, or does not exist."""

from __future__ import annotations

import json
import os
import resource
import tarfile
from pathlib import Path

import msgspec
import pytest

from support.cell import Tracker, serving, thirdhand
from support.cell_commands import succeeded
from support.certificates import make_certificates
from thirdhand.command_line import main
from thirdhand.recordings.mcap_reader import Messages
from thirdhand.recordings.replay import replay
from thirdhand.settings.config import Settings
from thirdhand.workbench.cli.bundle import without_keys

SECRET = "c2VjcmV0LWtleQ"  # the planted parameter of an endpoint
KEY = "-----BEGIN EC PRIVATE KEY-----\nMHcCAQEEI-planted\n-----END EC PRIVATE KEY-----"
CELL = """
[network]
listen = ["tcp/127.0.0.1:0#iface=lo;connect_private_key_base64={secret}"]
[files]
state = "{folder}/state"
record = "{folder}/recordings"
"""


def unpacked(path: Path) -> dict[str, bytes]:
    """The files of an archive by name."""
    with tarfile.open(path) as archive:
        entries = archive.getmembers()
        assert all(entry.isfile() and not entry.name.startswith(("/", "..")) for entry in entries)
        return {entry.name: archive.extractfile(entry).read() for entry in entries}  # type: ignore[union-attr]


def everything_in(name: str, content: bytes, folder: Path) -> bytes:
    """A file's content; of a recording, the content of its compressed parts too."""
    if not name.endswith(".mcap"):
        return content
    (folder / "taken.mcap").write_bytes(content)
    messages = Messages(folder / "taken.mcap")
    data = b"".join(message.data for _, _, message in messages)
    assert len(data) > 10_000
    return b"".join(
        [content, data, *messages.attachments.values(), repr(messages.metadata).encode()]
    )


@pytest.mark.thorough
def test_an_archive_holds_what_it_says_and_no_secret(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    config = tmp_path / "bench.toml"
    output = tmp_path / "bundle.tar.gz"
    config.write_text(f"# {SECRET}\n" + CELL.format(folder=tmp_path, secret=SECRET))
    secrets = make_certificates(tmp_path)
    keys = [path.read_text() for path in secrets.rglob("*key*")]
    assert len(keys) > 5
    network = (
        f'[network]\nlisten = ["tcp/127.0.0.1:0#iface=lo;connect_private_key_base64={SECRET}"]\n'
    )
    arguments = ("--joints", "assumed", "--record", str(tmp_path / "recordings"))
    with serving(tmp_path, *arguments, network=network) as daemon, Tracker(daemon.session):
        daemon.until(lambda now: now["mode"] == "follow" and now["scribe"]["state"] == "recording")
        daemon.until(lambda now: os.stat(now["scribe"]["recording"]).st_size > 50_000)
        with daemon.log.open("a") as log:  # as if a program had printed secrets
            log.write(
                f"a line\ntls/bench:7447#connect_private_key_base64={SECRET}\n{KEY}\n{keys[0]}\n"
            )
        options = ("--config", str(config), "--log", str(daemon.log), "--connect", daemon.endpoint)
        assert main(["bundle", "--output", str(output), *options]) == 0
        printed = capsys.readouterr().out
        assert daemon.end() == 0

    files = unpacked(output)
    (recording,) = (name for name in files if name.startswith("recordings/"))
    assert set(files) == {
        "README.txt",
        "status.json",
        "doctor.txt",
        "versions.txt",
        "log.txt",
        "settings.json",
        recording,
    }
    listed = [line.split(": ")[0] for line in printed.splitlines()[1:]]
    assert set(listed) == set(files) - {"README.txt"}
    assert all(f"{name}: " in files["README.txt"].decode() for name in listed)
    for name, content in files.items():
        whole = everything_in(name, content, tmp_path)
        for secret in (
            SECRET,
            "planted",
            *(line for key in keys for line in key.splitlines()[1:-1]),
        ):
            assert secret.encode() not in whole, name
    assert output.stat().st_mode & 0o077 == 0

    assert json.loads(files["status.json"])["mode"] == "follow"
    settings = msgspec.json.decode(files["settings.json"], type=Settings)
    assert settings.network.listen == ("tcp/127.0.0.1:0",)
    assert "left hand" in files["doctor.txt"].decode()
    versions = files["versions.txt"].decode()
    assert all(f"{name}: " in versions for name in ("thirdhand", "python", "cpu", "eclipse-zenoh"))
    assert "listening" not in files["log.txt"].decode()  # standard output only
    assert (
        "a line\ntls/bench:7447#(left out)\n(a private key, left out)\n"
        in files["log.txt"].decode()
    )
    (tmp_path / "cut.mcap").write_bytes(files[recording])
    result = replay(tmp_path / "cut.mcap")  # copied while it was written: it ends in a cut
    assert result.identical == result.ticks > 0


@pytest.mark.parametrize(
    ("text", "left"),
    [
        ("listen tcp/[::1]:7447#a=b, as", "listen tcp/[::1]:7447#(left out), as"),
        (
            '["tls/bench.local:7447#key=y","udp/1.2.3.4:1"]',
            '["tls/bench.local:7447#(left out)","udp/1.2.3.4:1"]',
        ),
        ("unixsock-stream//run/x.sock#key=y", "unixsock-stream//run/x.sock#(left out)"),
        ("tls/a:1#iface=lo,key=y, or", "tls/a:1#(left out), or"),
        ("a-new-one/a:1#key=y;other=z,w", "a-new-one/a:1#(left out)"),
        (
            "# a comment, segment #2, tcp/127.0.0.1:7447",
            "# a comment, segment #2, tcp/127.0.0.1:7447",
        ),
        ("cut: -----BEGIN PRIVATE KEY-----\nMHcC", "cut: (a private key, left out)"),
    ],
)
def test_only_what_may_be_secret_is_left_out_of_a_text(text: str, left: str) -> None:
    assert without_keys(text) == left


def test_bundle_without_a_daemon_says_so(tmp_path: Path) -> None:
    """The archive has the newest recording."""
    config = tmp_path / "bench.toml"
    output = tmp_path / "bundle.tar.gz"
    config.write_text(CELL.format(folder=tmp_path, secret=SECRET))
    (tmp_path / "recordings").mkdir()
    for name in (
        "thirdhand-20260101T000000Z",
        "thirdhand-20260102T000000Z",
        "thirdhand-b-20260103T000000Z",
    ):
        (tmp_path / "recordings" / f"{name}.mcap").write_bytes(b"a recording")
        os.utime(tmp_path / "recordings" / f"{name}.mcap", (0, 0))
    done = succeeded(
        "bundle", "--output", str(output), "--config", str(config), "--connect", "tcp/127.0.0.1:1"
    )
    assert "no status: nothing listens at tcp/127.0.0.1:1" in done.stdout
    files = unpacked(output)
    assert "nothing listens" in files["status.json"].decode()
    assert "nothing listens" in files["doctor.txt"].decode()
    assert files["log.txt"]
    assert [name for name in files if "recordings/" in name] == [
        "recordings/thirdhand-20260102T000000Z.mcap"
    ]


def test_a_full_disk_is_said_in_a_sentence_and_leaves_no_archive(tmp_path: Path) -> None:
    arguments = (
        "bundle",
        "--output",
        str(tmp_path / "bundle.tar.gz"),
        "--connect",
        "tcp/127.0.0.1:1",
    )
    full = thirdhand(
        *arguments, preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (1000, 1000))
    )
    assert (full.returncode, "File too large" in full.stderr, "Traceback" in full.stderr) == (
        1,
        True,
        False,
    )
    assert list(tmp_path.iterdir()) == []
