"""`thirdhand play`, `replay` and `learn`."""

from __future__ import annotations

import argparse
import functools
import sys
import time
from collections import Counter
from collections.abc import Mapping
from pathlib import Path

import msgspec

from kmp import AffineMean
from thirdhand.cli.usage import UsageError, check_writable, reached, via_points_in
from thirdhand.client import Client, Tracker
from thirdhand.contract.explain import ExplainedError
from thirdhand.contract.printable import printable, printable_lines
from thirdhand.contract.requests import Status
from thirdhand.core.skill.tuning import UNSURE_M
from thirdhand.process.progress import progress, say, steps
from thirdhand.recordings.mcap_file import ends_early
from thirdhand.recordings.recording import Recording
from thirdhand.recordings.replay import replay as replayed
from thirdhand.recordings.shipped import cell_of
from thirdhand.settings.config import Settings
from thirdhand.settings.whole_file import whole
from thirdhand.skills.demonstration import Demonstration
from thirdhand.skills.residual_risk import LONGEST_ACCEPTER, OPTION
from thirdhand.skills.skill_file import StoredSkill, skill_in, unusable_name
from thirdhand.skills.stored_demonstrations import stored_demonstrations
from thirdhand.workbench.cli.many_files import of_each
from thirdhand.workbench.learning.learn import learn as learned
from thirdhand.workbench.learning.picture import draw
from thirdhand.workbench.learning.records import Evidence, Figures
from thirdhand.workbench.learning.table import table
from thirdhand.workbench.learning.takes import check_count
from thirdhand.workbench.takes.demonstration_reader import hand_samples, read_demonstration
from thirdhand.workbench.takes.led_wishes import calibrated_wishes
from thirdhand.workbench.takes.pose_streams import TRACK_NAMES, PoseTopic

# options of `learn` that wishes have no use for
OF_SKILLS = {
    "refined": "--from",
    "plot": "--plot",
    "delay": "--delay",
    "via_points": "--via-points",
    "config": "--config",
    "accept_residual_risk": OPTION,
}
COUNTED_WITHIN_S = 1.0  # the daemon's status must show the last poses within this time


def play(args: argparse.Namespace) -> int:
    """Publish the hands of a recording; exit code 0 once all are published."""
    hands = hand_samples(args.file, say=say)
    start_ns = hands[0][0]
    last_ns = hands[-1][0]
    if ends_early(args.file):
        print(f"{args.file} was cut: its end is missing, the rest is played", file=sys.stderr)
    with reached(args, None) as session, Tracker(session, args.cell) as tracker:
        client = Client(session, args.cell)
        print(
            f"{len(hands)} hand poses over {(last_ns - start_ns) / 1e9:.1f} s from {args.file}",
            file=sys.stderr,
        )
        while True:
            before = client.wait_until_ready(timeout_s=None)
            begin = time.monotonic()
            for time_ns, side, pose in hands:
                early = begin + (time_ns - start_ns) / 1e9 / args.speed - time.monotonic()
                if early > 0:
                    time.sleep(early)
                # Without a stamp, the pose gets the present time, as from a tracker.
                tracker.publish(side, pose.position, pose.orientation, frame_id=pose.frame_id)
            print(_arrived(client, before, Counter(side for _, side, _ in hands)), file=sys.stderr)
            if not args.loop:
                return 0


def _arrived(client: Client, before: Status, played: Mapping[str, int]) -> str:
    """A message with the numbers of played poses that the daemon's loop counted.

    Raises ExplainedError if it counted none of a hand.
    """
    until = time.monotonic() + COUNTED_WITHIN_S
    while True:
        now = client.status()
        came = {
            side: now.received.get(f"hands/{side}", 0) - before.received.get(f"hands/{side}", 0)
            for side in played
        }
        if all(came[side] >= played[side] for side in played) or time.monotonic() > until:
            break
        time.sleep(0.1)
    counts = ", ".join(
        f"{max(0, came[side])} of {played[side]} of the {side} hand" for side in played
    )
    refused = {cause: now.rejected[cause] - before.rejected.get(cause, 0) for cause in now.rejected}
    if any(came[side] <= 0 for side in played):
        raise ExplainedError(f"the daemon received {counts}: was it restarted, or is it stalled?")
    causes = ", ".join(f"{count} {cause}" for cause, count in refused.items() if count > 0)
    return f"the daemon's loop received {counts}" + f"; rejected meanwhile: {causes}" * bool(causes)


def replay(args: argparse.Namespace) -> int:
    """Replay recordings; exit code 0 if all frames are within tolerance, or with `--exact` complete
    and identical.
    """
    if args.each:
        return _replay_each(args)
    if args.workers:
        raise UsageError(
            "--workers: --each needed with it, since recordings that follow each other are one "
            "replay"
        )
    if args.output:
        check_writable(args.output, ".mcap")
    counts = [Recording.open(path).ticks() for path in args.files]
    total = None if None in counts or args.after is not None else sum(filter(None, counts))
    with progress("replaying", total=total) as done:
        result = replayed(*args.files, after=args.after, progress=done, output=args.output)
    print(result.text())
    return 0 if result.passes(exact=args.exact) else 1


def _replay_each(args: argparse.Namespace) -> int:
    """Replay recordings that do not follow each other; exit code 0 if each passes."""
    if args.output:
        raise UsageError("--output writes the frames of one recording: without --each")
    results = of_each(args, "replaying", functools.partial(replayed, after=args.after))
    for path, result in results:
        print(printable_lines(f"{path}: " + result.text().replace("\n", "\n  ")))
    passing = sum(result.passes(exact=args.exact) for _, result in results)
    print(
        f"{passing} of {len(args.files)} recordings replay "
        f"{'exactly' if args.exact else 'within tolerance'}"
    )
    return 0 if passing == len(args.files) else 1


def learn(args: argparse.Namespace) -> int:
    """Learn a skill; exit code 0 once it is written. An unsafe skill is not written."""
    accepted_by = (args.accept_residual_risk or "").strip()
    name = args.output.stem if args.name is None else args.name
    _check_outputs(args, name, accepted_by)
    if args.wishes:
        return _learn_wishes(args, name)
    names = [path.stem for path in args.demonstrations]
    if args.demonstrations[0].exists():  # else its reader reports the missing file
        check_count(names)
    if refined := skill_in(args.refined) if args.refined else None:
        stored_demonstrations(refined)  # raises its errors before the new ones are read
    settings = cell_of(str(args.config)) if args.config else None
    demonstrations = _demonstrations(args, settings)
    evidence: list[Evidence] = []
    with steps("learning") as doing:
        skill = learned(
            demonstrations,
            name=name,
            names=names,
            delay_s=args.delay,
            workers=args.workers or "1",
            reach=settings.reach if settings else None,
            accepted_by=accepted_by,
            refined=refined,
            progress=doing,
            show=evidence.append,
        )
    figures = evidence[0].figures
    # the error lists what is unsafe
    print(printable_lines(table(msgspec.structs.replace(figures, unsafe=()))))
    if args.plot:
        draw(evidence[0], args.plot)
    if figures.unsafe:
        raise ExplainedError(f"{args.output} was not written: {'; '.join(figures.unsafe)}")
    with whole(args.output) as part:
        part.write_bytes(skill.file)
    _report_written(args.output, skill, figures)
    return 0


def _learn_wishes(args: argparse.Namespace, name: str) -> int:
    """Calibrate a policy's wishes; exit code 0 once the stand-in skill is written."""
    given = [option for option in OF_SKILLS if getattr(args, option) is not None]
    if given:
        raise UsageError(f"--wishes: without {', '.join(OF_SKILLS[option] for option in given)}")
    found = calibrated_wishes(args.demonstrations, name)
    with whole(args.output) as part:
        part.write_bytes(found.skill.file)
    print(
        f"the wishes are {1000 * found.rms_m:.1f} mm (rms) from the tool as it was led, in "
        f"{100 * found.wrong:.1f} % of the frames more than {1000 * UNSURE_M:.0f} mm\n"
        f"of the errors, {100 * found.held_before:.0f} % are within the policy's own 95 % region, "
        f"and {100 * found.held:.0f} % within the one that the other recordings lead to\n"
        f"{args.output}: name it as `[files] skill` of a cell with `[skill] source = "
        '"tool/wish"`'
    )
    return 0


def _check_outputs(args: argparse.Namespace, name: str, accepted_by: str) -> None:
    """Raise UsageError for files that cannot be written and names that cannot be used."""
    check_writable(args.output, ".npz")
    if args.plot:
        check_writable(args.plot, ".png")
    if len(accepted_by) > LONGEST_ACCEPTER:
        raise UsageError(
            f"{OPTION}: a name of {len(accepted_by)} characters; up to {LONGEST_ACCEPTER} accepted"
        )
    if lacking := unusable_name(name):
        raise UsageError(f"--{lacking}")


def _demonstrations(args: argparse.Namespace, settings: Settings | None) -> list[Demonstration]:
    """The demonstrations in the files; those without via-points get the ones of the arguments."""
    topics = {name: PoseTopic.parsed(text) for name in TRACK_NAMES if (text := getattr(args, name))}
    via_points = via_points_in(args.via_points) if args.via_points else ()
    demonstrations = []
    for i, path in enumerate(args.demonstrations, start=1):
        demonstration = read_demonstration(path, topics=topics, settings=settings, say=say)
        count = len(demonstration.stamps_ns)
        lasts_s = demonstration.period_s * count
        print(
            f"{i} of {len(args.demonstrations)}: {path}, {count} samples over {lasts_s:.1f} s",
            file=sys.stderr,
        )
        demonstrations.append(
            demonstration
            if demonstration.via_points
            else demonstration._replace(via_points=via_points)
        )
    return demonstrations


def _report_written(path: Path, skill: StoredSkill, figures: Figures) -> None:
    """Print the size of a skill in a file, its gate, and who accepts its residual risk."""
    primitive = skill.model.primitive
    over = " over a mean that is linear in the hands" * isinstance(primitive.prior_mean, AffineMean)
    print(
        f"{path}: {len(primitive.inputs)} reference points{over}; it holds as "
        f"far_from_demonstrations where {skill.model.measure} is above "
        f"{1000 * skill.threshold:.0f} mm"
    )
    if figures.residual:
        print(
            f"its residual risk is accepted by {printable(figures.accepted_by)}"
            if figures.accepted_by
            else "it is not served until somebody accepts its residual risk, named above: learn it "
            f"again with {OPTION} NAME",
            file=sys.stderr,
        )
