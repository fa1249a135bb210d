"""`thirdhand tune`: settings tried on the hands of a recording, and the lines to write."""

from __future__ import annotations

import argparse
import functools
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import msgspec

from thirdhand.cli.usage import UsageError, check_writable
from thirdhand.contract.printable import printable
from thirdhand.process.progress import progress, say
from thirdhand.recordings.shipped import cell_of
from thirdhand.settings.config import Settings
from thirdhand.skills.skill_file import skill_in
from thirdhand.workbench.cli.many_files import of_each
from thirdhand.workbench.cli.report_command import plain_console, print_table
from thirdhand.workbench.report.tables import NONE, Table
from thirdhand.workbench.report.variants import (
    CHANGES,
    JudgedHands,
    VariantFigures,
    best,
    pooled,
    toml,
    tried,
)
from thirdhand.workbench.takes.recorded_hands import recorded_hands


class Tuned(NamedTuple):
    """A file's hands, by side as in --json, and the figures of each variant on them."""

    path: Path
    settings: Settings
    remarks: tuple[str, ...]
    judged_s: float
    lasts_s: float
    hands: dict[str, dict[str, Any]]
    variants: list[VariantFigures]


def tune(args: argparse.Namespace) -> int:
    """Try settings on recorded hands; exit code 0 once the table is printed, 1 if a file cannot be
    judged.
    """
    if args.plot:
        check_writable(args.plot, ".png")
        if len(args.files) > 1:
            raise UsageError(f"--plot {args.plot}: the picture is of one file; {len(args.files)} given")
    if args.part and not args.part[0] < args.part[1]:
        raise UsageError(f"--part {args.part[0]:g} {args.part[1]:g}: two times [s], the first below the second, needed")
    settings = cell_of(args.config) if args.config else None
    part = tuple(args.part) if args.part else None
    work = functools.partial(_tuned, settings=settings, skill=args.skill, part=part)
    found = [one for _, one in of_each(args, "tuning", work, alone=functools.partial(_alone, work, args.plot))]
    for line in dict.fromkeys(line for one in found for line in one.remarks):
        say(line)
    if not found:
        return 1
    variants = pooled([(one.judged_s, one.variants) for one in found])
    chosen, reason = best(variants, *(one.settings for one in found))
    if args.json:
        outcome = {
            "variants": [one._asdict() | {"tracking": one.tracking._asdict()} for one in variants],
            "best": {"name": chosen.name, "change": chosen.change, "reason": reason, "toml": toml(chosen.change)},
        }
        files = [{"recording": str(one.path), "judged_s": one.judged_s, "hands": one.hands} for one in found]
        one_json = (files[0] if len(args.files) == 1 else {"recordings": files}) | outcome
        print(msgspec.json.format(msgspec.json.encode(one_json)).decode())
        return 0 if len(found) == len(args.files) else 1
    console = plain_console()
    for one in found:
        print(
            f"{printable(str(one.path))}: {one.judged_s:.1f} of {one.lasts_s:.1f} s are judged, in which the arm "
            "follows with the settings as recorded\nand the true hands are known. The arm is taken to move as "
            "commanded."
        )
        print_table(console, _hands_table(one))
    print_table(console, _variants_table(variants, len(found)))
    if any(one.rejected for one in variants):
        print_table(console, _rejected_table(variants))
    lines = f"Write into the cell's settings:\n\n{toml(chosen.change)}" if chosen.change else "Leave the settings."
    print(f"\n{lines}\n\nBecause {reason}.")
    if args.plot:
        print(f"picture {printable(str(args.plot))}")
    return 0 if len(found) == len(args.files) else 1


def _tuned(
    path: Path,
    *,
    settings: Settings | None,
    skill: str | None,
    part: tuple[float, float] | None,
    plot: Path | None = None,
    progress: Callable[[int], None] = lambda count: None,
) -> Tuned:
    """The figures of one file, which are also drawn to `plot`. Raises RecordingError."""
    hands = recorded_hands(path, settings=settings, skill=skill_in(Path(skill)) if skill else None, part=part)
    judged_hands = JudgedHands.of(hands)
    variants = tried(judged_hands, CHANGES, progress=progress)
    if plot:
        from thirdhand.workbench.report.variants_picture import draw  # its import is slow

        draw(judged_hands, variants, best(variants, hands.settings)[0], plot)
    lasts_s = (hands.ticks[-1].index - hands.ticks[0].index) * hands.period_s
    by_side = {
        side: {
            "rate_hz": hand.rate_hz,
            "samples": len(hand.times) + hand.untrusted,
            "untrusted": hand.untrusted,
            "noise_mm": hand.noise_mm,
            "tremor": tremor._asdict() if (tremor := hand.tremor()) else None,
        }
        for side, hand in judged_hands.truth.items()
    }
    return Tuned(path, hands.settings, hands.remarks, judged_hands.judged_s, lasts_s, by_side, variants)


def _alone(work: Callable[..., Tuned], plot: Path | None, path: Path) -> Tuned:
    with progress("tuning", unit="variants", total=len(CHANGES)) as done:
        return work(path, plot=plot, progress=done)


def _hands_table(one: Tuned) -> Table:
    rows = []
    for side, hand in one.hands.items():
        tremor = hand["tremor"]
        found = (f"{tremor['rate_hz']:.1f}", f"{tremor['amplitude_mm']:.2f}") if tremor else ("none", NONE)
        counts = str(hand["samples"]), str(hand["untrusted"])
        rows.append((side, f"{hand['rate_hz']:.0f}", *counts, f"{hand['noise_mm']:.2f}", *found))
    heads = ("hand", "rate [Hz]", "samples", "untrusted", "noise [mm]", "tremor [Hz]", "amplitude [mm]")
    return Table("hands", "Noise and tremor of the hands", heads, tuple(rows))


def _variants_table(variants: list[VariantFigures], count: int) -> Table:
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
    title = "Settings, and how the tool follows" + f", over {count} files" * (count > 1)
    return Table("variants", title, heads, tuple(rows))


def _rejected_table(variants: list[VariantFigures]) -> Table:
    """The rejected samples by cause, of the first variant and of those that differ from it."""
    causes = tuple(dict.fromkeys(cause for one in variants for cause in one.rejected))
    shown = [one for i, one in enumerate(variants) if i == 0 or one.rejected != variants[0].rejected]
    rows = tuple((one.name, *(str(one.rejected.get(cause, 0)) for cause in causes)) for one in shown)
    return Table("rejected", "Rejected samples by cause; other settings reject the same", ("settings", *causes), rows)
