"""The options of `thirdhand record`."""

from __future__ import annotations

import argparse
from pathlib import Path

ABOUT = (
    "Records a demonstration of hands and tool from a running cell, and shows what it got; lists, shows, trims and "
    "deletes those that are there. The tool is what is published as tool/pose, else it is found from the arm's "
    "joints/state by its URDF."
)
EXAMPLE = """thirdhand record take-1
  thirdhand record take-1 --trim 0.3 9
  thirdhand record --list"""


def add_options(c: argparse.ArgumentParser) -> None:
    """Adds the command's own options."""
    c.add_argument("name", metavar="NAME", nargs="?", help="of the take")
    c.add_argument(
        "--folder",
        metavar="DIR",
        type=Path,
        default=Path("demonstrations"),
        help="where takes are, made if missing (default: %(default)s)",
    )
    c.add_argument("--config", metavar="FILE", type=Path, help="the cell's settings, the same as the daemon's")
    c.add_argument(
        "--until",
        choices=("key", "rest"),
        default="key",
        help="it ends with Enter or Ctrl-C, or also once hands and tool rest after they moved: all stay within 15 mm, "
        "joints within 0.02 rad (rest before and after is then left out but for 0.3 s) (default: %(default)s)",
    )
    c.add_argument(
        "--rest",
        metavar="S",
        type=float,
        default=1.0,
        help="for so long; slow motion, of less than 15 mm in that time, is rest too (default: %(default)g)",
    )
    c.add_argument("--seconds", metavar="S", type=float, default=600.0, help="it lasts at most (default: %(default)g)")
    c.add_argument(
        "--wait", metavar="S", type=float, default=30.0, help="for hands and tool to be heard (default: %(default)g)"
    )
    c.add_argument(
        "--listen",
        metavar="EP",
        help="Zenoh endpoint to listen on instead, for tracker and arm to connect to while no daemon runs",
    )
    c.add_argument(
        "--places",
        metavar="FILE",
        type=Path,
        help="where the things of the task lie in this take, by name: JSON as `via-points add --file` takes it",
    )
    c.add_argument("--plot", metavar="FILE", type=Path, help="a picture of the take, .png")
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
