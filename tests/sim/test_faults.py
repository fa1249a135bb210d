"""A cell whose parts are killed, frozen and cut off while its tool is fast: it stops within its
bounds, and continues.
"""

from __future__ import annotations

import json
import os
import signal
import socket
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip(
    "matplotlib",
    reason="the experiments draw with Matplotlib: pip install 'thirdhand[experiments]'",
)

from thirdhand_sim.lab.__main__ import main
from thirdhand_sim.lab.load.faults import SHORT
from thirdhand_sim.parts import CellPart

pytestmark = [pytest.mark.timeout(300), pytest.mark.timed]
BRAKE_MM = 40.0  # a tool at up to 0.8 m/s brakes 20 ms after the last command


@pytest.fixture(scope="module")
def suffered(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """The experiment's numbers for a few faults."""
    folder = tmp_path_factory.mktemp("faults")
    assert main(["faults", "--output", str(folder), "--share", "0.1", "--quiet"]) == 0
    assert (folder / "faults.png").read_bytes()[:4] == b"\x89PNG"
    result: dict[str, Any] = json.loads((folder / "faults.json").read_text())
    assert set(result["faults"]) >= set(SHORT) - {"cable pulled"}
    return result


def test_silent_tracker_stops_the_arm(suffered: dict[str, Any]) -> None:
    """The arm stops when the hands are stale."""
    fault = suffered["faults"]["tracker frozen"]
    assert fault["reason"] == "stale_hand"
    assert 80 <= fault["hold_ms"] <= 120
    assert fault["rest_ms"] < 700
    assert fault["speed_at_the_end_m_per_s"] < 1e-3
    # the arm followed its commands
    assert fault["travelled_mm"] == pytest.approx(fault["commanded_mm"], abs=10)
    assert fault["lost_ticks"] == 0


@pytest.mark.parametrize("name", ["network to the arm silent", "cable pulled"])
def test_cut_network_leaves_no_arm_in_motion(suffered: dict[str, Any], name: str) -> None:
    """Late messages do not move the arm."""
    if name not in suffered["faults"]:
        pytest.skip("a network namespace is not allowed here")
    fault = suffered["faults"][name]
    assert fault["reason"] in (
        "arm_error",
        "arm_silent",
        *["stale_hand"] * (name == "cable pulled"),
    )
    assert fault["hold_ms"] <= 120
    assert fault["travelled_mm"] < BRAKE_MM
    assert fault["speed_at_the_end_m_per_s"] < 1e-3
    assert fault["fastest_m_per_s"] < 1.0  # also when delayed messages arrive
    assert fault["lost_ticks"] == 0


def test_killed_service_leaves_no_arm_in_motion(suffered: dict[str, Any]) -> None:
    """The recording of the killed service can be read."""
    fault = suffered["faults"]["service killed"]
    assert fault["travelled_mm"] < BRAKE_MM
    assert fault["speed_at_the_end_m_per_s"] < 1e-3
    assert fault["lost_ticks"] == 0
    assert fault["moves_again_ms"] > 0  # after its restart it continues by itself


def test_killed_router_stops_the_arm(suffered: dict[str, Any]) -> None:
    """All processes connect again."""
    fault = suffered["faults"]["router killed"]
    assert fault["reason"] in ("stale_hand", "arm_error", "arm_silent")
    assert fault["hold_ms"] <= 120
    assert fault["travelled_mm"] < BRAKE_MM
    assert fault["moves_again_ms"] > 0


def test_killed_scribe_costs_ticks_and_no_motion(suffered: dict[str, Any]) -> None:
    """Only ticks of the recording are lost."""
    fault = suffered["faults"]["scribe killed"]
    assert fault["lost_ticks"] > 0
    assert fault["command_mean_gap_ms"] < 1.5 * fault["command_mean_gap_before_ms"]
    assert suffered["unaccounted_ticks"] == 0  # neither recorded nor reported as lost


def test_relay_freezes_or_tears(tmp_path: Path) -> None:
    """A frozen relay is silent; a killed one closes connections."""
    with socket.create_server(("127.0.0.1", 0)) as far_end:
        target = f"tcp/127.0.0.1:{far_end.getsockname()[1]}"
        with closing(CellPart("relay", target, "0")) as relay:
            port = int(relay.endpoint.rsplit(":", 1)[1])
            with socket.create_connection(("127.0.0.1", port), timeout=10) as near:
                far, _ = far_end.accept()
                with far:
                    far.settimeout(10)
                    near.sendall(b"before")
                    assert far.recv(6) == b"before"
                    relay.send(signal.SIGSTOP)
                    os.waitid(os.P_PID, relay.process.pid, os.WSTOPPED)
                    near.sendall(b"held back")
                    far.settimeout(0.2)
                    with pytest.raises(TimeoutError):
                        far.recv(1)
                    relay.send(signal.SIGCONT)
                    far.settimeout(10)
                    assert far.recv(20) == b"held back"
                    relay.again()
                    assert relay.endpoint.endswith(f":{port}")
                    assert far.recv(1) == b""
            with socket.create_connection(("127.0.0.1", port), timeout=10) as near:
                far, _ = far_end.accept()
                with far:
                    near.sendall(b"anew")
                    assert far.recv(4) == b"anew"
