"""The options of `thirdhand record`."""

from __future__ import annotations

import argparse
from pathlib import Path

from thirdhand.cli.usage import ARM_HELP, flag, option, within

ABOUT_RECORD = (
    "Records a demonstration of hands and tool from a running cell, called a take, and summarizes "
    "it. Also lists, shows, trims and deletes takes. The pose of the tool is taken from tool/pose "
    "or, if nothing publishes that, is computed from the arm's joints/state and its URDF."
)
RECORD_EXAMPLE = """thirdhand record take-1
  thirdhand record take-1 --hands left
  thirdhand record take-2 --person Ada
  thirdhand record take-1 --trim 0.3 9
  thirdhand record --list"""


def add_options(c: argparse.ArgumentParser) -> None:
    """Add the command's own options."""
    option(c, "name", "NAME", "the name of the take", nargs="?")
    option(
        c,
        "--folder",
        "DIR",
        "the folder of the takes; it is made if missing",
        Path("demonstrations"),
    )
    option(c, "--config", "CELL", f"the settings that the daemon runs with: {ARM_HELP}")
    hands = (
        "the hands that lead the tool; if it is one, only that one is recorded and the skill "
        "ignores the other"
    )
    option(c, "--hands", None, hands, "both", choices=("both", "left", "right"))
    person = (
        "the person who demonstrates; with two or more people, `learn` holds out all takes of a "
        "person together"
    )
    option(c, "--person", "NAME", person)
    begin = (
        "begin the take at Enter, and store that: for a timetable, which `thirdhand begin` begins"
    )
    flag(c, "--begin", begin)
    until = (
        "end the take by a key (Enter or Ctrl-C), or also once hands and tool rest after they "
        "moved: all stay within 15 mm, joints within 0.02 rad (of the rest before and after, 0.3 s "
        "are then retained)"
    )
    option(c, "--until", None, until, "key", choices=("key", "rest"))
    stillness = (
        "with --until rest, they must rest this long; slower motion than 15 mm in this time counts "
        "as rest"
    )
    option(c, "--rest", "S", stillness, 1.0, type=within(float, 0.2, 60, " s"))
    seconds = within(float, 1, 3600, " s")
    option(c, "--seconds", "S", "end the take after this time at the latest", 600.0, type=seconds)
    wait = within(float, 0, 3600, " s")
    option(c, "--wait", "S", "wait this long for hands and tool to be published", 30.0, type=wait)
    listen = (
        "listen on this Zenoh endpoint, so that tracker and arm can connect while no daemon runs"
    )
    option(c, "--listen", "EP", listen)
    via_points = (
        "the via-points of the task in this take, as JSON that `via-points add --file` reads"
    )
    option(c, "--via-points", "FILE", via_points)
    option(c, "--plot", "FILE", "draw the take to this .png file")
    instead = c.add_mutually_exclusive_group()
    flag(instead, "--list", "list the takes, and record none")
    flag(instead, "--show", "show the take of this name, and record none")
    instead.add_argument(
        "--trim",
        metavar=("FROM", "TO"),
        nargs=2,
        type=float,
        help=(
            "cut the take of this name to these seconds; the uncut take is kept beside it as "
            "NAME.mcap.uncut"
        ),
    )
    flag(instead, "--delete", "delete the take of this name and its .uncut file")
