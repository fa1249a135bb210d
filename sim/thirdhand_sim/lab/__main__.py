"""`python -m thirdhand_sim.lab NAME --output DIR`: makes an experiment, or all that are stale;
`python -m thirdhand_sim.lab stale` lists these.
"""

from __future__ import annotations

from thirdhand.process import one_blas_thread  # noqa: F401

# isort: split
import argparse
import importlib
import os
import sys
import time
import traceback
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from types import ModuleType

from thirdhand.cli.usage import workers as workers_of
from thirdhand.contract.explain import ExplainedError, in_words
from thirdhand_sim.faulty_cell import FaultError
from thirdhand_sim.lab.catalogue import EXPERIMENTS, overlap
from thirdhand_sim.lab.evidence import RESULTS, commit, origin, result_of, staleness, tree
from thirdhand_sim.lab.results import ExperimentError, Options, Results, pyplot
from thirdhand_sim.parts import PartError

OF_OTHERS = "-of-others"  # suffix of the names of results on recorded hands
FAILURES = (ExplainedError, ExperimentError, FaultError, PartError, OSError)
EXAMPLE = """example:
  python -m thirdhand_sim.lab letters --output results
  python -m thirdhand_sim.lab stale --output results
  python -m thirdhand_sim.lab all --output results
"""


FOLDERS = {
    "letters": "recorded letters besides the modelled ones: X.npz with demo00, demo01, ...",
    "hands": (
        "recorded hands for `motion`, and `people --set tuning`: .npz files with time_s, left and "
        "right [m]"
    ),
    "data": "recorded takes for `partners`, without which it measures the made tasks alone: "
    "robot_*.npz, give_P*.npz and walk_*.npz with t [s], left, right and tool [m]",
}


def parser() -> argparse.ArgumentParser:
    """The command line."""
    recorded = {name: " (recorded hands)" * name.endswith(OF_OTHERS) for name in EXPERIMENTS}
    names = "\n".join(
        f"  {name:<16} {experiment.about}{recorded[name]}"
        for name, experiment in EXPERIMENTS.items()
    )
    p = argparse.ArgumentParser(
        prog="python -m thirdhand_sim.lab",
        description="The experiments of the paper, and beyond it: figures, a JSON of the numbers, "
        f"and a Rerun recording each.\n\n{names}",
        epilog=EXAMPLE,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    name_help = (
        "one of the above; all: those whose results in DIR are missing or stale; stale: list these"
    )
    p.add_argument("name", metavar="NAME", choices=[*EXPERIMENTS, "all", "stale"], help=name_help)
    output = "folder of the results (for stale: recordings/experiments by default)"
    p.add_argument("--output", metavar="DIR", type=Path, help=output)
    for name, text in FOLDERS.items():
        p.add_argument(f"--{name}", metavar="DIR", type=Path, help=text)
    people = (
        "the people of `people`: those on whom parameters are chosen, or the others (default: "
        "%(default)s)"
    )
    p.add_argument("--set", choices=["tuning", "test"], default="test", help=people)
    workers = "processes, or the cluster at dask:ADDRESS, where that helps (default: %(default)s)"
    p.add_argument(
        "--workers", type=workers_of, default=str(min(2, os.cpu_count() or 1)), help=workers
    )
    share = "of the full size, for a quick look: above 0, up to 1"
    p.add_argument("--share", metavar="X", type=float, default=1.0, help=share)
    offset = (
        "added to the numbers of the people, scenes and hands of the evaluation, to repeat an "
        "experiment with other seeds: with the size of its streams, all are new (default: 0)"
    )
    p.add_argument("--seed-offset", metavar="N", type=int, default=0, help=offset)
    arm = "of `faults` and `motion`: wam, franka, ur5 or FILE.toml (default: %(default)s)"
    p.add_argument("--arm", default="wam", help=arm)
    redraw_help = "draw the figures of the numbers in DIR/NAME.json again, without measuring anew"
    p.add_argument("--redraw", action="store_true", help=redraw_help)
    p.add_argument(
        "--anew", action="store_true", help="with all: make those that are not stale, too"
    )
    p.add_argument("--quiet", action="store_true", help="no progress on standard error")
    return p


def jobs(name: str, options: Options) -> dict[str, Options]:
    """The results of a name on the command line, with the options that each uses."""
    names = [name] if name in EXPERIMENTS else [*EXPERIMENTS]
    if options.hands is None and name == "all":
        names.remove("motion" + OF_OTHERS)
    if options.hands is not None and name == "motion":
        names = [name + OF_OTHERS]
    if options.seed_offset and name not in EXPERIMENTS:
        names = [job for job in names if EXPERIMENTS[job].seeds.evaluation]
    tuning = {"people"} if options.group == "tuning" else set()
    return {
        job: options if job.endswith(OF_OTHERS) or job in tuning else replace(options, hands=None)
        for job in names
    }


def redraw(results: Results, experiment: ModuleType) -> None:
    """Draw an experiment's figures again from the numbers in its JSON.

    Raises ExperimentError if its figures show more than its numbers.
    """
    if not hasattr(experiment, "draw_numbers"):
        raise ExperimentError(
            f"the figures of {results.name} show more than its numbers: run it without --redraw"
        )
    experiment.draw_numbers(results, results.measured())


def make(results: Results, experiment: ModuleType, options: Options) -> None:
    """Run an experiment and write its result. Raises one of FAILURES."""
    earlier_options = (result_of(results.folder, results.name) or {}).get("options", {})
    for option, value in earlier_options.items():
        if isinstance(value, dict) and getattr(options, option) is None:
            raise ExperimentError(
                f"the result in {results.folder} is of recordings: name them by --{option} DIR "
                "again"
            )
    began = time.monotonic()
    results.origin = origin(results.name, options)
    results.say(EXPERIMENTS[results.name].about)
    numbers = experiment.run(results, options)
    if (now := commit()) != results.origin["commit"]:
        # the source tree was changed meanwhile
        results.origin["commit"] += f" to {now}"
    print(f"{results.numbers(numbers)}  {time.monotonic() - began:.0f} s", flush=True)


def main(arguments: list[str] | None = None) -> int:
    """Run the command; exit code 0, 1 if an experiment failed, 2 on bad usage."""
    p = parser()
    args = p.parse_args(arguments)
    if not 0 < args.share <= 1:
        p.error(f"--share {args.share}: above 0, up to 1 accepted")
    if args.name.endswith(OF_OTHERS) and args.hands is None and not args.redraw:
        p.error(f"{args.name}: a folder of recorded hands is missing: --hands DIR")
    if args.name != "stale" and args.output is None:
        p.error("--output DIR is missing: the folder for the results")
    options = Options(
        args.letters,
        args.hands,
        args.data,
        args.set,
        args.workers,
        args.share,
        args.seed_offset,
        args.arm,
    )
    selected = jobs(args.name, options)
    if args.seed_offset and (why := no_offset(selected, options, args.output)):
        p.error(f"--seed-offset {args.seed_offset}: {why}")
    try:
        if args.name == "stale":
            return stale(args.output or RESULTS, selected)
        # reports a missing package now, not after an hour
        pyplot()
        return int(sum(made(name, job_options, args) for name, job_options in selected.items()) > 0)
    except FAILURES as error:
        print(f"python -m thirdhand_sim.lab: {in_words(error)}", file=sys.stderr)
        return 1


def no_offset(names: Iterable[str], options: Options, folder: Path | None) -> str:
    """The reason why results in a folder cannot have the options' seed offset, or ""."""
    if folder is not None and folder.resolve() == RESULTS:
        return f"{folder} holds the results of this project: choose another folder"
    if options.seed_offset < 0:
        return "0 or more accepted"
    if options.group == "tuning":
        return "moves the evaluation, and --set tuning has none"
    for name in names:
        if not EXPERIMENTS[name].seeds.evaluation:
            return f"{name} has no random evaluation"
        if used := overlap(name, options.seed_offset):
            return f"{name} would be evaluated on seeds of tuning or learning: {used}"
    return ""


def made(name: str, options: Options, args: argparse.Namespace) -> int:
    """Make one result, or draw it again, unless it is up to date; returns the exit code."""
    try:
        only_stale = args.name == "all" and not args.anew and not args.redraw
        if only_stale and not staleness(name, result_of(args.output, name), tree(), options):
            print(f"{args.output / name}.json  belongs to this tree", flush=True)
            return 0
        results = Results(args.output, name, said=not args.quiet)
        experiment = importlib.import_module(f"thirdhand_sim.lab.{EXPERIMENTS[name].module}")
        redraw(results, experiment) if args.redraw else make(results, experiment, options)
    except Exception as error:
        explanation = (
            f"{in_words(error)}\n" if isinstance(error, FAILURES) else traceback.format_exc()
        )
        sys.stderr.write(f"python -m thirdhand_sim.lab: {name}: {explanation}")
        return 1
    return 0


def stale(folder: Path, wanted: dict[str, Options]) -> int:
    """List the results in a folder that do not belong to this source tree; returns the exit
    code.
    """
    reasons = {
        name: staleness(name, result_of(folder, name), tree(), options)
        for name, options in wanted.items()
    }
    for name, why in reasons.items():
        if why:
            print(f"{name:<16} {why}")
    print(f"{sum(map(bool, reasons.values()))} of {len(reasons)} results in {folder} are stale")
    return 0


if __name__ == "__main__":
    sys.exit(main())
