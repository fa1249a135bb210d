"""The documentation as a site, of all pages in this folder: `python -m sphinx docs out/site`."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

HERE = Path(__file__).parent

project = "thirdhand"
author = copyright = "the thirdhand authors"  # noqa: A001  (Sphinx calls it so)
extensions = ["myst_parser"]
source_suffix = {".md": "markdown"}
myst_heading_anchors = 3
html_theme = "furo"
html_title = "thirdhand"
html_show_sphinx = False
html_copy_source = False

LINK = re.compile(r"(!?\[[^]]*\])\(([^)\s]+)\)")
# The order of the navigation; pages that are named nowhere come last, under "More".
GROUPS = {
    "How to": (
        "install",
        "tutorial",
        "places",
        "pose",
        "recordings",
        "arrays",
        "reports",
        "viewing",
        "hardware",
        "network",
        "ros2",
        "access",
        "coming-from",
    ),
    "Reference": ("settings", "wire", "status", "incidents", "library", "glossary"),
    "Background": ("how-it-works", "learning", "faults", "bounds", "timing", "experiments", "evidence"),
}


def navigation() -> str:
    """The tables of contents of the pages that are there."""
    there = {path.stem for path in HERE.glob("*.md")} - {"index"}
    named = {name for names in GROUPS.values() for name in names}
    groups = GROUPS | {"More": tuple(sorted(there - named))}
    return "".join(
        f"\n```{{toctree}}\n:hidden:\n:caption: {caption}\n\n{lines}\n```\n"
        for caption, names in groups.items()
        if (lines := "\n".join(name for name in names if name in there))
    )


def front() -> str:
    """The README, with its links as from this folder, and the navigation."""
    text = (HERE.parent / "README.md").read_text(encoding="utf-8")
    return LINK.sub(lambda link: f"{link[1]}({_from_here(link[2])})", text) + navigation()


def _from_here(target: str) -> str:
    if re.match(r"[a-z]+:|#", target):
        return target
    return target.removeprefix("docs/") if target.startswith("docs/") else f"../{target}"


def prepare(app: Any, page: str, source: list[str]) -> None:
    """As each page is read: the front page is the README, and what a link within the project leads
    to but no site holds, folders and pages that are not in this one, is named instead.
    """
    text = front() if page == "index" else source[0]
    source[0] = LINK.sub(_named_if_outside, text)


def _named_if_outside(link: re.Match[str]) -> str:
    target = link[2].partition("#")[0]
    path = (HERE / target).resolve()
    if target.startswith("../") and path.exists() and (path.is_dir() or path.suffix == ".md"):
        return f"{link[1].strip('[]')} (`{path.relative_to(HERE.parent)}`)"
    return link[0]


def setup(app: Any) -> None:
    """Called by Sphinx."""
    app.connect("source-read", prepare)
