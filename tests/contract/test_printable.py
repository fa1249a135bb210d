"""Text from files and the network has no effect where it is shown: in the terminal, the log, the
viewer, the report and the web page.
"""

from __future__ import annotations

import logging
from pathlib import Path

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from support.wicked import WICKED
from thirdhand.cli.serve import PrintableFormatter
from thirdhand.client import RefusedError, decoded
from thirdhand.command_line import main
from thirdhand.contract.printable import printable, printable_lines
from thirdhand.contract.requests import Status
from thirdhand.skills.skill_file import SkillError


@given(st.text())
def test_any_text_becomes_one_printable_line_and_stays_so(text: str) -> None:
    cleaned = printable(text)
    assert cleaned.isprintable()
    assert printable(cleaned) == cleaned
    assert cleaned == text or not text.isprintable()
    assert all(line.isprintable() for line in printable_lines(text).split("\n"))


def test_errors_logs_and_replies_quote_without_effects(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert str(SkillError(f"no array {WICKED}")) == "\n".join(
        map(printable, f"no array {WICKED}".splitlines())
    )
    record = logging.LogRecord("", logging.INFO, "", 0, WICKED, (), None)
    assert "\x1b" not in PrintableFormatter("%(message)s").format(record)
    assert main(["replay", str(tmp_path / "no\x1b[31m such.mcap")]) == 1
    error = capsys.readouterr().err
    assert r"no\x1b[31m such.mcap" in error
    assert "\x1b" not in error
    for data in (b"[", b"{}", b'"\\u001b"', b"[" * 100_000, b"\xff"):
        with pytest.raises(RefusedError, match="not a Status"):
            decoded(data, Status)
    assert decoded(msgspec.json.encode({"a": WICKED}), dict) == {"a": printable(WICKED)}
