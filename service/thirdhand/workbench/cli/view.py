"""`thirdhand view`: draw a recording into a Rerun file; open the Rerun viewer on it or on a running
daemon, in a window or a browser; or take a picture without a screen.
"""

from __future__ import annotations

import argparse
import io
import math
import os
import shlex
import subprocess
import sys
import tempfile
import time as clock
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import rerun as rr
from mcap.writer import MCAP0_MAGIC
from PIL import Image, ImageDraw, ImageFont

from thirdhand.cli.clients import ask
from thirdhand.cli.usage import UsageError, check_writable, reached
from thirdhand.client import Client
from thirdhand.contract.explain import ExplainedError, in_words
from thirdhand.contract.incidents import word
from thirdhand.contract.records import Mode
from thirdhand.daemon.launch import free_port
from thirdhand.process.progress import progress, say
from thirdhand.recordings.mcap_file import RecordingError, begin_of
from thirdhand.recordings.recording import OBJECTS_NOTE, Recording
from thirdhand.recordings.steps import Gap
from thirdhand.settings import palette
from thirdhand.settings.network import is_local
from thirdhand.settings.whole_file import whole
from thirdhand.viewer import vulkan
from thirdhand.viewer.blueprint import TABS, TIMELINE
from thirdhand.viewer.stream import Viewer, ViewerError, rerun_program
from thirdhand.workbench.cli.web_address import live_url, serve_page, web_address
from thirdhand.workbench.trackers.address import Address

RRD_MAGIC = b"RRF2"
TITLE_BAR = 30  # [pixels] minimum height of a window's title bar
CAPTION_MARGIN_PX = 14  # distance of the caption from the corner of a picture
CAPTION_PX = 15  # height of its letters
BAR_TINT = 40  # maximum difference of colour channels in the grey title bar
NO_VULKAN = (
    "a picture without a screen needs a Vulkan driver (on Debian: apt install mesa-vulkan-drivers)"
)
FRESH_S = 1.0  # the age of a live view's picture is printed if it is larger
FRESH_TIMEOUT_S = 10.0


def view(args: argparse.Namespace) -> int:
    """Show files or a live view; the viewer's exit code, or 0 once a picture is written."""
    check_usage(args)
    if args.files == ["live"]:
        url = _live(args)
        return _serve(args, url) if args.web is not None else _show([url], args)
    paths = [Path(name) for name in args.files]
    kinds = [_kind(path) for path in paths]
    if args.screenshot and len(paths) > 1:
        say(f"the picture shows {paths[-1]}, the last of {len(paths)} files")
        paths = paths[-1:]
        kinds = kinds[-1:]
    _check_drawing(args)  # before long work
    with tempfile.TemporaryDirectory() as folder:
        drawings = []
        for i, (path, kind) in enumerate(zip(paths, kinds, strict=True)):
            drawings.append(str(path))
            if kind != RRD_MAGIC:
                own_folder = Path(folder, str(i))
                own_folder.mkdir()
                drawings[i] = str(own_folder / f"{path.stem}.rrd")
                with progress(f"drawing {path.name}", total=Recording.open(path).ticks()) as done:
                    convert(path, drawings[i], say=say, progress=done)
        return _show(drawings, args)


def _live(args: argparse.Namespace) -> str:
    """The address of a daemon's live view, which is waited for while it starts. Raises UsageError
    for a daemon without one.
    """
    now = ask(args, "status")
    say(
        f"{now['cell']}: {now['mode']}"
        + (f": {now['reason'].replace('_', ' ')}" if now["reason"] else "")
    )
    return live_url(lambda: ask(args, "status")["scribe"])


def _kind(path: Path) -> bytes:
    """First bytes of a file that can be shown: RRD_MAGIC or MCAP0_MAGIC. Raises ExplainedError."""
    try:
        path.stat()  # reports a link that leads to itself
    except (FileNotFoundError, NotADirectoryError):
        recording = path.with_suffix(".mcap")
        hint = (
            f"; `thirdhand view {shlex.quote(str(recording))}` draws the recording"
            if recording.is_file()
            else ""
        )
        raise ExplainedError(f"no such file: {path}{hint}") from None
    if path.is_dir():
        raise ExplainedError(f"{path} is a folder; an .rrd or .mcap file in it needed")
    if not path.is_file():  # reading a pipe could wait forever
        raise ExplainedError(
            f"{path} is not a file; a recording (.mcap) or a drawing of Rerun's (.rrd) needed"
        )
    begins = begin_of(path)
    for magic in (RRD_MAGIC, MCAP0_MAGIC):
        if begins.startswith(magic):
            return magic
    raise ExplainedError(
        f"{path} is neither a recording (.mcap) nor a drawing of Rerun's (.rrd); one of them needed"
    )


def check_usage(args: argparse.Namespace) -> None:
    """Raise UsageError for invalid arguments, before anything is drawn."""
    if args.screenshot:
        check_writable(args.screenshot, ".png")
    if args.time is not None:
        is_time = math.isfinite(args.time) and args.time >= 0
        if not (args.screenshot and is_time):
            raise UsageError(
                f"--time {args.time:g}: a time [s] from 0 on, together with --screenshot, needed"
            )
    if "live" in args.files and len(args.files) > 1:
        raise UsageError(f"live and {len(args.files) - 1} files given; either live or files needed")
    if args.tab is not None and not args.screenshot:
        raise UsageError("--tab chooses the tab of a picture; --screenshot PNG needed with it")
    if args.web is not None:
        _check_web(args)


def _check_web(args: argparse.Namespace) -> None:
    """Raise UsageError for arguments that do not go with --web."""
    if args.screenshot:
        raise UsageError(
            "--web and --screenshot given; one of them accepted: a page for browsers, or a picture"
        )
    if args.files != ["live"]:
        raise UsageError("--web shows a running daemon, not files: `thirdhand view live --web`")
    web_address("--web", args.web)


def _serve(args: argparse.Namespace, url: str) -> int:
    """Serve the page until Ctrl-C."""
    from thirdhand.workbench.cli.live_page import live_page  # needs the extra `hands`

    listen = web_address("--web", args.web)
    with (
        reached(args) as session,
        live_page(session, Client(session, args.cell), args.cell, url) as page,
    ):

        def listening(address: Address) -> None:
            print(f"http://{address}/", flush=True)
            if not is_local(f"tcp/{address}"):
                say("everyone who can reach this address can hold, resume and reset the arm")

        serve_page(page.server, "--web", listen, listening)
    return 0


def _show(sources: list[str], args: argparse.Namespace) -> int:
    """Open the viewer on files or a live view and return its exit code, or write the picture of a
    single one and return 0.
    """
    _check_drawing(args)
    if args.screenshot:
        age_s = screenshot(sources[0], args.screenshot, time=args.time, tab=args.tab or TABS[0])
        print(
            args.screenshot
            if age_s is None or age_s <= FRESH_S
            else f"{args.screenshot}: {age_s:.1f} s old"
        )
        return 0
    return subprocess.run(
        [rerun_program(), "--bind", "127.0.0.1", *sources], check=False
    ).returncode


def _check_drawing(args: argparse.Namespace) -> None:
    """Raise ViewerError without a screen for a window, or without Vulkan for a picture."""
    if args.screenshot and not vulkan.is_there():
        raise ViewerError(f"{NO_VULKAN}: no Vulkan device was found")
    has_none = sys.platform.startswith("linux") and not (
        os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
    )
    if has_none and not args.screenshot:
        raise ViewerError(
            "there is no screen to open the viewer on; --screenshot PNG makes a picture without one"
        )


def convert(
    recording_path: str | Path,
    rrd_path: str | Path,
    *,
    say: Callable[[str], None] = lambda line: None,
    progress: Callable[[int], None] = lambda ticks: None,
) -> int:
    """Draw a recording into a Rerun file and return the number of its ticks. The file is complete
    or absent, and its time 0 is the recording's first tick.

    `say` is called with messages on missing parts, which the drawing's log shows too. Raises
    RecordingError, ViewerError.
    """
    recording = Recording.open(recording_path).require_whole()
    with tempfile.TemporaryDirectory() as folder:
        urdf = Path(folder) / "arm.urdf"
        urdf.write_text(recording.urdf, encoding="utf-8")
        try:
            with whole(Path(rrd_path)) as part:
                viewer = Viewer(
                    urdf=urdf, settings=recording.settings, skill=recording.skill, rrd=part
                )
                if viewer.models.remark:
                    say(viewer.models.remark)
                count, missing = _draw(recording, viewer, progress)
        except RecordingError:
            raise
        except Exception as error:
            raise ViewerError(f"the drawing in {rrd_path} failed: {in_words(error)}") from error
    for text in missing:
        say(text)
    if missing:
        say(f"the other {count} ticks are shown")
    return count


def _draw(
    recording: Recording, viewer: Viewer, progress: Callable[[int], None]
) -> tuple[int, list[str]]:
    """Draw a whole recording. Returns the number of its ticks, and messages on missing parts."""
    notes = _Pending(recording.notes("requests", "log", OBJECTS_NOTE), viewer.note)
    images = _Pending(recording.images(), viewer.image)
    count = 0
    time_ns = 0
    previous_tick = None
    gaps: list[Gap] = []
    logged = 0  # number of gaps in the drawing's log
    for step in recording.steps():
        if step.lost or step.damage:
            gaps.append(Gap(previous_tick, step.tick, step.lost, step.damage))
        previous_tick = step.tick
        if step.frame is None and step.checksum is None:  # a state alone, which has no time
            continue
        time_ns = step.time_ns
        for gap in gaps[logged:]:
            viewer.gap(str(gap), time_ns)
        logged = len(gaps)
        if step.skill is not None:
            viewer.learn(step.skill)
        viewer.add(step.frame, time_ns, step.timing, step.events)
        count += 1
        progress(count)
        notes.draw_until(time_ns)
        images.draw_until(time_ns)
    notes.draw_until(math.inf)
    missing = [*map(str, gaps), *recording.unreported(gaps, last=previous_tick)]
    for text in missing[logged:]:
        viewer.log(text, "WARN", time_ns)
    viewer.close()
    return count, missing


class _Pending:
    """Rows of a recording, whose third value is their time [ns], that are not drawn yet."""

    def __init__(self, rows: Iterator[tuple[Any, ...]], draw: Callable[..., None]) -> None:
        self._rows = rows
        self._draw = draw
        self._next = next(rows, None)

    def draw_until(self, time_ns: float) -> None:
        """Draw the rows up to this time."""
        while self._next is not None and self._next[2] <= time_ns:
            self._draw(*self._next)
            self._next = next(self._rows, None)


def screenshot(
    source: str | Path, png: str | Path, *, time: float | None = None, tab: str = TABS[0]
) -> float | None:
    """Take a picture of a Rerun file or a live view. Returns the age of a live view's newest data
    [s]; None for a file.

    The picture shows one tab, `time` [s] after the start or when the arm last followed, with this
    time or the age in its caption. Raises ViewerError, and UsageError for a time after the end.
    """
    from rerun.experimental import ViewerClient

    live = "://" in str(source)
    if not live and not Path(source).is_file():
        raise ViewerError(f"no picture: there is no file {source}")
    os.environ.setdefault("RUST_LOG", "error")  # else notifications cover the picture
    # else its graphics library logs errors
    os.environ.setdefault("XDG_RUNTIME_DIR", tempfile.gettempdir())
    try:
        with ViewerClient.spawn(
            headless=True,
            port=free_port(),
            hide_welcome_screen=True,
            executable_path=str(rerun_program()),
        ) as client:
            client.open(str(source if live else Path(source).absolute()))
            return _take_picture(client, source, Path(png).absolute(), time, tab)
    except ViewerError:
        raise
    except TimeoutError as error:
        raise ViewerError(
            f"no picture of {source}: {in_words(error)}; try again when the machine is idle"
        ) from error
    except (RuntimeError, OSError) as error:
        raise ViewerError(f"no picture of {source}: {in_words(error)}") from error


def _take_picture(
    client: Any, source: str | Path, png: Path, time: float | None, tab: str
) -> float | None:
    """Take the picture of an open source, see `screenshot`."""
    live = "://" in str(source)
    _wait(lambda: _extent(client) is not None and (live or not client.get_state().loading))
    extent = _extent(client)
    if extent is None:
        raise ViewerError(f"no picture of {source}: it has no data yet")
    _select_tab(client, tab)
    if time is None and live:
        client.set_time(TIMELINE, play_state="following")
        return _fresh(client, png)
    time_ns = last_followed(Path(source), extent[1]) if time is None else moment(extent, time)
    client.set_time(TIMELINE, duration=np.timedelta64(time_ns, "ns"), play_state="paused")
    caption = f"{(time_ns - extent[0]) / 1e9:.2f} s of {(extent[1] - extent[0]) / 1e9:.2f} s"
    _settled(client, png, caption)
    return None


def moment(extent: tuple[int, int], time: float | None) -> int:
    """The time [ns] that is `time` [s] after the start; None: the end. Raises UsageError if it is
    after the end.
    """
    start, end = extent
    time_ns = end if time is None else start + round(time * 1e9)
    if time_ns > end:
        raise UsageError(
            f"--time {time:g}: seconds from 0 to {math.floor((end - start) / 1e7) / 100:g} needed"
        )
    return time_ns


def last_followed(rrd: Path, end: int) -> int:
    """The last time [ns] in mode `follow` in a drawing that ends at `end` [ns], or `end`."""
    times = []
    modes = []
    for chunk in rr.chunk.RrdReader(rrd).stream():
        if chunk.entity_path == "/mode" and not chunk.is_static:
            rows = chunk.to_record_batch()
            times += rows[TIMELINE].cast("int64").to_pylist()
            modes += [mode for (mode,) in rows["StateChange:state"].to_pylist()]
    until = zip(modes, [*times[1:], end + 1], strict=True)
    return max((time - 1 for mode, time in until if mode == word(Mode.FOLLOW)), default=end)


def _select_tab(client: Any, tab: str) -> None:
    """Bring one of the three tabs to the front."""

    def is_selected() -> bool:
        blueprint = client.get_blueprint().blueprint
        root = blueprint.get("/viewport", {}).get("ViewportBlueprint", {}).get("root_container", "")
        for path, parts in blueprint.items():
            container = parts.get("ContainerBlueprint", {})
            if container.get("container_kind") == "Tabs" and (
                path == root or path.endswith(f"/{root}")
            ):
                container["active_tab"] = container["contents"][TABS.index(tab)]
                client.set_blueprint(blueprint, of="recording")
                return True
        return False

    if tab != TABS[0]:
        _wait(is_selected)


def _picture(client: Any) -> Image.Image:
    """A picture of the viewer, without the empty bar at its top."""
    with Image.open(io.BytesIO(client.take_screenshot())) as image:
        pixels = np.asarray(image.convert("RGB"))
    bar = int(np.argmax(np.ptp(pixels[TITLE_BAR:], axis=(1, 2)) > BAR_TINT)) + TITLE_BAR - 8
    return Image.fromarray(pixels[bar if bar < 2 * TITLE_BAR else 0 :])


def _save(picture: Image.Image, png: Path, said: str) -> None:
    """Save a picture with a caption at its top."""
    corner_px = (picture.width - CAPTION_MARGIN_PX, CAPTION_MARGIN_PX)
    font = ImageFont.load_default(CAPTION_PX)
    ImageDraw.Draw(picture).text(corner_px, said, fill=palette.ARM_BODY, anchor="rm", font=font)
    picture.save(png)


def _fresh(client: Any, png: Path) -> float:
    """Take pictures of a live view until one is recent, save it, and return the data's age [s]."""
    until = clock.monotonic() + FRESH_TIMEOUT_S
    while True:
        newest = _extent(client, "time")
        picture = _picture(client)
        age_s = clock.time() - (newest[1] if newest else 0) / 1e9
        if age_s <= FRESH_S or clock.monotonic() > until:
            _save(picture, png, f"{age_s:.1f} s old")
            return age_s
        clock.sleep(0.3)


def _extent(client: Any, timeline: str = TIMELINE) -> tuple[int, int] | None:
    """Start and end [ns] of the loaded data; None without data."""
    recordings = client.get_state().recordings
    timelines = [line for recording in recordings for line in recording.timelines]
    lines = [line for line in timelines if line.name == timeline]
    return next(
        (
            (line.start, line.end)
            for line in lines
            if line.start is not None and line.end is not None
        ),
        None,
    )


def _settled(client: Any, png: Path, said: str) -> None:
    """Save the picture once three successive ones are equal: everything is loaded, and
    notifications have disappeared.
    """
    pictures: list[Image.Image] = []

    def same() -> bool:
        pictures.append(_picture(client))
        return len(pictures) >= 8 and pictures[-1] == pictures[-2] == pictures[-3]

    _wait(same, timeout_s=10.0)
    _save(pictures[-1], png, said)


def _wait(done: Callable[[], bool], timeout_s: float = 30.0) -> None:
    deadline = clock.monotonic() + timeout_s
    while not done():
        if clock.monotonic() > deadline:
            return
        clock.sleep(0.3)
