"""Configuration of the site of kmp: `python -m sphinx kmp/docs out/kmp` builds it."""

project = "kmp"
author = copyright = "the thirdhand authors"  # noqa: A001  (Sphinx calls it so)
extensions = ["myst_parser"]
source_suffix = {".md": "markdown"}
myst_heading_anchors = 3
smartquotes_action = "qe"  # quotes and ellipses, not dashes
html_theme = "furo"
html_title = "kmp"
html_show_sphinx = False
html_copy_source = False
