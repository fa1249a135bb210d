"""`thirdhand serve --log json`: each line of the log is a JSON object, the last one included."""

from __future__ import annotations

import json
import os
from pathlib import Path

from support.cell import serving, thirdhand
from support.cell_commands import python


def test_each_line_of_a_json_log_is_an_object(tmp_path: Path) -> None:
    """The last line before a failure is an object too."""
    with serving(tmp_path, "--joints", "assumed", "--log", "json") as daemon:
        daemon.client.ask("hold")
        daemon.client.ask("resume")
        assert daemon.end() == 0
        lines = [json.loads(line) for line in daemon.log.read_text().splitlines()]
    assert {tuple(line) for line in lines} == {("time", "level", "logger", "message")}
    assert "ended: the daemon of cell thirdhand" in lines[-1]["message"]
    assert lines[0]["time"].endswith("+00:00")
    for code, words, arguments in (
        (2, "cell: '*' given", ("--cell", "*")),
        (1, "cannot read configuration", ("--config", "nowhere.toml")),
        (1, "nowhere.npz", ("--skill", "nowhere.npz", "--listen", "tcp/127.0.0.1:0")),
    ):
        done = thirdhand(
            "serve", "--log", "json", *arguments, env=os.environ | {"HOME": str(tmp_path)}
        )
        last = json.loads(done.stderr.splitlines()[-1])
        assert (done.returncode, last["level"], words in last["message"]) == (
            code,
            "error",
            True,
        ), done.stderr


def test_an_unexpected_failure_is_an_object_with_its_exception() -> None:
    code = (
        "import sys\nfrom thirdhand.cli import serve\nfrom thirdhand.command_line import main\n"
        "serve.starting = None\nsys.exit(main(['serve', '--log', 'json']))"
    )
    done = python(code)
    line = json.loads(done.stderr)
    assert (done.returncode, line["level"]) == (1, "error")
    assert "Traceback" in line["exception"]
