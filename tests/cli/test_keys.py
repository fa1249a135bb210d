"""The Enter key of commands that are started with and without standard input."""

from __future__ import annotations

import os

import pytest

from support.cell_commands import python

WAITS = (
    "from thirdhand.workbench.cli.keys import EnterPressed; p = EnterPressed(); print(p(), "
    "p.listens, p(), p.listens)"
)
INPUTS = {
    "closed": "False False False False",
    "empty": "False False False False",
    "a line": "True True False False",
}


@pytest.mark.parametrize("given", INPUTS)
def test_enter_is_heard_only_where_there_is_an_input(given: str) -> None:
    """No command waits for Enter."""
    closes = (lambda: os.close(0)) if given == "closed" else None
    done = python(WAITS, input="\n" if given == "a line" else "", preexec_fn=closes)
    assert (done.stdout.strip(), done.stderr) == (INPUTS[given], "")
