"""The command line as a whole: groups, one word for one thing, and exit codes."""

from __future__ import annotations

import os
import re
import shlex
import signal
import socket
from pathlib import Path

import pytest

from support.cell import thirdhand, told
from support.cell_commands import assert_refused, started
from support.paths import ARMS, RECORDINGS
from thirdhand.command_line import GROUPS
from thirdhand.contract.requests import encode_json
from thirdhand.daemon.launch import free_port

COMMANDS = [name for names in GROUPS.values() for name in names]
RENAMED = ("--out", "--duration", "--json FILE", "--soak MIN")
NOBODY = ("--connect", "tcp/127.0.0.1:1")


def test_help_lists_each_command_in_one_group() -> None:
    text = told("--help").stdout
    titles = re.findall(r"^([a-z ]+):$", text, re.MULTILINE)
    assert titles == list(GROUPS)
    assert re.findall(r"^  ([a-z-]+)\s", text, re.MULTILINE) == COMMANDS
    assert len(set(COMMANDS)) == len(COMMANDS)
    refused = told("nonsense").stderr
    assert "did you mean" not in refused
    assert set(re.findall(r"[a-z-]+", refused.partition("choose from")[2])) >= set(COMMANDS)


@pytest.mark.parametrize("command", [name for name in COMMANDS if name != "sim"])
def test_one_thing_has_one_word_and_an_example(command: str) -> None:
    done = told(command, "--help")
    assert (done.returncode, "example:" in (text := done.stdout)) == (0, True)
    assert not [word for word in RENAMED if re.search(rf"{word}\b", text)]
    assert "python -m thirdhand_sim " not in text


@pytest.mark.parametrize(
    ("given", "meant"),
    [
        ("127.0.0.1:1", "tcp/127.0.0.1:1"),
        ("tcp://127.0.0.1:1", "tcp/127.0.0.1:1"),
        ("7447", "tcp/127.0.0.1:7447"),
    ],
)
@pytest.mark.parametrize(
    "command", [("serve", "--listen"), ("record", "take", "--listen"), ("status", "--connect")]
)
def test_incomplete_endpoint_is_explained(given: str, meant: str, command: tuple[str, ...]) -> None:
    """An endpoint that lacks a part is refused with the form that it should have."""
    done = told(*command, given)
    assert (done.returncode, done.stderr.rstrip().endswith(f": {meant} ?")) == (2, True), (
        done.stderr
    )


# --- exit codes, as docs/incidents.md states them -------------------------------------------------


def test_exit_codes_of_bad_configurations(tmp_path: Path) -> None:
    """An invalid configuration is 2; one that cannot be read is 1."""
    config = tmp_path / "cell.toml"
    takes = [str(RECORDINGS / f"demonstration-{number}.mcap") for number in (1, 2)]
    config.write_text("rate_hz = 3\n")
    missing = str(tmp_path / "none.toml")
    for command in (
        ("serve",),
        ("record", "--list"),
        ("learn", *takes, "--output", str(tmp_path / "skill.npz")),
    ):
        for path, expected in ((str(config), 2), (missing, 1)):
            assert_refused(expected, path, *command, "--config", path)


REFUSED = [  # exit code, words on standard error, command
    (1, "nowhere does not exist: a folder of takes needed", "record --list --folder nowhere"),
    (1, "nowhere.mcap", "replay nowhere.mcap"),
    (1, "at least 2 needed", "learn {take} --output nowhere.npz"),
    (
        1,
        "thirdhand status: nothing listens at tcp/127.0.0.1:1: is a daemon or a router running",
        "status {nobody}",
    ),
    (1, "50 Hz is too slow: commands would arrive every 20 ms", "demo --rate 50"),
    (1, "not a recording of thirdhand", "replay {take}"),
    (
        1,
        "has checksums instead of frames: thirdhand replay {golden} --output whole.mcap",
        "report {golden}",
    ),
    (1, "the last ones of the arm are tool0; did you mean tool0?", "arm {ur5} --plate tool"),
    (1, "no take 'a' in ", "record a --delete"),
    (1, "exists already: give another name, or --delete it first", "record there"),
    (
        1,
        "points, entry 2, name: 'glass' given twice, names once each needed",
        "record a --via-points twice.json",
    ),
    (1, "Without a daemon, use --listen tcp/127.0.0.1:7447", "record a {nobody}"),
    (1, "cannot read nowhere.urdf", "arm nowhere.urdf"),
    (1, "nowhere.log: No such file or directory", "bundle --log nowhere.log {nobody}"),
    (2, "; did you mean status?", "stauts"),
    (2, "--cell: '", "status --cell *"),
    (2, "a port from 0 to 65535 needed", "status --connect tcp/127.0.0.1:99999"),
    (2, "the name of a host or an IP address needed", "status --connect tcp/bench..local:7447"),
    (2, "0 to 65535 needed", "serve --live 99999"),
    (2, "no such process", "serve --end-with 2147483647"),
    *(
        (2, f"{rate} given, 50 to 1000 Hz needed", f"{command} --rate {rate}")
        for command in ("demo", "bench", "serve")
        for rate in ("49", "1001", "5OO")
    ),
    (2, "allow_insecure = true needed", "serve --connect tcp/10.0.0.1:7447"),
    (2, "nan given, -10 to 10 m needed", "via-points add here --left nan 0 0"),
    (2, "--web and --screenshot given", "view live --web --screenshot a.png"),
    (2, "--tab chooses the tab of a picture", "view live --web --tab timing"),
    (2, "--workers: --each needed", "replay a.mcap b.mcap --workers 2"),
    (
        2,
        "--output writes the frames of one recording",
        "replay a.mcap b.mcap --each --output new.mcap",
    ),
    (2, "there is no folder no/such", "report {golden} --html no/such/folder.html"),
    (2, "is a file; a folder needed", "report {golden} --csv {golden}"),
    (
        2,
        "many given; a number of processes, or dask:tcp://HOST:8786",
        "report a.mcap b.mcap --workers many",
    ),
    (2, "no arm 'nowhere'", "serve --config nowhere"),
    (2, "os:path is no class of thirdhand.Hands", "hands --own os:path"),
    (2, "os: MODULE:CLASS or FILE.py:CLASS needed", "hands --own os"),
    (2, "cell.txt: a name that ends in .toml needed", "arm {ur5} --output cell.txt"),
    (2, "9 given, -3 to 3 needed", "arm {ur5} --at 9 0 0"),
    (2, "no posture found with the tool at", "arm {ur5} --at -2 0 0"),
    (2, "either the name of a take or --list needed", "record"),
    (2, "accepted as a take's name", "record a/b {nobody}"),
    (2, "a.jpg: a name that ends in .png needed, like a.png", "record a --plot a.jpg"),
    (2, "needed, the first below the second", "record a --trim 3 1"),
    (2, "not allowed with argument", "calibrate --held --at 0 0 0"),
    (
        2,
        "--check compares with the last calibration of a cell: give its settings by --config FILE",
        "calibrate --check",
    ),
    (2, "1 points given; 4 or more needed", "calibrate --at 0 0 0"),
    (2, "0 given, 0.1 to 200 mm needed", "calibrate --accept 0"),
    (2, "there is no folder", "bundle --output nowhere/x.tar.gz {nobody}"),
    (2, "PORT or HOST:PORT needed", "metrics --listen no-port"),
    (2, "--web 99999: PORT or HOST:PORT needed", "view live --web 99999 {nobody}"),
    (2, "-1 given, 0 to 3600 s needed", "follow simulated --wait -1"),
]
PATHS = {
    "nobody": " ".join(NOBODY),
    "take": RECORDINGS / "demonstration-1.mcap",
    "golden": RECORDINGS / "golden.mcap",
    "ur5": ARMS / "ur5.urdf",
}


@pytest.fixture
def folder(
    tmp_path: Path, tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch
) -> Path:
    """The working folder, with files that cannot be used; commands try to connect for 0.2 s."""
    monkeypatch.setenv("HOME", str(tmp_path))
    # else Matplotlib keeps its own folder
    monkeypatch.setenv("MPLCONFIGDIR", str(tmp_path_factory.getbasetemp()))
    for command in ("record", "calibrate"):
        monkeypatch.setattr(f"thirdhand.workbench.cli.{command}.CONNECT_TIMEOUT_S", 0.2)
    working = tmp_path / "working"
    working.mkdir()
    monkeypatch.chdir(working)
    glass = {"name": "glass", "left": [0, 0, 0], "right": [0, 0, 0], "tool": [0, 0, 0]}
    Path("twice.json").write_bytes(encode_json({"op": "add", "points": [glass, glass]}))
    Path("demonstrations").mkdir()
    Path("demonstrations/there.mcap").write_bytes(b"")
    return working


@pytest.mark.parametrize(("code", "words", "command"), REFUSED)
def test_refusals_have_their_exit_code_and_write_nothing(
    code: int, words: str, command: str, folder: Path
) -> None:
    before = sorted(folder.rglob("*"))
    done = assert_refused(code, words.format_map(PATHS), *shlex.split(command.format_map(PATHS)))
    assert "Traceback" not in done.stderr
    assert done.stderr.strip()
    assert not done.stdout
    assert sorted(folder.rglob("*")) == before


def test_view_without_a_screen_is_refused_first(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    done = told("view", str(RECORDINGS / "golden.mcap"))
    assert (done.returncode, done.stderr.count("\n")) == (1, 1)
    assert "there is no screen" in done.stderr


@pytest.mark.parametrize(
    ("code", "words", "arguments"),
    [
        (0, "thirdhand 0.", ("--version",)),
        (
            1,
            "/proc/x: No such file or directory",
            ("serve", "--record", "/proc/x", "--listen", "tcp/127.0.0.1:0"),
        ),
        (2, "COMMAND", ()),
        (
            2,
            "no arm 'panda': wam, franka, ur5, or a cell's settings (FILE.toml) needed",
            ("demo", "--arm", "panda"),
        ),
        (
            2,
            "no arm 'panda': wam, franka, ur5, or a cell's settings (FILE.toml) needed",
            ("sim", "--arm", "panda"),
        ),
    ],
)
@pytest.mark.one_case
def test_so_are_those_of_a_process(
    code: int, words: str, arguments: tuple[str, ...], tmp_path: Path
) -> None:
    done = thirdhand(*arguments, env=os.environ | {"HOME": str(tmp_path)})
    assert (done.returncode, done.stderr == "") == (code, code == 0), done.stderr
    assert words in (done.stderr if code else done.stdout)
    assert "Traceback" not in done.stderr


@pytest.mark.thorough
def test_silence_is_reported_and_waited_for() -> None:
    """A closed port is reported at once; a listener that does not answer is waited for."""
    done = thirdhand("status", "--connect", "tcp/bench.invalid:1")
    assert (done.returncode, done.stdout) == (1, "")
    assert re.fullmatch(
        r"thirdhand status: tcp/bench\.invalid:1 cannot be reached: .+\n", done.stderr
    )
    with socket.create_server(("127.0.0.1", 0)) as silent:
        done = thirdhand("status", "--connect", f"tcp/127.0.0.1:{silent.getsockname()[1]}")
    assert done.returncode == 1
    assert "nobody answers at tcp/127.0.0.1:" in done.stderr


@pytest.mark.parametrize("command", [("play", str(RECORDINGS / "demonstration-6.mcap")), ("sim",)])
def test_publishers_wait_for_a_daemon(command: tuple[str, ...]) -> None:
    """Commands that publish wait for a daemon until they are interrupted."""
    with started(*command, *NOBODY) as process:
        assert process.stderr.readline().startswith(
            "waiting, until Ctrl-C: nobody answers at tcp/127.0.0.1:1"
        )
        process.send_signal(signal.SIGINT)
        assert process.wait(30) == 130
        assert process.stderr.read() == "thirdhand: interrupted\n"


def test_a_bench_that_is_interrupted_is_130() -> None:
    for number, code in ((signal.SIGINT, 130), (signal.SIGTERM, 0)):
        with started("sim", "--listen", f"tcp/127.0.0.1:{free_port()}") as process:
            while "listening on" not in process.stderr.readline():
                pass
            process.send_signal(number)
            assert process.wait(30) == code
            ended = (
                "ended: the bench of cell thirdhand, after 0 complete runs; without --output no "
                "report was written"
            )
            assert process.stderr.read().splitlines()[-1] == ended


# --- help -----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "command",
    ["demo --output /dev/full", "record take --folder /dev/full", "bench --output /dev/full"],
)
def test_what_the_operating_system_refuses_is_said_in_words(command: str) -> None:
    done = told(*command.split())
    assert done.returncode == 1
    assert re.search(r"/dev/full: (File exists|Not a directory); a folder needed", done.stderr)
    assert "rrno" not in done.stderr


@pytest.mark.parametrize("arguments", ["serve --check", "sim --via-points"])
def test_that_the_output_is_full_is_said_in_words(arguments: str) -> None:
    with open("/dev/full", "w") as full, started(*arguments.split(), stdout=full) as process:
        _, errors = process.communicate(timeout=60)
    name = arguments.split(maxsplit=1)[0]
    assert process.returncode == 1
    assert errors == f"thirdhand {name}: No space left on device; room on that disk needed\n"
