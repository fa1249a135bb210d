"""`thirdhand serve --check` prints one line for each condition of a start, and starts and writes
nothing. `thirdhand status --exit-code` shows a fault by its exit code.
"""

from __future__ import annotations

import contextlib
import os
import re
import socket
from collections.abc import Iterator
from pathlib import Path

import pytest

from support.cell import serving, told
from support.cell_commands import python, succeeded
from support.certificates import make_certificates
from support.paths import ROOT
from support.sabotage import SABOTAGE, fail
from thirdhand.daemon.launch import free_port

# no machine has the second address
TLS = "tls/127.0.0.1:0"
FOREIGN = "tcp/192.0.2.1:7447"
CELL = """
[network]
listen = ["{listen}"]
{network}
[files]
state = "{folder}/state"
record = "{folder}/recordings"
{files}
"""


def cell(
    folder: Path,
    *,
    listen: str = "tcp/127.0.0.1:0",
    network: str = "",
    files: str = "",
    before: str = "",
) -> str:
    """The path of a cell's settings in a folder."""
    path = folder / "cell.toml"
    path.write_text(
        before + CELL.format(listen=listen, folder=folder, network=network, files=files)
    )
    return str(path)


def lines(folder: Path, *arguments: str, code: int, **settings: str) -> dict[str, list[str]]:
    """The output of the check by level and condition; its exit code must be this one."""
    done = told("serve", "--check", "--config", cell(folder, **settings), *arguments)
    assert done.returncode == code, done.stdout + done.stderr
    checks: dict[str, list[str]] = {}
    for line in done.stdout.splitlines():
        match = re.fullmatch(r"(ok|wrong) +(\w+) +(.+)", line)
        assert match is not None, line
        checks.setdefault(f"{match[1]} {match[2]}", []).append(match[3])
    return checks


def test_check_of_a_good_cell_writes_nothing(tmp_path: Path) -> None:
    """Each line is ok."""
    checks = lines(tmp_path, code=0)
    assert list(checks) == [
        "ok configuration",
        "ok imports",
        "ok arm",
        "ok hands",
        "ok skill",
        "ok state",
        "ok descriptors",
        "ok recordings",
        "ok disk",
        "ok port",
    ]
    assert checks["ok hands"] == ["samples needed every 100 ms ([hands] stale_ms), 10 Hz or more"]
    assert [path.name for path in tmp_path.iterdir()] == ["cell.toml"]


@pytest.mark.parametrize("option", ["--check", "--joints=assumed"])
def test_too_few_files_that_may_be_open_prevent_a_start(tmp_path: Path, option: str) -> None:
    arguments = ["serve", option, "--config", cell(tmp_path)]
    program = (
        "import resource, thirdhand.command_line\n"
        "resource.setrlimit(resource.RLIMIT_NOFILE, (100, 100))\n"
        f"raise SystemExit(thirdhand.command_line.main({arguments}))"
    )
    done = python(program)
    assert done.returncode == 1
    assert (
        "this process may open 100 files, 256 or more needed: raise its limit with"
        in done.stdout + done.stderr
    )


@pytest.mark.parametrize(
    ("condition", "words", "settings", "arguments"),
    [
        (
            "configuration",
            "rate_hz: 3 given; a whole number from 50 to 1000",
            {"before": "rate_hz = 3\n"},
            (),
        ),
        (
            "configuration",
            "other machines could move the arm",
            {},
            ("--listen", "tcp/10.0.0.1:7447"),
        ),
        ("skill", "nowhere.npz", {}, ("--skill", "nowhere.npz")),
        ("state", "is not a folder", {"before": "cell = 'lab/x'\n"}, ()),
        (
            "recordings",
            "README.md is not a folder",
            {},
            ("--record", str(ROOT / "README.md" / "x")),
        ),
        ("disk", "room on that disk needed", {"files": "segment_mb = 9e8"}, ()),
        (
            "certificates",
            "certificate.pem: a folder with",
            {"listen": TLS, "network": "certificate = 'none'"},
            (),
        ),
        (
            "router",
            "Connection refused; a program that listens there needed",
            {},
            ("--connect", "tcp/127.0.0.1:1"),
        ),
        ("port", "Address already in use", {}, ("--listen", "TAKEN")),
        (
            "port",
            "Cannot assign requested address",
            {"network": "allow_insecure = true"},
            ("--listen", FOREIGN),
        ),
    ],
)
def test_what_prevents_a_start_is_one_line_and_exit_code_1(
    condition: str, words: str, settings: dict[str, str], arguments: tuple[str, ...], tmp_path: Path
) -> None:
    if condition == "state":
        (tmp_path / "state").write_text("a file")
    with socket.create_server(("127.0.0.1", 0)) as taken:
        options = [
            f"tcp/127.0.0.1:{taken.getsockname()[1]}" if argument == "TAKEN" else argument
            for argument in arguments
        ]
        checks = lines(tmp_path, *options, code=1, **settings)
    assert [level for level in checks if level.startswith("wrong ")] == [f"wrong {condition}"]
    assert words in checks[f"wrong {condition}"][0]
    assert {path.name for path in tmp_path.iterdir()} <= {"cell.toml", "state"}


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("key.pem", "another's", "the key of the first"),
        ("key.pem", "text", "the key of the first"),
        ("key.pem", None, "cannot read"),
        ("certificate.pem", "text", "certificates in PEM"),
        ("authority.pem", "", "certificates in PEM"),
    ],
)
def test_a_certificate_and_a_key_that_do_not_fit_are_wrong(
    name: str, content: str | None, words: str, tmp_path: Path
) -> None:
    secrets = make_certificates(tmp_path)
    path = secrets / "daemon" / name
    text = (secrets / "operator" / name).read_text() if content == "another's" else content
    path.unlink() if text is None else path.write_text(text)
    checks = lines(tmp_path, code=1, listen=TLS, network=f"certificate = '{secrets}/daemon'\n")
    assert words in checks["wrong certificates"][0]


def test_keys_in_endpoints_are_not_shown(tmp_path: Path) -> None:
    secured = f"certificate = '{make_certificates(tmp_path)}/daemon'\n"
    endpoint = "tls/127.0.0.1:0#connect_private_key_base64=c2VjcmV0"
    checks = lines(tmp_path, code=0, listen=endpoint, network=secured)
    assert "c2VjcmV0" not in str(checks)


@contextlib.contextmanager
def unprivileged() -> Iterator[None]:
    """A context in which this process has no rights of the superuser."""
    euid = os.geteuid()
    os.seteuid(65534 if euid == 0 else euid)
    try:
        yield
    finally:
        os.seteuid(euid)


def test_a_folder_without_rights_is_wrong(tmp_path: Path) -> None:
    for folder in (ROOT, *ROOT.parents):
        if os.geteuid() == 0 and folder.stat().st_mode & 0o005 != 0o005:
            pytest.skip(f"other users cannot read {folder}")
    lines(tmp_path, code=0)  # all imports and files of this check have been read
    for folder in tmp_path.parents:
        # folders of this test run, which only its user can read
        if folder.stat().st_mode & 0o005 != 0o005:
            folder.chmod(0o755)
    tmp_path.chmod(0o555)
    try:
        with unprivileged():
            done = told("serve", "--check", "--config", str(tmp_path / "cell.toml"))
    finally:
        tmp_path.chmod(0o755)
    assert done.returncode == 1, done.stdout
    assert done.stdout.count(f"{tmp_path} cannot be written by user") == 2, done.stdout


def test_check_beside_the_running_daemon(tmp_path: Path) -> None:
    """A port that the cell's own daemon uses is fine; a fault has an exit code."""
    listen = f"tcp/127.0.0.1:{free_port()}"
    network = f"[network]\nlisten = ['{listen}']\n"
    sabotage = SABOTAGE.format(folder=str(tmp_path))
    with serving(tmp_path, "--joints", "assumed", network=network, before=sabotage) as daemon:
        checks = lines(tmp_path, code=0, listen=listen)
        assert checks["ok port"] == [
            f"{listen} is in use by this cell's running daemon, process {daemon.process.pid}"
        ]
        checks = lines(tmp_path, "--cell", "another", code=1, listen=listen)
        assert "Address already in use" in checks["wrong port"][0]
        status = ("status", "--exit-code", "--connect", daemon.endpoint)
        succeeded(*status)
        fail(tmp_path, "step", "once")
        daemon.until(lambda now: now["mode"] == "fault")
        for more in ((), ("--json",)):
            done = told(*status, *more)
            assert (done.returncode, "fault" in done.stdout) == (1, True)
    assert told("status", "--exit-code", "--watch").returncode == 2
