"""The start of a daemon: it reports its progress at once, and clients wait as long as it
progresses.
"""

from __future__ import annotations

import re
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest

from support.cell import serving
from support.cell_commands import python
from thirdhand.client import Client, StartingError, UnreachableError, cells, endpoints, open_session
from thirdhand.command_line import main
from thirdhand.contract.channels import CHANNELS
from thirdhand.daemon import launch
from thirdhand.daemon.launch import LaunchError
from thirdhand.daemon.start import Startup, starting
from thirdhand.settings.config import Files, Settings
from thirdhand.settings.network import Network


@pytest.fixture
def started(tmp_path: Path) -> Iterator[tuple[Startup, str]]:
    """A cell whose daemon is starting, and the daemon's endpoint."""
    network = Network(listen=("tcp/127.0.0.1:0",))
    files = Files(state=str(tmp_path))
    with starting(Settings(cell="lab/bench", network=network, files=files)) as start:
        yield start, endpoints(start.session)[0]


def test_starting_daemon_answers_with_its_progress(
    started: tuple[Startup, str], capsys: pytest.CaptureFixture[str]
) -> None:
    """Every request is answered with the progress of the start."""
    start, endpoint = started
    with open_session(connect=[endpoint]) as session:
        client = Client(session, "lab/bench")
        for channel in CHANNELS:
            if channel.queryable:
                with pytest.raises(
                    StartingError,
                    match=r"cell lab/bench is starting: importing, \d+ modules so far",
                ):
                    client.ask(channel.key)
        (cell,) = cells(session)
        assert (cell.name, cell.status) == ("lab/bench", None)
        reach = ("--connect", endpoint, "--cell", "lab/bench")
        for command in ("status", "doctor", "hold"):
            assert main([command, *reach]) == 1
            out, errors = capsys.readouterr()
            assert "starting: importing" in out + errors
        assert main(["status", "--watch", *reach]) == 1
        assert "starting: importing" in capsys.readouterr().err
        start.over()
        with pytest.raises(UnreachableError, match="is starting or ending") as ended:
            client.status()
        assert not isinstance(ended.value, StartingError)


def test_start_with_progress_is_waited_for_longer(started: tuple[Startup, str]) -> None:
    """A start without progress is waited for less long."""
    sleeping = threading.Event()
    with open_session(connect=[started[1]]) as session:
        client = Client(session, "lab/bench")
        reports: list[str] = []
        modules = [f"begun_{i}" for i in range(8)]

        def go_on() -> None:
            for name in modules:
                sleeping.wait(0.25)
                sys.modules[name] = sys  # one more imported module
            reports.append("all")

        thread = threading.Thread(target=go_on)
        thread.start()
        with pytest.raises(StartingError):
            client.wait_until_ready(timeout_s=1.0)
        assert reports  # 2 s, during which the start progressed
        thread.join()
        for name in modules:
            del sys.modules[name]


@pytest.mark.thorough
def test_a_service_that_gets_no_further_is_not_waited_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(launch, "START_STALL_S", 16.0)
    before = (
        "import time\nfrom thirdhand.daemon import daemon\ndaemon.warm_up = lambda *_, **__: "
        "time.sleep(600)"
    )
    reports: list[str] = []
    stuck = r"no progress for 16 s.*last report: loading compiled functions, \d+ of \d+ functions"
    with (
        pytest.raises(LaunchError, match=stuck),
        serving(tmp_path, before=before, say=reports.append),
    ):
        raise AssertionError("it was ready")
    assert reports[0].startswith("  starting: importing")


@pytest.mark.parametrize(
    "command",
    ["status", "doctor", "hold", "status --all", "follow simulated --wait 1", "via-points list"],
)
def test_missing_listener_is_reported_before_heavy_imports(command: str) -> None:
    arguments = [*command.split(), "--connect", f"tcp/127.0.0.1:{launch.free_port()}"]
    code = (
        f"import sys\nfrom thirdhand.command_line import main\ncode = main({arguments})\nassert "
        "'numpy' not in sys.modules\n"
    )
    done = python(f"{code}sys.exit(code)")
    assert done.returncode == 1
    assert re.search(r"nothing listens at|nothing listens on", done.stdout + done.stderr)
    assert "Traceback" not in done.stderr
