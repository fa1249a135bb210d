"""The options of `thirdhand record`."""

from __future__ import annotations

import argparse
from pathlib import Path

from service.cli.usage import ARM, option

ABOUT = (
    "Records a demonstration of hands and tool from a running cell, and shows what it got; lists, shows, trims and "
    "deletes those that are there. The tool is what is published as tool/pose, else it is found from the arm's "
    "joints/state by its URDF."
)
EXAMPLE = """thirdhand record take-1
  thirdhand record take-1 --hands left
  thirdhand record take-2 --person Ada
  thirdhand record take-1 --trim 0.3 9
  thirdhand record --list"""


def add_options(c: argparse.ArgumentParser) -> None:
    """Adds the command's own options."""
    option(c, "name", "NAME", "of the take", nargs="?")
    option(c, "--folder", "DIR", "where takes are, made if missing", Path("demonstrations"))
    option(c, "--config", "CELL", f"the daemon's settings: {ARM}")
    hands = "that conduct the tool: of one, only it is recorded, and what is learned heeds no other"
    option(c, "--hands", None, hands, "both", choices=("both", "left", "right"))
    person = "who demonstrates; of two or more, `learn` leaves out all takes of one at once"
    option(c, "--person", "WHO", person)
    until = (
        "it ends with Enter or Ctrl-C, or also once hands and tool rest after they moved: all stay within 15 mm, "
        "joints within 0.02 rad (rest before and after is then left out but for 0.3 s)"
    )
    option(c, "--until", None, until, "key", choices=("key", "rest"))
    rest = "for so long; slow motion, of less than 15 mm in that time, is rest too"
    option(c, "--rest", "S", rest, 1.0)
    option(c, "--seconds", "S", "it lasts at most", 600.0)
    option(c, "--wait", "S", "for hands and tool to be heard", 30.0)
    listen = "Zenoh endpoint to listen on instead, for tracker and arm to connect to while no daemon runs"
    option(c, "--listen", "EP", listen)
    places = "where the things of the task lie in this take, by name: JSON as `via-points add --file` takes it"
    option(c, "--places", "FILE", places)
    option(c, "--plot", "FILE", "a picture of the take, .png")
    instead = c.add_mutually_exclusive_group()
    instead.add_argument("--list", action="store_true", help="the takes that are there, instead")
    instead.add_argument("--show", action="store_true", help="a take that is there, instead")
    instead.add_argument(
        "--trim",
        metavar=("FROM", "TO"),
        nargs=2,
        type=float,
        help="cut a take to these seconds, instead; as it was it stays beside it as NAME.mcap.uncut",
    )
    instead.add_argument("--delete", action="store_true", help="a take that is there, and its .uncut, instead")
