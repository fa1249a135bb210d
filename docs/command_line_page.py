"""`python docs/command_line_page.py` writes command-line.md: every command with its options, as its
parser declares them.
"""

from __future__ import annotations

import argparse
import re
import textwrap
from collections.abc import Iterator
from pathlib import Path

import thirdhand_sim.__main__
from thirdhand import command_line as main

PAGE = Path(__file__).with_name("command-line.md")
REACH = "how the daemon is reached"  # title of the group of options that most commands share
HEAD = """# The command line

<!-- Written by `python docs/command_line_page.py` from service/thirdhand/command_line.py: change it there. -->

`thirdhand COMMAND --help` prints the same. [Incidents](incidents.md#exit-codes) lists exit codes.

| to | commands |
|---|---|
"""
SHARED = """
## Reach the daemon

Each value is taken from the option, else from the environment variable, else from
`~/.config/thirdhand/client.toml` ([networks](network.md#set-the-address-once)).

"""


def page() -> str:
    """The text of the page."""
    top = main.parser()
    commands = _subparsers(top) | {"sim": thirdhand_sim.__main__.parser()}
    parts = [HEAD]
    for title, names in main.GROUPS.items():
        parts.append(
            f"| {title} | {', '.join(f'[`{name}`](#thirdhand-{name})' for name in names)} |\n"
        )
    parts.append(SHARED + _table(_group(commands["status"], REACH)))
    for names in main.GROUPS.values():
        for name in names:
            parts += _command(f"thirdhand {name}", commands[name], "##")
    return "".join(parts)


def _subparsers(parser: argparse.ArgumentParser) -> dict[str, argparse.ArgumentParser]:
    """The commands below a parser, by their names."""
    kind = argparse._SubParsersAction  # noqa: SLF001
    actions = [action for action in parser._actions if isinstance(action, kind)]  # noqa: SLF001
    return {name: found for action in actions for name, found in action.choices.items()}


def _group(parser: argparse.ArgumentParser, title: str) -> list[argparse.Action]:
    """The options of a group of a parser."""
    groups = parser._action_groups  # noqa: SLF001
    return [action for group in groups if group.title == title for action in group._group_actions]  # noqa: SLF001


def _command(name: str, parser: argparse.ArgumentParser, heading: str) -> Iterator[str]:
    """A command's heading, description, options and examples; then the commands below it."""
    about = " ".join((parser.description or "").split())
    yield f"\n{heading} {name}\n\n{textwrap.fill(_sentence(about), 100)}\n"
    below = _subparsers(parser)
    reach = _group(parser, REACH)
    own = [
        action
        for action in parser._actions  # noqa: SLF001
        if action not in reach
        and action.help is not argparse.SUPPRESS
        and not isinstance(action, argparse._HelpAction | argparse._SubParsersAction)  # noqa: SLF001
    ]
    if own:
        yield f"\n{_table(own)}"
    if reach:
        yield "\nAlso: [options to reach the daemon](#reach-the-daemon).\n"
    if example := re.sub(r"^examples?:\n", "", parser.epilog or ""):
        yield f"\n```console\n{textwrap.dedent(example).strip()}\n```\n"
    for word, found in below.items():
        yield from _command(f"{name} {word}", found, heading + "#")


def _table(actions: list[argparse.Action]) -> str:
    """The table of some options and arguments."""
    rows = (f"| {_called(action)} | {_meaning(action)} |\n" for action in actions)
    return "| option | meaning |\n|---|---|\n" + "".join(rows)


def _called(action: argparse.Action) -> str:
    """An option with its value as one writes it, or an argument."""
    value = action.metavar or (
        f"{{{','.join(map(str, action.choices))}}}" if action.choices else action.dest.upper()
    )
    value = " ".join(value) if isinstance(value, tuple) else value
    if not action.option_strings:
        return f"`{value}{' ...' * (action.nargs in ('+', '*'))}`"
    takes = "" if action.nargs == 0 else f" [{value}]" if action.nargs == "?" else f" {value}"
    return ", ".join(f"`{name}{takes}`" for name in action.option_strings)


def _meaning(action: argparse.Action) -> str:
    """The help text of an option, with its default."""
    text = " ".join(
        (action.help or "").replace("%(default)s", str(action.default)).replace("%%", "%").split()
    )
    if action.required and action.option_strings:
        text += " (required)"
    return re.sub(r"(<\w+>[/\w]*)", r"`\1`", text).replace("|", "\\|")


def _sentence(text: str) -> str:
    """A text that begins with a capital letter and ends with a stop."""
    return text[:1].upper() + text[1:] + "." * (not text.endswith("."))


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
