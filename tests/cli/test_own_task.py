"""The tutorial's commands, run in order as they stand: demonstrations are recorded, learned from
and followed. Only the endpoint differs, and the person, who is four times as fast.
"""

from __future__ import annotations

import re
import shlex
import subprocess
import sys
import threading
from pathlib import Path

import pytest

from support.paths import ROOT
from thirdhand.command_line import main
from thirdhand.contract.channels import ENDPOINT
from thirdhand.daemon.launch import free_port
from thirdhand.skills.skill_file import decoded
from thirdhand_sim import teach

BLOCKS = re.findall(
    r"```sh\n(.*?)```", (ROOT / "docs" / "tutorial.md").read_text(encoding="utf-8"), re.DOTALL
)
SPEED = "4"
REST_S = "0.6"


class Shell:
    """Runs the tutorial's lines; those that end with `&` run beside the others, the daemon as a
    process.
    """

    def __init__(self) -> None:
        self.at = f"tcp/127.0.0.1:{free_port()}"
        self.teachers: list[threading.Thread] = []
        self.daemon: subprocess.Popen[str] | None = None
        self.codes: list[int] = []

    def run(self, line: str) -> None:
        words = shlex.split(line.replace(ENDPOINT, self.at).replace("--rest 2", f"--rest {REST_S}"))
        words = [
            argument
            for word in words
            for argument in (sorted(map(str, Path().glob(word))) if "*" in word else [word])
        ]
        match words:
            case ["python", "-m", "thirdhand_sim.teach", *options, "&"]:
                options += ["--connect", self.at, "--speed", SPEED, "--wait", "30"]
                self.teachers.append(
                    threading.Thread(
                        target=lambda: self.codes.append(teach.main(options)), daemon=True
                    )
                )
                self.teachers[-1].start()
            case ["python", "-m", "thirdhand_sim.teach", *options]:
                assert teach.main(options) == 0
            case ["thirdhand", "serve", *options, "&"]:
                command = [
                    sys.executable,
                    "-m",
                    "thirdhand",
                    "serve",
                    *options,
                    "--listen",
                    self.at,
                ]
                self.daemon = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
                assert self.daemon.stdout is not None
                assert self.daemon.stdout.readline().startswith("listening on ")
            case ["thirdhand", "via-points" | "segment" | "status", *_]:
                assert main([*words[1:], "--connect", self.at]) == 0
            case ["thirdhand", *options]:
                assert main(options) == 0
            case ["kill", "%1"]:
                assert self.daemon is not None
                self.daemon.terminate()
            case _:
                pytest.fail(f"a line that is not understood: {line}")

    def close(self) -> None:
        if self.daemon is not None:
            self.daemon.kill()
            self.daemon.communicate()


@pytest.mark.timeout(300)  # it takes 15 s on an idle machine
@pytest.mark.thorough
def test_the_tutorial_runs_as_it_stands(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    # another HOME would have an empty cache of compiled code
    for kind in ("STATE", "CONFIG"):
        monkeypatch.setenv(f"XDG_{kind}_HOME", str(tmp_path))
    shell = Shell()
    try:
        for block in BLOCKS:
            for line in block.splitlines():
                shell.run(line)
        assert shell.daemon is not None
        assert shell.daemon.wait(30) == 0
        for teacher in shell.teachers:
            teacher.join(30)
    finally:
        shell.close()
    assert shell.codes[0] == 0
    output = capsys.readouterr()
    assert "3 takes in demonstrations" in output.err
    assert "6 via-points in force" in output.out
    assert re.search(r"^nearer +tool .*missed by .* mm$", output.out, re.MULTILINE)
    assert re.search(r"^at start since tick \d+: ", output.out, re.MULTILINE)
    assert re.search(r"^the teacher was .* late", output.out, re.MULTILINE)
    skill = decoded((tmp_path / "skill.npz").read_bytes(), origin="skill")
    assert skill.model.names == ("start", "tray", "work", "tray again", "done")
    for name in ("take-3.png", "skill.png"):
        assert (tmp_path / name).stat().st_size > 10_000
