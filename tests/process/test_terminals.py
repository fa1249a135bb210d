"""Variables of a terminal: encoding of the output, modules of another Python, folders of a user."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from service.settings.user_folder import HomelessError, user_folder
from support.paths import RECORDINGS, ROOT

ENCODINGS = (
    {"PYTHONIOENCODING": "ascii"},
    {"PYTHONIOENCODING": "latin-1"},
    {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"},
)
WITHOUT_HOME = """
import os, pwd
os.environ.pop("HOME", None)
def getpwuid(number): raise KeyError(number)
pwd.getpwuid = getpwuid
"""


def run(*arguments: str, before: str = "", folder: Path = ROOT, **variables: str) -> subprocess.CompletedProcess[str]:
    """A command in a terminal with these variables, by its entry point."""
    code = f"{before}\nimport sys\nfrom service.__main__ import main\nsys.exit(main())"
    path = os.pathsep.join(filter(None, (variables.pop("PYTHONPATH", ""), str(ROOT))))
    return subprocess.run(
        [sys.executable, "-P", "-c", code, *arguments],
        env=os.environ | variables | {"PYTHONPATH": path},
        cwd=folder, capture_output=True, timeout=60, check=False, encoding="utf-8", errors="replace",
    )  # fmt: skip


@pytest.mark.parametrize("variables", ENCODINGS)
@pytest.mark.parametrize(
    ("command", "code"),
    [
        (("record", "demonstration-1", "--folder", str(RECORDINGS), "--show"), 0),
        (("learn", "--help"), 0),
        (("serve", "--check", "--config", "süd-²-█.toml"), 1),
        (("sim", "--scene", "süd-²-█.toml"), 1),
        (("no-such-command-█",), 2),
    ],
)
@pytest.mark.one_case
def test_no_encoding_of_the_output_ends_in_a_traceback(
    command: tuple[str, ...], code: int, variables: dict[str, str]
) -> None:
    done = run(*command, **variables)
    assert "Traceback" not in done.stderr
    assert done.returncode == code, done.stderr


@pytest.mark.parametrize(
    ("text", "variable"),
    [
        ("from .pinocchio_pywrap_default import *", "PYTHONPATH"),
        ("raise ImportError('x.so', path='x.so')", "LD_LIBRARY_PATH"),
    ],
)
@pytest.mark.parametrize("command", [("serve",), ("serve", "--check"), ("arm", "service/arms/ur5.urdf")])
def test_a_module_of_another_python_is_one_sentence_with_file_and_variable(
    tmp_path: Path, command: tuple[str, ...], text: str, variable: str
) -> None:
    module = tmp_path / "pinocchio" / "__init__.py"
    module.parent.mkdir()
    module.write_text(text)
    own = command[0] == "serve"
    more = ("--listen", "tcp/127.0.0.1:0") if own else ("--output", str(tmp_path / "cell.toml"))
    before = f"import sys; sys.path.insert(0, {str(tmp_path)!r})" * (variable == "LD_LIBRARY_PATH")
    done = run(*command, *more, before=before, XDG_STATE_HOME=str(tmp_path), **{variable: str(tmp_path)})
    (sentence,) = [line for line in (done.stdout + done.stderr).splitlines() if "cannot be imported here" in line]
    assert done.returncode == 1
    assert f"${variable} leads to" in sentence
    assert ("x.so" if variable == "LD_LIBRARY_PATH" else str(module)) in sentence
    assert "Traceback" not in done.stderr


def test_the_folders_of_a_user_are_those_that_the_variables_name(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HOME", "/home/me")
    for kind, usual in (("cache", ".cache"), ("config", ".config"), ("state", ".local/state")):
        variable = f"XDG_{kind.upper()}_HOME"
        monkeypatch.setenv(variable, "/other")
        assert user_folder(kind) == Path("/other/thirdhand")  # type: ignore[arg-type]
        for given in ("", "relative"):
            monkeypatch.setenv(variable, given)
            assert user_folder(kind) == Path(f"/home/me/{usual}/thirdhand")  # type: ignore[arg-type]


def test_a_user_without_a_home_is_told_what_is_needed_and_gets_no_folder_named_tilde(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    check = ("serve", "--check", "--listen", "tcp/127.0.0.1:0")
    none = {"XDG_STATE_HOME": "", "XDG_CACHE_HOME": "", "XDG_CONFIG_HOME": ""}
    done = run(*check, before=WITHOUT_HOME, folder=tmp_path, **none)
    assert done.returncode == 1
    assert "this user has no home folder; $XDG_STATE_HOME or $HOME needed, or [files] state" in done.stdout
    done = run(*check, before=WITHOUT_HOME, folder=tmp_path, **none | {"XDG_STATE_HOME": str(tmp_path / "state")})
    assert done.returncode == 0, done.stdout
    assert f"{tmp_path}/state/thirdhand/thirdhand can be made" in done.stdout
    assert list(tmp_path.iterdir()) == []
    monkeypatch.setattr("pathlib.Path.home", lambda: (_ for _ in ()).throw(RuntimeError))
    monkeypatch.setenv("XDG_STATE_HOME", "")
    with pytest.raises(HomelessError):
        user_folder("state")
