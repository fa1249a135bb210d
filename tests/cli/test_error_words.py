"""Errors of commands about files name the file and the value, in words, without names of code."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

import pytest

from support.cell import thirdhand, told
from support.paths import RECORDINGS
from thirdhand.contract.explain import in_file

INTERNAL = re.compile(
    r"\$[.:\[]|\[Errno|os error|codec|Traceback|object at "
    r"0x|\b(?:OS|Type|Value|Key|Validation)Error"
)
DEMONSTRATIONS = [str(RECORDINGS / f"demonstration-{number}.mcap") for number in (1, 2)]
TAKES: dict[str, tuple[str, ...]] = {  # commands, and the file that each of them reads last
    "configuration": ("serve", "--config"),
    "arm of the bench": ("sim", "--arm"),
    "URDF": ("arm",),
    "scene": ("sim", "--scene"),
    "via-points of a take": ("record", "a", "--connect", "tcp/127.0.0.1:1", "--via-points"),
    "via-points": ("learn", *DEMONSTRATIONS, "--output", "skill.npz", "--via-points"),
    "skill": ("serve", "--listen", "tcp/127.0.0.1:0", "--skill"),
    "recording": ("report",),
    "played": ("play", "--connect", "tcp/127.0.0.1:1"),
    "replayed": ("replay",),
    "drawing": ("view", "--screenshot", "a.png"),
}
WRONG: dict[str, Callable[[Path], object]] = {
    "missing": lambda path: None,
    "a folder": lambda path: path.mkdir(),
    "a link to itself": lambda path: path.symlink_to(path.name),
    "no text": lambda path: path.write_bytes(b"\xff\xfe\x00a = 1\n"),
    "unknown value": lambda path: path.write_text("a = 1\n"),
    "wrong kind": lambda path: path.write_text('rate_hz = "x"\nhandover = [1]\nseed = "x"\n'),
    "wrong JSON": lambda path: path.write_text('{"op": "add", "points": [{"name": 3}]}'),
}


@pytest.mark.parametrize("wrong", WRONG)
@pytest.mark.parametrize("takes", TAKES)
def test_a_file_that_cannot_be_used_is_reported_in_words(
    takes: str, wrong: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.chdir(tmp_path)
    suffix = {
        "configuration": ".toml",
        "arm of the bench": ".toml",
        "skill": ".npz",
        "drawing": ".rrd",
    }
    is_recording = takes in ("recording", "played", "replayed")
    path = tmp_path / f"given{suffix.get(takes, '.mcap' if is_recording else '')}"
    WRONG[wrong](path)
    # other commands leave no process behind, and run in this one
    run = thirdhand if takes in ("skill", "arm of the bench", "scene") else told
    done = run(*TAKES[takes], str(path))
    assert done.returncode in (1, 2), done.stdout
    assert not INTERNAL.search(done.stderr), done.stderr
    assert path.name in done.stderr or "tcp/127.0.0.1:1" in done.stderr, done.stderr
    if wrong == "a link to itself":
        assert "Too many levels of symbolic links" in done.stderr


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("$.arm.urdf: missing", "[arm] urdf: missing"),
        ("$.points[0].left: 2 numbers, 3 needed", "points, entry 1, left: 2 numbers, 3 needed"),
        ("$: unknown field 'a'", "unknown field 'a'"),
        ("a\n$.rate_hz: 3 given", "a\nrate_hz: 3 given"),
        ("$.sources[...].rate: 'x' given", "sources, an entry, rate: 'x' given"),
        ("$.cell: '$.tool.radius' given", "cell: '$.tool.radius' given"),
        ('the URDF\'s "$.a" and $.b.c', 'the URDF\'s "$.a" and [b] c'),
        ("$XDG_CONFIG_HOME/x and ${y} cost 3 $.", "$XDG_CONFIG_HOME/x and ${y} cost 3 $."),
    ],
)
def test_path_in_json_is_named_as_in_a_file(text: str, words: str) -> None:
    """A path in JSON is named as in a TOML file, except inside quoted values."""
    assert in_file(text) == words
    assert in_file(words) == words
