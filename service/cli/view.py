"""`thirdhand view`: a recording drawn into a Rerun file, the Rerun viewer opened on it, or a
picture taken without a screen.
"""

from __future__ import annotations

import argparse
import importlib.util
import os
import subprocess
import sys
import tempfile
import time as clock
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from service.cli.clients import ask
from service.cli.progress import progress
from service.cli.usage import UsageError, free_port
from service.contract.explain import ExplainedError
from service.recorder.recording import Recording
from service.recorder.sinks import Viewer, ViewerError
from service.recorder.steps import Gap


def view(args: argparse.Namespace) -> int:
    """The viewer's exit code once it is closed; 0 once a picture is written."""
    if args.file == "live":
        url = ask(args, "status")["scribe"].get("live")
        if not url:
            raise UsageError("this daemon serves no live view; start it with --live PORT")
        return _show(url, args)
    path = Path(args.file)
    if not path.exists():
        raise ExplainedError(f"no such file: {path}")
    if path.suffix == ".rrd":
        return _show(str(path), args)
    with tempfile.TemporaryDirectory() as folder:
        drawn = Path(folder) / f"{path.stem}.rrd"
        with progress(f"drawing {path.name}", total=Recording.open(path).ticks()) as done:
            convert(path, drawn, say=lambda line: print(line, file=sys.stderr, flush=True), progress=done)
        return _show(str(drawn), args)


def _show(source: str, args: argparse.Namespace) -> int:
    if args.screenshot:
        screenshot(source, args.screenshot, time=args.time)
        print(args.screenshot)
        return 0
    return int(show(source))


def convert(
    recording_path: str | Path,
    rrd_path: str | Path,
    *,
    say: Callable[[str], None] = lambda line: None,
    progress: Callable[[int], None] = lambda ticks: None,
) -> int:
    """The number of ticks of a recording drawn into a Rerun file.

    What the recording lacks is told to `say`, and shown in the log where it is missing; all else is
    drawn. Raises RecordingError and ViewerError.
    """
    recording = Recording.open(recording_path)
    with tempfile.TemporaryDirectory() as folder:
        urdf = Path(folder) / "arm.urdf"
        urdf.write_text(recording.urdf, encoding="utf-8")
        viewer = Viewer(urdf=urdf, settings=recording.settings, rrd=Path(rrd_path))
        notes = recording.notes("requests", "log")
        note = next(notes, None)
        count, time_ns, last = 0, 0, None
        gaps: list[Gap] = []
        unshown = 0
        for step in recording.steps():
            if step.lost or step.damage:
                gaps.append(Gap(last, step.tick, step.lost, step.damage))
            last = step.tick
            if step.frame is None:
                continue
            time_ns = step.time_ns
            for gap in gaps[unshown:]:
                viewer.log(str(gap), "WARN", time_ns)
            unshown = len(gaps)
            while note is not None and note[2] <= time_ns:
                viewer.log(note[1], "INFO" if note[0] == "requests" else "WARN", note[2])
                note = next(notes, None)
            viewer.add(step.frame, time_ns, step.timing)
            count += 1
            progress(count)
        missing = [*map(str, gaps), *recording.unsaid(gaps, last=last)]
        for text in missing[unshown:]:
            viewer.log(text, "WARN", time_ns)
        viewer.close()
    for text in missing:
        say(text)
    if missing:
        say(f"{count} ticks are there and shown")
    if viewer.problems:
        raise ViewerError("; ".join(viewer.problems))
    return count


def screenshot(source: str | Path, png: str | Path, *, time: float | None = None) -> None:
    """Saves a picture of a Rerun file or live view, `time` [s] after its start or at its end.

    Raises ViewerError.
    """
    from rerun.experimental import ViewerClient

    if "://" not in str(source) and not Path(source).is_file():
        raise ViewerError(f"nothing to picture: there is no {source}")
    if "://" not in str(source):
        with Path(source).open("rb") as file:
            if file.read(4) != b"RRF2":
                raise ViewerError(f"nothing to picture: {source} is not an .rrd file")
    os.environ.setdefault("RUST_LOG", "error")  # or its remarks cover the picture
    os.environ.setdefault("XDG_RUNTIME_DIR", tempfile.gettempdir())  # or its graphics library complains
    try:
        with ViewerClient.spawn(
            headless=True, port=free_port(), hide_welcome_screen=True, executable_path=str(executable())
        ) as client:
            client.open(str(source if "://" in str(source) else Path(source).absolute()))
            _wait(lambda: _extent(client) is not None and ("://" in str(source) or not client.get_state().loading))
            extent = _extent(client)
            if extent is None:
                raise ViewerError(f"no picture of {source}: it holds nothing yet")
            start, end = extent
            at = end if time is None else min(end, start + round(time * 1e9))
            if time is None and "://" in str(source):
                client.set_time("time", play_state="following")
            else:
                client.set_time("time", timestamp=np.datetime64(at, "ns"), play_state="paused")
            _settled(client, Path(png).absolute())
    except ViewerError:
        raise
    except (RuntimeError, ConnectionError, TimeoutError, OSError) as error:
        hint = "drawing without a screen needs a Vulkan driver: on Debian, apt install mesa-vulkan-drivers"
        raise ViewerError(f"no picture of {source}: {error} ({hint})") from error


def show(source: str | Path) -> int:
    """The exit code of the Rerun viewer, opened on a file or a live view, once its window is
    closed.
    """
    if sys.platform.startswith("linux") and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        raise ViewerError("there is no screen to open the viewer on; --screenshot PNG makes a picture without one")
    return subprocess.run([executable(), "--bind", "127.0.0.1", str(source)], check=False).returncode


def _extent(client: Any) -> tuple[int, int] | None:
    """Start and end [ns] of what is loaded, None before there is anything."""
    lines = [line for recording in client.get_state().recordings for line in recording.timelines if line.name == "time"]
    return next(((line.start, line.end) for line in lines if line.start is not None and line.end is not None), None)


def _settled(client: Any, png: Path) -> None:
    """Saves the picture once two in a row are the same: data are loaded and remarks gone."""
    seen: list[bytes] = []

    def same() -> bool:
        client.save_screenshot(str(png))
        seen.append(png.read_bytes())
        return len(seen) >= 8 and seen[-1] == seen[-2] == seen[-3]

    _wait(same, timeout_s=10.0)


def _wait(done: Callable[[], bool], timeout_s: float = 30.0) -> None:
    deadline = clock.monotonic() + timeout_s
    while not done():
        if clock.monotonic() > deadline:
            return
        clock.sleep(0.3)


def executable() -> Path:
    """The Rerun program that came with the library: it need not be on the path."""
    found = importlib.util.find_spec("rerun_cli")
    if found is None or found.origin is None:
        raise ViewerError("the Rerun program is not installed: pip install rerun-sdk")
    return Path(found.origin).with_name("rerun.exe" if sys.platform == "win32" else "rerun")
