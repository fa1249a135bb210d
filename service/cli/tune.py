"""`thirdhand tune`: settings tried on the hands of a recording, and the lines to write."""

from __future__ import annotations

import argparse
import math
from pathlib import Path

import msgspec

from service.cli.report_command import plain_console, print_table
from service.cli.usage import UsageError, check_writable
from service.contract.printable import printable
from service.files.recorded_hands import recorded_hands
from service.files.shipped import cell_of
from service.learning.skill_file import skill_in
from service.process.progress import progress, say, steps
from service.report.tables import NONE, Table
from service.report.variants import CHANGES, JudgedHands, VariantFigures, best, toml, tried


def tune(args: argparse.Namespace) -> int:
    """Try settings on recorded hands; exit code 0 once the table is printed."""
    if args.plot:
        check_writable(args.plot, ".png")
    if args.part and not args.part[0] < args.part[1]:
        raise UsageError(f"--part {args.part[0]:g} {args.part[1]:g}: two times [s], the first below the second, needed")
    settings = cell_of(args.config) if args.config else None
    part = tuple(args.part) if args.part else None
    hands = recorded_hands(
        args.file, settings=settings, skill=skill_in(Path(args.skill)) if args.skill else None, part=part
    )
    for line in hands.remarks:
        say(line)
    with steps("tuning") as doing:
        doing("estimating the true hands")
        judged_hands = JudgedHands.of(hands)
    with progress("tuning", unit="variants", total=len(CHANGES)) as done:
        variants = tried(judged_hands, CHANGES, progress=done)
    chosen, reason = best(variants, hands.settings)
    if args.plot:
        from service.report.variants_picture import draw  # its import is slow

        draw(judged_hands, variants, chosen, args.plot)
    if args.json:
        print(msgspec.json.format(msgspec.json.encode(_as_json(judged_hands, variants, chosen, reason))).decode())
        return 0
    console = plain_console()
    lasts_s = (hands.ticks[-1].index - hands.ticks[0].index) * hands.period_s
    print(
        f"{printable(str(hands.path))}: {judged_hands.judged_s:.1f} of {lasts_s:.1f} s are judged, in which the arm "
        "follows with the settings as recorded\nand the true hands are known. The arm is taken to move as commanded."
    )
    print_table(console, _hands_table(judged_hands))
    print_table(console, _variants_table(variants))
    if any(one.rejected for one in variants):
        print_table(console, _rejected_table(variants))
    lines = f"Write into the cell's settings:\n\n{toml(chosen.change)}" if chosen.change else "Leave the settings."
    print(f"\n{lines}\n\nBecause {reason}.")
    if args.plot:
        print(f"picture {printable(str(args.plot))}")
    return 0


def _hands_table(judged_hands: JudgedHands) -> Table:
    rows = []
    for side, hand in judged_hands.truth.items():
        tremor = hand.tremor()
        found = (f"{tremor.rate_hz:.1f}", f"{tremor.amplitude_mm:.2f}") if tremor else ("none", NONE)
        counts = str(len(hand.times) + hand.untrusted), str(hand.untrusted)
        rows.append((side, f"{hand.rate_hz:.0f}", *counts, f"{hand.noise_mm:.2f}", *found))
    heads = ("hand", "rate [Hz]", "samples", "untrusted", "noise [mm]", "tremor [Hz]", "amplitude [mm]")
    return Table("hands", "Noise and tremor of the hands", heads, tuple(rows))


def _variants_table(variants: list[VariantFigures]) -> Table:
    rows = []
    for one in variants:
        seen = one.tracking
        numbers = (seen.error_mm, 1), (seen.error_p95_mm, 1), (seen.lag_ms, 0), (seen.jerk, 1), (seen.overshoot_mm, 1)
        texts = (NONE if math.isnan(value) else f"{value:.{digits}f}" for value, digits in numbers)
        rejected = str(sum(one.rejected.values()))
        rows.append((one.name, *texts, f"{one.not_following_s:.1f}", rejected))
    heads = (
        "settings",
        "error [mm]",
        "95 % [mm]",
        "lag [ms]",
        "jerk [m/s³]",
        "overshoot [mm]",
        "holds [s]",
        "rejected",
    )
    return Table("variants", "Settings, and how the tool follows", heads, tuple(rows))


def _rejected_table(variants: list[VariantFigures]) -> Table:
    """The rejected samples by cause, of the first variant and of those that differ from it."""
    causes = tuple(dict.fromkeys(cause for one in variants for cause in one.rejected))
    shown = [one for i, one in enumerate(variants) if i == 0 or one.rejected != variants[0].rejected]
    rows = tuple((one.name, *(str(one.rejected.get(cause, 0)) for cause in causes)) for one in shown)
    return Table("rejected", "Rejected samples by cause; other settings reject the same", ("settings", *causes), rows)


def _as_json(judged_hands: JudgedHands, variants: list[VariantFigures], chosen: VariantFigures, reason: str) -> object:
    return {
        "recording": str(judged_hands.hands.path),
        "judged_s": judged_hands.judged_s,
        "hands": {
            side: {
                "rate_hz": hand.rate_hz,
                "samples": len(hand.times) + hand.untrusted,
                "untrusted": hand.untrusted,
                "noise_mm": hand.noise_mm,
                "tremor": tremor._asdict() if (tremor := hand.tremor()) else None,
            }
            for side, hand in judged_hands.truth.items()
        },
        "variants": [one._asdict() | {"tracking": one.tracking._asdict()} for one in variants],
        "best": {"name": chosen.name, "change": chosen.change, "reason": reason, "toml": toml(chosen.change)},
    }
