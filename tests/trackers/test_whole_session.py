"""A session from a headset to a finished task: an emulated headset is calibrated at a led arm, and
its hands play the scene of the demo, with the left hand's pinch as the clutch. The recording
replays exactly.
"""

from __future__ import annotations

import json
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest
import zenoh
from scipy.spatial.transform import Rotation

from support import headset
from support.cell import serving, told
from support.chromium import Tab
from support.paths import ROOT
from thirdhand.client import Watch
from thirdhand.contract import cdr
from thirdhand.contract.messages import JointState
from thirdhand.recordings.replay import replay
from thirdhand.settings.config import Settings, load
from thirdhand_sim.calibration import BENCH, GRIP, ORIGIN, TRUE_TURN, LedArm, led
from thirdhand_sim.scene import Scene

pytestmark = [
    pytest.mark.timed,
    pytest.mark.skipif(bool(lacks := headset.lacking()), reason=lacks),
    pytest.mark.timeout(500),
]
TIMEOUT_S = 120.0
ROW_MS = 40
CELL = """# a cell whose tracker nobody has measured
rate_hz = 100
[network]
listen = ["tcp/127.0.0.1:0"]
[hands]
clutch = "key"
stale_ms = 1000.0
"""
# The hands move to their goals at 0.35 m/s, without turning. While there are rows of a position and
# a quaternion, the right hand has that of the time by the wall clock.
MOVED = """(() => {
  let last = performance.now();
  path = () => {
    const now = performance.now(), step = 0.35 * (now - last) / 1000, upright = [0, 0, 0, 1];
    last = now;
    for (const side of ["left", "right"]) {
      const way = goals[side].map((goal, k) => goal - at[side][k]), share = step / Math.max(Math.hypot(...way), 1e-9);
      at[side] = at[side].map((one, k) => one + way[k] * Math.min(1, share));
    }
    const row = rows?.[Math.floor((performance.timeOrigin + now - begunMs) / ROW_MS) % rows.length];
    const [left, right] = ["left", "right"].map(side => ({position: at[side], quaternion: upright}));
    return {left, right: row ? {position: row.slice(0, 3), quaternion: row.slice(3)} : right};
  };
})()"""


def in_tracker(base: headset.Array) -> headset.Array:
    """Positions (..., 3) [m] in the headset's frame."""
    return np.asarray(TRUE_TURN.inv().apply(base - ORIGIN))


class LeadingHand:
    """An arm that is led in real time, and the right hand, which holds its tool; used as a
    context.
    """

    def __init__(self, session: zenoh.Session, tab: Tab, arm: LedArm) -> None:
        self._session = session
        self._arm = arm
        self._end = threading.Event()
        self._begun_ns = time.time_ns()
        turns = Rotation.from_quat(arm.turn)
        rows = np.hstack(
            [in_tracker(arm.tool + turns.apply(GRIP)), (TRUE_TURN.inv() * turns).as_quat()]
        )
        step = round(ROW_MS / 10)  # the arm's motion has 100 rows a second
        tab.ask(
            f"rows = {json.dumps(rows[::step].round(6).tolist())}; begunMs = {self._begun_ns / 1e6}"
        )
        self._tab, self._thread = tab, threading.Thread(target=self._publish)
        self._thread.start()

    def _publish(self) -> None:
        names = Settings().joints.names
        while not self._end.wait(0.01):
            now_ns = time.time_ns()
            joints = self._arm.joints[int((now_ns - self._begun_ns) / 1e7) % len(self._arm.joints)]
            state = JointState(now_ns, names, tuple(joints.tolist()), ())
            self._session.put("thirdhand/joints/state", cdr.encode_joints(state))

    def __enter__(self) -> LeadingHand:
        return self

    def __exit__(self, *_: object) -> None:
        self._end.set()
        self._thread.join(10)
        self._tab.ask("rows = null")


def begin(tab: Tab, scene: Scene) -> None:
    """Move the hands to the start of the scene."""
    tab.ask("Object.assign(window, {at: {}, goals: {}, rows: null, begunMs: 0})")
    go(tab, {"left": scene.left_start, "right": scene.right_start})
    tab.ask(f"Object.assign(at, goals); {MOVED.replace('ROW_MS', str(ROW_MS))}")


def go(tab: Tab, places: dict[str, tuple[float, float, float]]) -> None:
    """Move palms to positions [m] in frame `base`."""
    for side, place in places.items():
        palm, _ = headset.palm_in_hand(
            json.loads(tab.ask(f"JSON.stringify(joints('{side}'))")), side
        )
        tab.ask(
            f"goals = {{...goals, {side}: "
            f"{json.dumps((in_tracker(np.array(place)) - palm).tolist())}}}"
        )


def pinch(tab: Tab, value: float) -> None:
    tab.ask(f"device.hands.left.updatePinchValue({value})")


def test_a_headset_is_calibrated_and_its_hands_do_the_task(tmp_path: Path) -> None:
    scene = Scene()
    cell = tmp_path / "my.toml"
    records = tmp_path / "records"
    cell.write_text(CELL + f'[files]\nstate = "{tmp_path / "state"}"\n')
    serve = ("--config", str(cell), "--joints", "state", "--record", str(records))
    with serving(tmp_path, *serve) as daemon:
        with (
            headset.serving_hands(daemon.endpoint, tmp_path) as served,
            headset.worn(served.url, tmp_path, without=("anchors",)) as tab,
        ):
            begin(tab, scene)
            with LeadingHand(daemon.session, tab, led(Settings(), 60.0, np.random.default_rng(2))):
                done = told(
                    "calibrate",
                    "--config",
                    str(cell),
                    "--hand",
                    "right",
                    "--connect",
                    daemon.endpoint,
                )
        assert done.returncode == 0, done.stdout + done.stderr
        assert daemon.end() == 0
    hands = load(cell).hands
    assert hands.frame == "webxr"
    mapped_m = (
        Rotation.from_quat(hands.base_from_tracker[3:]).apply(in_tracker(BENCH))
        + hands.base_from_tracker[:3]
    )
    off_m = np.linalg.norm(mapped_m - BENCH, axis=1)
    print(
        done.stdout,
        f"mapped positions are off by {1e3 * off_m.mean():.1f} mm, at most {1e3 * off_m.max():.1f} "
        "mm",
    )
    assert off_m.mean() < 0.01

    with (
        serving(tmp_path, *serve) as daemon,
        headset.serving_hands(daemon.endpoint, tmp_path, "--pinch-clutch", "left") as served,
        headset.worn(served.url, tmp_path, without=("anchors",)) as tab,
        Watch(daemon.session, "thirdhand", "objects", timeout_s=TIMEOUT_S) as objects,
    ):
        daemon.client.add(scene.via_points())
        begin(tab, scene)
        command = [
            "--connect",
            daemon.endpoint,
            "--arm",
            str(cell),
            "--tracked-hands",
            str(TIMEOUT_S),
            "--once",
        ]
        bench = subprocess.Popen(
            [sys.executable, "-m", "thirdhand_sim", *command],
            stdout=subprocess.PIPE,
            text=True,
            cwd=ROOT,
        )
        with bench:
            daemon.until(lambda now: now["reason"] == "clutch", TIMEOUT_S)
            pinch(tab, 1.0)
            daemon.until(lambda now: now["mode"] == "follow", TIMEOUT_S)
            earlier: set[str] = set()
            while bench.poll() is None and (bodies := next(objects)) is not None:
                places = {body.name: body.position for body in bodies if " hand: " in body.name}
                if new := places.keys() - earlier:
                    go(tab, {name.split()[0]: position for name, position in places.items()})
                    if earlier and len(new) == 2 and "left hand: lay the board here" in new:
                        pinch(tab, 0.0)
                        daemon.until(
                            lambda now: (now["mode"], now["reason"]) == ("hold", "clutch"),
                            TIMEOUT_S,
                        )
                        pinch(tab, 1.0)
                    earlier |= new
            assert bench.stdout is not None
            report = json.loads(bench.stdout.read())
        assert report["success"], report
        assert daemon.end() == 0

    recordings = sorted(records.glob("*.mcap"))
    assert len(recordings) >= 2
    for path in recordings:
        assert replay(path).exact, path
