"""The options of `thirdhand calibrate`."""

from __future__ import annotations

import argparse
from pathlib import Path

from thirdhand.cli.usage import flag, option, within
from thirdhand.contract.records import SIDES

ABOUT_CALIBRATE = (
    "Finds where the tracker is, from a hand that holds the tool while you lead the arm by hand, "
    "or that touches points. Shows how accurate the result is, and writes it into the cell's "
    "settings."
)
CALIBRATE_EXAMPLE = """thirdhand calibrate --config cell.toml
  thirdhand calibrate --config cell.toml --held --check
  thirdhand calibrate --hand right --at .6 -.2 0 --at .6 .2 0 --at .9 0 0 --at .8 .1 .15
  thirdhand calibrate --config cell.toml --from led.mcap"""
MAX_ACCEPTED_MM = 200.0
METRES = within(float, -5, 5, " m")  # reads a coordinate of a point to touch


def add_options(c: argparse.ArgumentParser) -> None:
    """Add the command's own options."""
    config = (
        "the settings that the daemon runs with: a FILE.toml of one cell, which is changed (the "
        "earlier one is kept), or wam, franka or ur5"
    )
    option(c, "--config", "CELL", config)
    how = c.add_mutually_exclusive_group()
    flag(how, "--held", "the hand holds the tool while you lead the arm (the default)")
    point = (
        "instead, the tracked point of the hand touches this point, in frame base [m], then Enter; "
        "four or more points"
    )
    how.add_argument(
        "--at", metavar=("X", "Y", "Z"), nargs=3, type=METRES, action="append", help=point
    )
    check = (
        "measure for 10 s how far the hand is from where it should be while it holds the tool; "
        "with --held, after the calibration, else by the last one"
    )
    flag(c, "--check", check)
    hand = "the hand that holds or touches (default: the only one that arrives)"
    option(c, "--hand", None, hand, choices=SIDES)
    recording = "use this recording of hands and joint states, instead of a running cell"
    option(c, "--from", "FILE", recording, dest="recording", type=Path)
    accept = "accept this standard deviation of a mapped position at the corners of the bench"
    option(c, "--accept", "MM", accept, 10.0, type=within(float, 0.1, MAX_ACCEPTED_MM, " mm"))
    option(
        c,
        "--seconds",
        "S",
        "lead the tool for this time at most",
        120.0,
        type=within(float, 5, 3600, " s"),
    )
    option(
        c,
        "--wait",
        "S",
        "wait this long for hands and arm to be published",
        30.0,
        type=within(float, 0, 3600, " s"),
    )
    listen = (
        "listen on this Zenoh endpoint, so that tracker and arm can connect while no daemon runs"
    )
    option(c, "--listen", "EP", listen)
