"""Configuration of the site that `python -m sphinx docs out/site` builds of all pages here."""

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
smartquotes_action = "qe"  # quotes and ellipses; dashes would change the names of options
html_theme = "furo"
html_title = "thirdhand"
html_show_sphinx = False
html_copy_source = False

LINK = re.compile(r"(!?\[[^]]*\])\(([^)\s]+)\)")
# The navigation: four parts, each in the order to read it. Pages without a part are under "More".
GROUPS = {
    "Tutorials": ("first-demo", "tutorial", "first-tracker", "first-arm", "first-task"),
    "How to": (
        "install",
        "mouse",
        "headset",
        "camera",
        "calibrate",
        "clutch",
        "policies",
        "lerobot",
        "record-takes",
        "other-recordings",
        "arrays",
        "via-points",
        "correct",
        "pose",
        "unseen-hands",
        "hardware",
        "own-arm",
        "franka",
        "universal-robots",
        "ufactory",
        "wam",
        "ros2-control",
        "near-people",
        "rate",
        "tune",
        "look",
        "viewing",
        "reports",
        "recordings",
        "operate",
        "network",
        "access",
        "ros2",
        "coming-from",
        "CONTRIBUTING",
        "SECURITY",
    ),
    "Reference": (
        "command-line",
        "settings",
        "tuning",
        "wire",
        "status",
        "client",
        "gallery",
        "incidents",
        "faults",
        "glossary",
    ),
    "Explanation": (
        "how-it-works",
        "frames",
        "model",
        "learning",
        "safety",
        "bounds",
        "built-on",
        "timing",
        "experiments",
        "evidence",
    ),
}


def navigation() -> str:
    """The tables of contents of the pages that exist."""
    pages = {path.stem for path in HERE.glob("*.md")} - {"index"}
    named = {name for names in GROUPS.values() for name in names}
    groups = GROUPS | {"More": tuple(sorted(pages - named))}
    return "".join(
        f"\n```{{toctree}}\n:hidden:\n:caption: {caption}\n\n{lines}\n```\n"
        for caption, names in groups.items()
        if (lines := "\n".join(name for name in names if name in pages))
    )


def front() -> str:
    """The README, with its links as from this folder, the index one level deeper, and the
    navigation.
    """
    text = (HERE.parent / "README.md").read_text(encoding="utf-8")
    pages = re.sub("^#", "##", (HERE / "index.md").read_text(encoding="utf-8"), flags=re.MULTILINE)
    return LINK.sub(lambda link: f"{link[1]}({_from_here(link[2])})", text) + pages + navigation()


def _from_here(target: str) -> str:
    if re.match(r"[a-z]+:|#", target):
        return target
    return target.removeprefix("docs/") if target.startswith("docs/") else f"../{target}"


def prepare(app: Any, page: str, source: list[str]) -> None:
    """Change the source of a page before it is parsed. The front page is the README. A link to a
    folder, or to a page outside of this site, becomes a name.
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
