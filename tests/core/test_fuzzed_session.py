"""A session of damaged bytes, decoded as in the daemon, recorded and replayed: the replay is the
same bit for bit, and within every bound. The session follows from its seed.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from support.fuzzed import QUIET_S, Traffic, assert_recorded_session_keeps_the_bounds
from support.wam import URDF
from thirdhand.contract import channels
from thirdhand.contract.messages import WireError
from thirdhand.contract.records import Mode
from thirdhand.contract.requests import RequestError
from thirdhand.core.controller import Controller, run
from thirdhand.core.frame import Event, Frame, Tick, order
from thirdhand.core.skill.skill import Skill
from thirdhand.recordings.recording import Recorder
from thirdhand.settings.config import Settings

SETTINGS = Settings()
# duration of the session [s], and ticks between samples
SECONDS = 12.0
EVERY = 5
ORDERS = ("hold", "resume", "reset")


def event(key: str, payload: bytes) -> Event | None:
    """The event of a message's bytes, as in the daemon; None if they are refused."""
    channel = channels.BY_KEY[key]
    try:
        value = channel.codec.decode(payload)
    except (WireError, RequestError):
        return None
    if channel.direction == "in":
        return Event(key, payload, value)
    return order(key) if key in ORDERS else None


@pytest.mark.parametrize("seed", [1, 2])
@pytest.mark.one_case
def test_spoilt_bytes_replay_within_bounds(seed: int, skill: Skill, tmp_path: Path) -> None:
    """A session with damaged bytes replays within every bound."""
    traffic = Traffic(seed)
    path = tmp_path / "fuzzed.mcap"
    traffic.joints = np.array(SETTINGS.arm.posture)
    controller = Controller(SETTINGS, skill, urdf=URDF)
    count = round(SECONDS / SETTINGS.period_s)
    refused = 0
    sent: list[Tick] = []

    def told() -> object:
        nonlocal refused
        for k in range(count):
            inbox: list[Event] = []
            if k % EVERY == 0:
                came = [
                    event(*message)
                    for message in traffic.at(k * SETTINGS.period_s, 2_000_000 * (k + 1))
                ]
                refused += came.count(None)
                inbox = [item for item in came if item is not None]
            sent.append(Tick(k, tuple(inbox)))
            yield sent[-1]

    with Recorder(path, settings=SETTINGS, skill=skill.file, state=controller.state) as recorder:

        def keep(tick: Tick, frame: Frame) -> None:
            if frame["commanded"]:
                traffic.joints = frame["joints"]
            recorder.write(tick, frame, time_ns=2_000_000 * (tick.index + 1), state=None)

        run(controller, told(), [keep])
    frames = assert_recorded_session_keeps_the_bounds(path)
    assert refused > 30
    assert frames["rejected"][-1].sum() > 30
    share = (frames["mode"] == Mode.FOLLOW).reshape(-1, round(2 * QUIET_S / SETTINGS.period_s))
    assert share.mean(axis=1).min() > 0.1, "a second without spoilt bytes is followed"
