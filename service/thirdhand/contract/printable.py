"""Safe display of texts from files and from the network.

A name may hold anything: line breaks, escape sequences that move a terminal's cursor, characters
that reverse the direction of what follows. Each reader of a file or of the network passes texts
through here, so that terminal, log, viewer, report and web page show them as one line without
effects. Where a text becomes HTML or Markdown it is escaped for that language as well.
"""

from __future__ import annotations

import re
from typing import Any

CLEAR = "\r\x1b[K"  # clears the line of a terminal, which was written without an end
_MARKDOWN = re.compile(r"[\\`*_\[\]<>|#&!~$]")


def printable(text: str) -> str:
    r"""The text on one line, with characters that cannot be printed as escapes: `\n`, `\x1b`,
    `\u202e`. The result is a fixed point: applying this twice changes nothing more.
    """
    if text.isprintable():
        return text
    return "".join(
        character if character.isprintable() else character.encode("unicode_escape").decode()
        for character in text
    )


def printable_lines(text: str) -> str:
    """A message with several lines, each made printable."""
    return "\n".join(map(printable, text.splitlines()))


def as_markdown(text: str) -> str:
    """A printable text escaped for Markdown, without emphasis, links or HTML."""
    return _MARKDOWN.sub(r"\\\g<0>", printable(text))


def printable_values(value: Any) -> Any:
    """A value from JSON with each text made printable, keys included."""
    match value:
        case str():
            return printable(value)
        case list():
            return [printable_values(item) for item in value]
        case dict():
            return {printable_values(key): printable_values(item) for key, item in value.items()}
        case _:
            return value
