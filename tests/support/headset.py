"""A headset for tests: a headless Chromium with npm's `iwer`, which emulates WebXR, and a command
`thirdhand hands --web` for it.
"""

from __future__ import annotations

import contextlib
import os
import re
import shutil
import signal
import subprocess
import sys
import tarfile
import tempfile
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from support import chromium
from support.paths import ROOT

Array = NDArray[np.float64]
IWER = "2.5.0"
KNUCKLES = ("wrist", "index-finger-phalanx-proximal", "pinky-finger-phalanx-proximal")
CACHE = Path(os.environ.get("XDG_CACHE_HOME") or "~/.cache").expanduser() / "thirdhand-tests"
# Runs ahead of the page: a headset with two hands. In each frame `path(seconds)`, if it is set,
# moves them, and `truth` gets a row: time [ms since 1970], side, position [m], quaternion x y z w.
# The time is that of the frame, to which a headset's poses belong: a busy machine processes the
# hands of a frame many milliseconds later.
EMULATED = """
;(() => {
  const has = feature => !LACKING.includes(feature), quest = IWER.metaQuest3;
  const config = {...quest, supportedFeatures: quest.supportedFeatures.filter(has)};
  if (PHONE) config.interactionMode = "screen-space";
  if (!has("immersive-ar")) config.supportedSessionModes = ["inline", "immersive-vr"];
  const device = window.device = new IWER.XRDevice(config, {stereoEnabled: STEREO});
  device.installRuntime({forceInstall: true});
  device.primaryInputMode = PHONE ? "controller" : "hand";
  Object.assign(window, {truth: [], path: null, begun: 0});
  for (const side of ["left", "right"]) {
    const hand = device.hands[side], onFrameStart = hand.onFrameStart.bind(hand);
    hand.onFrameStart = frame => {
      const now = frame.predictedDisplayTime;
      if (window.path) {
        window.begun ||= now;
        const {position, quaternion} = window.path((now - window.begun) / 1000)[side];
        hand.position.set(...position);
        hand.quaternion.set(...quaternion);
        window.truth.push([performance.timeOrigin + now, side, ...position, ...quaternion]);
      }
      onFrameStart(frame);
    };
  }
  // Lets both hands pinch (1) or relax (0).
  window.pinched = value => {
    for (const hand of Object.values(device.hands)) {
      hand.poseId = value ? "pinch" : "default";
      hand.updatePinchValue(value);
    }
  };
  // `iwer` says of each controller that its position is emulated; that of a tracked one is not.
  const getPose = XRFrame.prototype.getPose;
  XRFrame.prototype.getPose = function (...spaces) {
    const pose = getPose.apply(this, spaces);
    return pose && {transform: pose.transform, emulatedPosition: false};
  };
  // What `iwer` keeps behind symbols: the offset of a space from its parent.
  const inside = one => String(one).includes("xr-space");
  window.offset = space => space[Object.getOwnPropertySymbols(space).find(inside)].offsetMatrix;
  window.joints = side =>
    Object.fromEntries([...device.hands[side].inputSource.hand].map(([name, joint]) => [name, [...offset(joint)]]));
})();
"""


def lacking() -> str:
    """Programs that a test with a headset lacks on this machine; empty if none."""
    if chromium.PROGRAM is None:
        return "needs Chromium: on Debian, apt install chromium"
    if not _script().exists() and shutil.which("npm") is None:
        return f"needs npm, once, for iwer {IWER}: on Debian, apt install npm"
    try:
        _fetch()
    except (OSError, subprocess.SubprocessError) as error:
        return f"needs iwer {IWER} of npm, which could not be fetched: {error}"
    return ""


def _script() -> Path:
    return CACHE / f"iwer-{IWER}.min.js"


def _fetch() -> None:
    """Fetch iwer into the cache, unless it is there already."""
    if _script().exists():
        return
    CACHE.mkdir(parents=True, exist_ok=True)
    # other workers may fetch it at the same time
    with tempfile.TemporaryDirectory(dir=CACHE) as folder:
        fetched = subprocess.run(
            ["npm", "pack", "--silent", f"iwer@{IWER}"],
            cwd=folder,
            check=True,
            timeout=60,
            capture_output=True,
            text=True,
        )
        with tarfile.open(Path(folder) / fetched.stdout.split()[-1]) as package:
            script = package.extractfile("package/build/iwer.min.js")
            assert script is not None
            partial = Path(folder) / "iwer.min.js"
            partial.write_bytes(script.read())
        partial.replace(_script())


def emulation(
    *, without: tuple[str, ...] = (), stereo: bool = False, is_phone: bool = False
) -> str:
    """The script that emulates a headset, `without` some features or `immersive-ar`, or a phone."""
    flags = f"STEREO = {str(stereo).lower()}, PHONE = {str(is_phone).lower()}"
    constants = f"const LACKING = {list(without)}, {flags};"
    return f"{_script().read_text(encoding='utf-8')};{constants}{EMULATED}"


@contextlib.contextmanager
def shown(url: str, folder: Path, **more: Any) -> Iterator[chromium.Tab]:
    """The page in the browser of a headset, its button for a session pressed."""
    with chromium.opened(
        url, folder, size=(320, 240), timeout_s=250, before=emulation(**more)
    ) as tab:
        tab.until("document.getElementById('start')?.disabled === false")
        tab.ask("document.getElementById('start').click()")
        yield tab


@contextlib.contextmanager
def worn(url: str, folder: Path, **more: Any) -> Iterator[chromium.Tab]:
    """The page in the browser of a headset, with its session started."""
    with shown(url, folder, **more) as tab:
        tab.until("session !== null")
        yield tab


class Served:
    """A running `thirdhand hands --web`."""

    def __init__(self, process: subprocess.Popen[str], url: str) -> None:
        self.process = process
        self.url = url
        self.ended = ""

    def end(self) -> str:
        """End the command; returns its last standard error."""
        self.process.send_signal(signal.SIGTERM)
        assert self.process.stderr is not None
        self.ended = self.process.stderr.read()
        assert self.process.wait(20) == 0, self.ended
        return self.ended

    def counts(self) -> tuple[int, int, int]:
        """Messages published, lost and dropped as too late; after the end of the command."""
        matched = re.search(
            r"(\d+) messages with hands published, (\d+) lost, (\d+) too late", self.ended
        )
        assert matched is not None, self.ended
        return int(matched[1]), int(matched[2]), int(matched[3])


@contextlib.contextmanager
def serving_hands(endpoint: str, home: Path, *arguments: str) -> Iterator[Served]:
    """The running command, connected to a Zenoh endpoint, with its token in a home folder."""
    command = [
        sys.executable,
        "-m",
        "thirdhand",
        "hands",
        "--web",
        "--connect",
        endpoint,
        *arguments,
    ]
    if "--listen" not in arguments:
        command += ["--listen", "127.0.0.1:0"]
    environment = os.environ | {"HOME": str(home)}
    with subprocess.Popen(
        command,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        cwd=ROOT,
        env=environment,
    ) as process:
        watchdog = threading.Timer(60, process.kill)
        watchdog.start()
        try:
            assert process.stdout is not None
            url = process.stdout.readline().strip()
            assert url, process.stderr and process.stderr.read()
            watchdog.cancel()
            yield Served(process, url)
        finally:
            watchdog.cancel()
            process.kill()


def palm_in_hand(joints: dict[str, list[float]], side: str) -> tuple[Array, Array]:
    """Position (3,) [m] and axes (3, 3) of the palm in the emulated hand, from the offsets of its
    joints, as docs/headset.md defines it.
    """
    wrist, index, little = (np.array(joints[name])[12:15] for name in KNUCKLES)
    back = wrist - (index + little) / 2
    across = index - little if side == "left" else little - index
    axes = np.column_stack([across, np.cross(back, across), back])
    turn, triangle = np.linalg.qr(axes[:, ::-1])  # z first, then y
    return (wrist + index + little) / 3, (turn * np.sign(np.diag(triangle)))[:, ::-1]
