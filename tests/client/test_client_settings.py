"""Endpoints by which clients reach a cell: from option, environment or file."""

from __future__ import annotations

from pathlib import Path

import pytest

from thirdhand.client import UnreachableError, client_settings, open_session
from thirdhand.command_line import main
from thirdhand.settings.config import Settings
from thirdhand.settings.file_content import SettingsError

VARIABLES = ("CONNECT", "CELL", "CERTIFICATE", "ZENOH_CONFIG")


@pytest.fixture
def file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The path of the client's file; option and environment are not set."""
    for name in VARIABLES:
        monkeypatch.delenv(f"THIRDHAND_{name}", raising=False)
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path))
    (tmp_path / "thirdhand").mkdir()
    return tmp_path / "thirdhand" / "client.toml"


def test_option_goes_before_environment_file_and_default(
    file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The order is option, environment, file, default."""
    assert (client_settings().cell, client_settings().connect) == ("thirdhand", ())
    file.write_text(
        'connect = "tcp/127.0.0.1:1"\ncell = "filed"\ncertificate = "secrets/operator"\n'
    )
    settings = client_settings()
    assert (settings.cell, settings.connect) == ("filed", ("tcp/127.0.0.1:1",))
    assert settings.certificate == str(file.parent / "secrets" / "operator")
    monkeypatch.setenv("THIRDHAND_CELL", "told")
    monkeypatch.setenv("THIRDHAND_CONNECT", "tcp/127.0.0.1:2, tcp/127.0.0.1:3")
    settings = client_settings()
    assert (settings.cell, settings.connect) == ("told", ("tcp/127.0.0.1:2", "tcp/127.0.0.1:3"))
    settings = client_settings(cell="said", connect=["tcp/127.0.0.1:4"], certificate="mine")
    assert (settings.cell, settings.connect, settings.certificate) == (
        "said",
        ("tcp/127.0.0.1:4",),
        "mine",
    )


def test_certificate_of_a_client_is_its_own(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The certificate of a client is not that of a daemon without one."""
    monkeypatch.setenv("THIRDHAND_CERTIFICATE", str(tmp_path / "secrets"))
    open_session(listen=["tcp/127.0.0.1:0"], certificate=Settings().network.certificate).close()
    with pytest.raises(UnreachableError, match=r"cannot read .*secrets/certificate\.pem"):
        open_session(listen=["tcp/127.0.0.1:0"])


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("cell = ", r"client\.toml: "),
        (
            'cel = "lab"',
            r"client\.toml: unknown field 'cel'; known are connect, cell, "
            "certificate, zenoh_config",
        ),
        ('cell = "*"', r"client\.toml: cell: '\*' given; words joined by"),
        ('cell = "a/.."', r"client\.toml: cell: 'a/\.\.' given; no \. or"),
        ('connect = "127.0.0.1:1"', r"client\.toml: connect, entry 1: .*: tcp/127\.0\.0\.1:1 \?"),
        ("connect = 3", r"client\.toml: connect: 3 given; an endpoint, or a list"),
    ],
)
def test_a_wrong_file_is_told_with_what_is_accepted(
    file: Path, text: str, said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    file.write_text(text)
    with pytest.raises(SettingsError, match=said):
        client_settings()
    assert main(["status"]) == 2
    assert str(file) in capsys.readouterr().err
