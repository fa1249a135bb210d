"""The command line as a whole: groups, one word for one thing, completion, and exit codes."""

from __future__ import annotations

import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from service.cli.main import GROUPS, main
from service.launch import free_port
from support.cell import thirdhand
from support.paths import RECORDINGS, ROOT

COMMANDS = [name for names in GROUPS.values() for name in names]
RENAMED = ("--out", "--duration", "--json FILE", "--soak MIN")
NOBODY = ("--connect", "tcp/127.0.0.1:1")


def told(*arguments: str, capsys: pytest.CaptureFixture[str]) -> tuple[int, str]:
    """Exit code, and what was printed."""
    try:
        code = main(list(arguments))
    except SystemExit as ended:
        code = int(ended.code or 0)
    printed = capsys.readouterr()
    return code, printed.out + printed.err


def test_help_lists_each_command_in_one_group(capsys: pytest.CaptureFixture[str]) -> None:
    _, text = told("--help", capsys=capsys)
    titles = re.findall(r"^([a-z ]+):$", text, re.MULTILINE)
    assert titles == list(GROUPS)
    assert re.findall(r"^  ([a-z-]+)\s", text, re.MULTILINE) == COMMANDS
    assert len(set(COMMANDS)) == len(COMMANDS)
    _, refused = told("nonsense", capsys=capsys)
    assert set(re.findall(r"[a-z-]+", refused.partition("choose from")[2])) >= set(COMMANDS)


@pytest.mark.parametrize("command", [name for name in COMMANDS if name != "sim"])
def test_one_thing_has_one_word(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    code, text = told(command, "--help", capsys=capsys)
    assert code == 0
    assert not [word for word in RENAMED if re.search(rf"{word}\b", text)]
    assert "python -m sim " not in text


def test_the_bench_goes_by_its_own_name() -> None:
    text = thirdhand("sim", "--help").stdout
    assert text.startswith("usage: thirdhand sim ")
    assert not [word for word in (*RENAMED, "python -m") if re.search(rf"{word}\b", text)]
    assert {"--output", "--seconds"} <= set(re.findall(r"--\w+", text))
    refused = thirdhand("sim", "--speed", "99")
    assert (refused.returncode, "thirdhand sim: error: --speed 99" in refused.stderr) == (2, True)


@pytest.mark.parametrize(
    ("given", "meant"),
    [
        ("127.0.0.1:1", "tcp/127.0.0.1:1"),
        ("localhost", "tcp/localhost:7447"),
        ("tcp://127.0.0.1:1", "tcp/127.0.0.1:1"),
        ("tls/bench", "tls/bench:7447"),
        ("7447", "tcp/127.0.0.1:7447"),
    ],
)
@pytest.mark.parametrize("command", [("serve", "--listen"), ("record", "take", "--listen"), ("status", "--connect")])
def test_an_endpoint_without_all_its_parts_is_told_with_what_was_meant(
    given: str, meant: str, command: tuple[str, ...], capsys: pytest.CaptureFixture[str]
) -> None:
    code, text = told(*command, given, capsys=capsys)
    assert (code, text.rstrip().endswith(f": {meant} ?")) == (2, True), text


def test_an_endpoint_of_the_settings_is_told_likewise(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "cell.toml").write_text('[network]\nlisten = ["127.0.0.1:1"]\n')
    code, text = told("serve", "--config", str(tmp_path / "cell.toml"), capsys=capsys)
    assert (code, "$.network.listen[0]" in text, "tcp/127.0.0.1:1 ?" in text) == (2, True, True), text


# --- exit codes, as docs/incidents.md promises them -----------------------------------------------


def test_a_configuration_that_cannot_be_meant_is_2_and_one_that_cannot_be_read_is_1(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    config, demonstration = tmp_path / "cell.toml", str(RECORDINGS / "demonstration-1.mcap")
    config.write_text("rate_hz = 3\n")
    missing = str(tmp_path / "none.toml")
    for command in (
        ("serve",),
        ("record", "--list"),
        ("learn", demonstration, "--output", str(tmp_path / "skill.npz")),
    ):
        for path, expected in ((str(config), 2), (missing, 1)):
            code, text = told(*command, "--config", path, capsys=capsys)
            assert (code, path in text) == (expected, True), text


@pytest.mark.parametrize(
    ("code", "arguments"),
    [
        (0, ("--version",)),
        (0, ("record", "--list", "--folder", "nowhere")),
        (1, ("status", *NOBODY)),
        (1, ("doctor", *NOBODY)),
        (1, ("cells", *NOBODY)),
        (1, ("hold", *NOBODY)),
        (1, ("play", str(RECORDINGS / "demonstration-6.mcap"), *NOBODY)),
        (1, ("replay", "nowhere.mcap")),
        (1, ("report", "nowhere.mcap")),
        (1, ("view", "nowhere.mcap")),
        (1, ("learn", "nowhere.mcap", "--output", "nowhere.npz")),
        (1, ("serve", "--skill", "nowhere.npz", "--listen", "tcp/127.0.0.1:0")),
        (2, ()),
        (2, ("status", "--cell", "*")),
        (2, ("serve", "--cell", "*")),
        (2, ("hold", "--cell", "")),
        (2, ("record",)),
        (2, ("bench", "--seconds", "-1")),
        (2, ("demo", "--rate", "3")),
        (2, ("via-points", "add", "here", *NOBODY)),
        (2, ("view", "live", "--time", "-1", *NOBODY)),
    ],
)
def test_exit_codes_are_as_promised(
    code: int, arguments: tuple[str, ...], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    monkeypatch.setenv("HOME", str(tmp_path))
    done = thirdhand(*arguments)
    assert done.returncode == code, done.stderr
    assert "Traceback" not in done.stderr
    assert not code or done.stderr.strip() or done.stdout.startswith("wrong ")


def test_a_bench_that_is_interrupted_is_130() -> None:
    pytest.importorskip("pybullet", reason="the bench needs PyBullet")
    command = [sys.executable, "-m", "service", "sim", "--listen", f"tcp/127.0.0.1:{free_port()}"]
    for number, code in ((signal.SIGINT, 130), (signal.SIGTERM, 0)):
        with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=ROOT) as process:
            assert process.stderr is not None
            end = time.monotonic() + 60
            while "listening on" not in process.stderr.readline():
                assert time.monotonic() < end
            process.send_signal(number)
            assert process.wait(30) == code


# --- completion -----------------------------------------------------------------------------------

BASH = """
source "$1"
COMP_WORDS=({words})
COMP_CWORD={last}
COMP_LINE="{words}"
_shtab_thirdhand thirdhand
printf '%s\\n' "${{COMPREPLY[@]}}"
"""


@pytest.mark.parametrize(
    ("words", "found"),
    [
        ("thirdhand via", {"via-points"}),
        ("thirdhand via-points l", {"list"}),
        ("thirdhand status --wat", {"--watch"}),
        ("thirdhand record --f", {"--folder"}),
        ("thirdhand serve --arm a", {"assumed"}),
    ],
)
def test_a_shell_completes_commands_options_and_choices(words: str, found: set[str], tmp_path: Path) -> None:
    pytest.importorskip("shtab", reason="shtab, which writes the shells' scripts, is not installed")
    script = tmp_path / "thirdhand"
    done = thirdhand("completion", "bash")
    assert done.returncode == 0, done.stderr
    script.write_text(done.stdout)
    program = BASH.format(words=words, last=len(words.split()) - 1)
    asked = subprocess.run(
        ["bash", "-c", program, "bash", str(script)], capture_output=True, text=True, timeout=30, check=False
    )
    assert set(asked.stdout.split()) == found, asked.stderr
