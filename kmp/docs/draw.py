"""`python kmp/docs/draw.py` draws the pictures of the gallery and writes its page."""

import ast
import io
import runpy
import sys
import textwrap
import warnings
from pathlib import Path

import matplotlib as mpl
from matplotlib import pyplot as plt
from PIL import Image

HERE = Path(__file__).parent
SCRIPTS = [
    HERE / "gallery" / f"{name}.py"
    for name in (
        "first_letter",
        "via_point",
        "moved_goal",
        "velocity",
        "uncertainty",
        "gains",
        "reach",
        "rhythm",
        "orientation",
        "local_frames",
        "superposition",
        "constraints",
        "two_hands",
    )
]
DPI = 110
COLOURS = 64
LOOK = {"axes.spines.top": False, "axes.spines.right": False, "font.size": 9}
HEAD = """# Gallery

<!-- Written by `python kmp/docs/draw.py` from the scripts: change it there. -->

Each picture is drawn by a script of 20 to 30 lines, with Matplotlib. The demonstrations of most are
those of [letters.py](gallery/letters.py): five times the letter S, by a pen in centimetres.
"""


def caption(script: Path) -> str:
    """The sentence that begins a script."""
    text = ast.get_docstring(ast.parse(script.read_text(encoding="utf-8"))) or ""
    return " ".join(text.split())


def picture(script: Path) -> bytes:
    """The PNG that a script draws."""
    with mpl.rc_context(LOOK), warnings.catch_warnings():
        warnings.filterwarnings("ignore", "FigureCanvasAgg is non-interactive")
        runpy.run_path(str(script))
        whole = io.BytesIO()
        plt.savefig(whole, dpi=DPI)
        plt.close("all")
    file = io.BytesIO()
    colours = Image.open(whole).convert("RGB").quantize(COLOURS, dither=Image.Dither.NONE)
    colours.save(file, "PNG", optimize=True)
    return file.getvalue()


def page() -> str:
    """The page of the gallery."""
    parts = [
        f"\n## {script.stem.replace('_', ' ').capitalize()}\n\n"
        f"![{script.stem.replace('_', ' ')}](pictures/{script.stem}.png)\n\n"
        + textwrap.fill(f"{caption(script)} [{script.name}](gallery/{script.name})", 100)
        + "\n"
        for script in SCRIPTS
    ]
    return HEAD + "".join(parts)


def main() -> None:
    """Write pictures and page beside this file."""
    for script in SCRIPTS:
        (HERE / "pictures" / f"{script.stem}.png").write_bytes(picture(script))
    (HERE / "gallery.md").write_text(page(), encoding="utf-8")


mpl.use("Agg")
sys.path.append(str(HERE / "gallery"))  # the scripts import letters.py beside them
if __name__ == "__main__":
    main()
