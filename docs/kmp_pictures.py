"""`python docs/kmp_pictures.py` draws the pictures of kmp/README.md and coming-from.md.

They show the values of the pages' own blocks of code.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import matplotlib as mpl

mpl.use("Agg")

from matplotlib import pyplot as plt

HERE = Path(__file__).parent
DPI = 80


def values_of(page: Path, last: str) -> dict[str, Any]:
    """The names that a page's blocks of code make, up to the block that holds `last`."""
    names: dict[str, Any] = {}
    for block in re.findall(r"```python\n(.*?)```", page.read_text(encoding="utf-8"), re.DOTALL):
        exec(block, names)
        if last in block:
            break
    return names


def main() -> None:
    """Writes the pictures beside this file."""
    tutorial = values_of(HERE.parent / "kmp" / "README.md", "over_time = ")
    tutorial["over_time"][0].figure.savefig(HERE / "kmp-over-time.png", dpi=DPI)
    tutorial["above"].figure.savefig(HERE / "kmp-plane.png", dpi=DPI)
    page = values_of(HERE / "coming-from.md", "through = ")
    axes = page["skill"].plot(label="as learned")
    page["through"].plot(axes=axes, label="through the via-point")
    axes[0].figure.savefig(HERE / "kmp-coming-from.png", dpi=DPI)
    plt.close("all")


if __name__ == "__main__":
    main()
