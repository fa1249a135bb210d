"""Variables of a terminal: encoding of the output, modules of another Python, folders of a user."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from support.paths import RECORDINGS, ROOT
from thirdhand.settings.user_folder import user_folder

ENCODINGS = (
    {"PYTHONIOENCODING": "ascii"},
    {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"},
)
COMMANDS = {
    f"record demonstration-1 --folder {RECORDINGS} --show": 0,
    "serve --check --config süd-²-█.toml": 1,
    "sim --scene süd-²-█.toml": 1,
    "no-such-command-█": 2,
}
HOMELESS = """
import os, pwd
os.environ.pop("HOME", None)
pwd.getpwuid = {}.__getitem__
"""


def run(
    command: str, *, before: str = "", folder: Path = ROOT, **variables: str
) -> subprocess.CompletedProcess[str]:
    """A command in a terminal with these variables."""
    code = f"{before}\nimport sys\nfrom thirdhand.__main__ import main\nsys.exit(main())"
    return subprocess.run(
        [sys.executable, "-P", "-c", code, *command.split()],
        env=os.environ | variables,
        cwd=folder,
        capture_output=True,
        timeout=60,
        check=False,
        encoding="utf-8",
        errors="replace",
    )


@pytest.mark.parametrize("variables", ENCODINGS)
@pytest.mark.parametrize(("command", "code"), COMMANDS.items())
def test_no_encoding_of_the_output_ends_in_a_traceback(
    command: str, code: int, variables: dict[str, str]
) -> None:
    done = run(command, **variables)
    assert (done.returncode, "Traceback" in done.stderr) == (code, False), done.stderr


@pytest.mark.parametrize("variable", ["PYTHONPATH", "LD_LIBRARY_PATH"])
@pytest.mark.parametrize(
    "command", ["serve", "serve --check", "arm service/thirdhand/arms/ur5.urdf"]
)
def test_module_of_another_python_is_one_sentence(
    tmp_path: Path, command: str, variable: str
) -> None:
    """The sentence names the file and the variable."""
    module = tmp_path / "pinocchio" / "__init__.py"
    library = "libboost.so"
    module.parent.mkdir()
    module.write_text("from .pinocchio_pywrap_default import *")
    before = ""
    file = str(module)
    if variable == "LD_LIBRARY_PATH":
        module.write_text(f"raise ImportError('{library}: no such file', path='{library}')")
        before = f"import sys; sys.path.insert(0, {str(tmp_path)!r})"
        file = library
    done = run(command, before=before, XDG_STATE_HOME=str(tmp_path), **{variable: str(tmp_path)})
    (sentence,) = [
        line
        for line in (done.stdout + done.stderr).splitlines()
        if "cannot be imported here" in line
    ]
    assert (done.returncode, "Traceback" in done.stderr) == (1, False)
    assert file in sentence
    assert f"${variable} leads to" in sentence


def test_user_without_a_home_gets_no_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The error names the variable that is needed."""
    monkeypatch.setenv("HOME", "/home/me")
    for state, code, words in (
        (
            "relative",
            1,
            "this user has no home folder; $XDG_STATE_HOME or $HOME needed, or [files] state",
        ),
        (str(tmp_path / "state"), 0, f"{tmp_path}/state/thirdhand/thirdhand can be made"),
    ):
        done = run("serve --check", before=HOMELESS, folder=tmp_path, XDG_STATE_HOME=state)
        assert (done.returncode, words in done.stdout) == (code, True), done.stdout
        assert list(tmp_path.iterdir()) == []
        monkeypatch.setenv("XDG_STATE_HOME", state)
        assert user_folder("state") == Path(
            state if code == 0 else "/home/me/.local/state", "thirdhand"
        )
