"""`python -m sim.experiments NAME --output DIR`: makes an experiment, or all of them."""

from __future__ import annotations

from service import one_blas_thread  # noqa: F401

# isort: split
import argparse
import importlib
import os
import sys
import time
from pathlib import Path
from types import ModuleType

from service.contract.explain import ExplainedError, in_words
from sim.experiments.results import ExperimentError, Options, Results, pyplot
from sim.faulty_cell import FaultError
from sim.parts import PartError

ABOUT = {
    "hands": "the soldering task through the running service: as learned, and adapted to new places (Figures 4 and 5)",
    "statistics": "100 random scenes whose places are taught, side by side with rivals, some without any demonstration",
    "people": "learned skills on modelled people who did not demonstrate, beside seven rivals told the same places",
    "partners": "learned skills on recordings of real third hands, and on made tasks that are not soldering",
    "motion": "how the tool follows hands that move as people's do: error, lag, smoothness, stops, beside rivals",
    "separation": "how near the arm comes to hands and how fast, in random scenes and with hands thrust in its way",
    "faults": "what happens when service, tracker, network, router, scribe or disk fail: time to rest, way, loss",
    "letters": "adaptation of handwritten letters (Figure 1)",
    "promp": "KMP beside ProMP on the same letters (Figure 2), and what each costs as the input's dimension grows",
    "correlation": "correlations learned from a reward by policy improvement, with a via-point kept (Figure 3)",
    "runs": "ten runs of that search with one letter and one via-point (Figure 3(c))",
    "table": "DMP, ProMP, mixture regression and KMP on the same letters (Table I)",
    "phase": "hands that pause and go back pause and reverse the robot",
    "orientation": "the tool turns the glass to the eyes: orientation predicted with the position, and followed",
    "demonstrations": "error against the number of demonstrations",
}
EXAMPLE = """example:
  python -m sim.experiments letters --output results
  python -m sim.experiments all --output results
"""


def parser() -> argparse.ArgumentParser:
    """The command line."""
    names = "\n".join(f"  {name:<15} {about}" for name, about in ABOUT.items())
    p = argparse.ArgumentParser(
        prog="python -m sim.experiments",
        description="The experiments of the paper, and beyond it: figures, a JSON of the numbers, and a Rerun "
        f"recording each.\n\n{names}",
        epilog=EXAMPLE,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    p.add_argument("name", metavar="NAME", choices=[*ABOUT, "all"], help="one of the above, or all")
    p.add_argument("--output", metavar="DIR", type=Path, required=True, help="folder for the results; made if missing")
    p.add_argument(
        "--letters",
        metavar="DIR",
        type=Path,
        help="recorded letters to use besides the shipped model's: X.npz with demo00, demo01, ...",
    )
    p.add_argument(
        "--hands",
        metavar="DIR",
        type=Path,
        help="recorded hands for `motion`, and `people --set tuning`: .npz files with time_s, left and right [m]",
    )
    p.add_argument(
        "--data",
        metavar="DIR",
        type=Path,
        help="recorded takes for `partners`, without which it does the made tasks alone: robot_*.npz, give_P*.npz and "
        "walk_*.npz with t [s], left, right and tool [m]",
    )
    p.add_argument(
        "--set",
        choices=["tuning", "test"],
        default="test",
        help="the people of `people`: those on whom parameters are chosen, or those on whom nothing was "
        "(default: %(default)s)",
    )
    p.add_argument(
        "--workers",
        metavar="N",
        type=int,
        default=min(2, os.cpu_count() or 1),
        help="processes, where that helps (default: %(default)s)",
    )
    p.add_argument(
        "--share", metavar="X", type=float, default=1.0, help="of the full size, for a quick look: above 0, up to 1"
    )
    p.add_argument(
        "--arm", default="wam", help="of `faults` and `motion`: wam, franka, ur5 or FILE.toml (default: %(default)s)"
    )
    p.add_argument(
        "--redraw",
        action="store_true",
        help="draw the figures of the numbers in DIR/NAME.json again, without measuring anew",
    )
    p.add_argument("--quiet", action="store_true", help="no progress on standard error")
    return p


def redraw(results: Results, experiment: ModuleType) -> None:
    """Draws an experiment's figures of the numbers in its JSON again.

    Raises ExperimentError if its figures show more than its numbers.
    """
    if not hasattr(experiment, "draw_numbers"):
        raise ExperimentError(f"the figures of {results.name} show more than its numbers: run it without --redraw")
    experiment.draw_numbers(results, results.measured())


def main(arguments: list[str] | None = None) -> int:
    """The exit code: 0, 1 on failure, 2 on bad usage."""
    p = parser()
    args = p.parse_args(arguments)
    if not 0 < args.share <= 1:
        p.error(f"--share {args.share}: above 0, up to 1 accepted")
    if args.workers < 1:
        p.error(f"--workers {args.workers}: 1 or more accepted")
    options = Options(args.letters, args.hands, args.data, args.set, args.workers, args.share, args.arm)
    try:
        pyplot()  # what is missing is said now, not after an hour
        for name in ABOUT if args.name == "all" else [args.name]:
            began = time.monotonic()
            results = Results(args.output, name, said=not args.quiet)
            results.say(ABOUT[name])
            experiment = importlib.import_module(f"sim.experiments.{name}")
            if args.redraw:
                redraw(results, experiment)
                continue
            numbers = experiment.run(results, options)
            print(f"{results.numbers(numbers)}  {time.monotonic() - began:.0f} s", flush=True)
    except (ExplainedError, ExperimentError, FaultError, PartError, OSError) as error:
        print(f"python -m sim.experiments: {in_words(error)}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
