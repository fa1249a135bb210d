"""The options of `thirdhand via-points add`."""

from __future__ import annotations

import argparse

from service.cli.usage import option
from service.contract.records import SIDES
from service.contract.requests import TOLERANCE_M, ViaPoint


def add_options(c: argparse.ArgumentParser) -> None:
    """Adds the options that define the via-point."""
    for hand in ("left", "right", "tool"):
        c.add_argument(f"--{hand}", nargs=3, type=float, metavar=("X", "Y", "Z"), help="position [m] in frame base")
    c.add_argument("--here", action="store_true", help="hands and tool as they are, once they hold still")
    defaults = ViaPoint("defaults", (0, 0, 0), (0, 0, 0), (0, 0, 0))
    option(c, "--std", "M", "how exactly the tool is to go there [m]", defaults.std)
    option(c, "--radius", "M", "also for hands this far from there [m]", defaults.radius)
    sides = ("none", *SIDES)
    option(c, "--follow", None, "within the radius the tool moves with this hand", "none", choices=sides)
    turn = "how the tool is turned there"
    c.add_argument("--orientation", nargs=4, type=float, metavar=("X", "Y", "Z", "W"), help=turn)
    c.add_argument("--gripper", choices=("open", "closed"), help="what the gripper does there")
    option(c, "--tolerance", "M", f"points learned nearer than this give way (default: {TOLERANCE_M} m)")
    option(c, "--file", "FILE", "a request as JSON instead; - is standard input")
