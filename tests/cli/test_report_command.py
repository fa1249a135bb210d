"""`thirdhand report` of one recording and of two: on the terminal, as a page and as files."""

from __future__ import annotations

import csv
import re
import xml.etree.ElementTree as ET
from pathlib import Path

import pytest

from support.recorded import frames_of
from thirdhand.command_line import main
from thirdhand.settings import palette


def rows(path: Path) -> list[list[str]]:
    with path.open(encoding="utf-8", newline="") as file:
        return list(csv.reader(file))


@pytest.mark.thorough
def test_two_recordings_are_compared_on_a_page(
    tmp_path: Path, golden: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Two recordings stand side by side on a page and in files."""
    page = tmp_path / "report.html"
    folder = tmp_path / "tables"
    assert (
        main(["report", str(golden), str(golden), "--html", str(page), "--csv", str(folder)]) == 0
    )
    output = capsys.readouterr().out
    for words in (
        "Nothing is missing in it.",
        "hold: stale_hand",
        "Side by side",
        "difference",
        "same",
    ):
        assert words in output
    assert "Settings, versions" not in output  # the same file twice has no differences

    verdict = output.splitlines()[0]
    counted = r"It followed 9\d % of 20\.0 s, from 0\.\d s on, with 4 holds and no faults"
    assert re.fullmatch(
        rf"{counted}; the worst was hold: far_from_demonstrations, for 0\.8 s from 13\.3 s on\.",
        verdict,
    )

    text = page.read_text(encoding="utf-8")
    assert verdict in text
    for axis in (
        "distance [cm]",
        "error, deviation [mm]",
        "speed [m/s]",
        "time since the first tick [s]",
        ">0.1<",
    ):
        assert axis in text
    assert text.count("<svg") == text.count("</svg>") == 4
    for drawn in re.findall(r"<svg.*?</svg>", text, flags=re.DOTALL):
        assert ET.fromstring(drawn) is not None
    fetched = re.findall(r"""(?:src|href|url)\s*[=(]\s*["']?([^"')\s>]+)""", text)
    assert [url for url in fetched if not url.startswith("#")] == []
    assert "far_from_demonstrations" in text
    # the viewer's colours
    for colour in (palette.LEFT, palette.RIGHT, palette.TOOL, *palette.BY_MODE.values()):
        assert palette.written(colour) in text

    assert {path.name for path in folder.iterdir()} == {"golden", "golden-2", "comparison.csv"}
    comparison = rows(folder / "comparison.csv")
    assert comparison[0] == ["figure", "golden", "golden-2", "difference"]
    assert {row[3] for row in comparison[1:]} <= {"same", "-"}
    modes = rows(folder / "golden" / "modes.csv")
    assert modes[0] == ["from [s]", "for [s]", "mode", "why"]
    assert float(modes[-1][0]) + float(modes[-1][1]) == pytest.approx(20.03, abs=0.02)

    heads, *ticks = rows(folder / "golden" / "ticks.csv")
    frames = frames_of(golden)
    assert len(ticks) == len(frames)
    row = dict(zip(heads, ticks[5000], strict=True))
    assert int(row["tick"]) == int(frames[5000]["tick"])
    assert float(row["tool[2]"]) == pytest.approx(float(frames[5000]["tool"][2]), rel=1e-6)


def test_many_recordings_have_a_row_each_and_totals(
    tmp_path: Path, golden: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Many recordings have a row each and totals by cell and week."""
    files = [tmp_path / f"thirdhand-20261128-1200{number:02}.mcap" for number in range(12)]
    for file in files:
        file.symlink_to(golden)
    page = tmp_path / "report.html"
    folder = tmp_path / "tables"
    assert main(["report", *map(str, files), "--html", str(page), "--csv", str(folder)]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) < 30
    for file in files:
        assert sum(file.stem in line for line in lines) == 1
        assert page.read_text(encoding="utf-8").count(f"<td>{file.stem}</td>") == 1
    figures = rows(folder / "figures.csv")
    assert [row[0] for row in figures[1:]] == list(map(str, files))
    assert len(rows(folder / "recordings.csv")) == 13
    heads, total = rows(folder / "totals.csv")
    totals = dict(zip(heads, total, strict=True))
    assert totals["recordings [1]"] == "12"
    first_row = dict(zip(figures[0], figures[1], strict=True))
    held_s = 12 * float(first_row["hold: far_from_demonstrations [s]"])
    found_s = float(re.search(r"far_from_demonstrations ([\d.]+) s", totals["holds"])[1])  # type: ignore[index]
    assert found_s == pytest.approx(held_s, abs=12 * 0.05)
    assert float(totals["followed [%]"]) == pytest.approx(
        100 * float(first_row["follow [s]"]) / float(first_row["duration [s]"]), abs=1
    )
