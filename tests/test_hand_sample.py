"""The path of one hand sample through the service is short, and documented correctly."""

from __future__ import annotations

import re
import subprocess
import sys

import pytest

from support.paths import ROOT


@pytest.fixture(scope="module")
def printed() -> list[str]:
    """The output of the program that follows one sample."""
    done = subprocess.run(
        [sys.executable, "-m", "tests.hand_sample"],
        capture_output=True,
        text=True,
        timeout=110,
        check=False,
        cwd=ROOT,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout.splitlines()


def test_a_hand_sample_enters_few_files_and_few_of_them_again(printed: list[str]) -> None:
    files, _, re_entries = map(int, re.findall(r"\d+", printed[-1]))
    assert files <= 27
    assert re_entries <= 35


def test_the_page_for_contributors_follows_it_file_by_file(printed: list[str]) -> None:
    page = (ROOT / "docs" / "CONTRIBUTING.md").read_text(encoding="utf-8")
    walk = page[page.index("<!-- walk -->") : page.index("<!-- /walk -->")]
    assert re.findall(r"`((?:service|kmp)/[\w/]+\.py)`", walk) == [
        line.split()[1] for line in printed[:-1]
    ]
