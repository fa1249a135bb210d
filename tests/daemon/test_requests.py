"""Requests are checked and refused as a whole with a reason, or carried out through the inbox and
answered with their tick.
"""

from __future__ import annotations

import contextlib
import os
import re
import stat
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
import zenoh

from support.request_cell import VIA_POINTS, Cell
from thirdhand.client import RefusedError, endpoints
from thirdhand.command_line import main
from thirdhand.contract import requests
from thirdhand.contract.records import Mode, Reason
from thirdhand.core.skill.skill import Skill
from thirdhand.daemon.daemon import load_skill
from thirdhand.daemon.saved_via_points import SavedViaPoints
from thirdhand.daemon.skill_worker import SkillWorker
from thirdhand.settings.config import Files, Reach, Settings
from thirdhand.skills.reach import beyond_m
from thirdhand.skills.skill_file import SkillError, StoredSkill, decoded, with_file
from thirdhand.skills.via_points import adapted

HANDOVER = VIA_POINTS[0]
ORDERS = ("hold", "resume", "reset")
FAR_LEFT = Reach(centre=(0.0, 1.5, 0.346))


def point(**change: Any) -> dict[str, Any]:
    """A via-point as a client writes it; None leaves a field out."""
    whole = {
        "name": "a",
        "left": HANDOVER.left,
        "right": HANDOVER.right,
        "tool": HANDOVER.tool,
    } | change
    return {name: value for name, value in whole.items() if value is not None}


def add(*points: dict[str, Any], **more: Any) -> dict[str, Any]:
    return {"op": "add", "points": points, **more}


def test_places_are_added_listed_replaced_removed_and_cleared(cell: Cell) -> None:
    assert cell.client.via_points() == ()
    points = cell.client.add(VIA_POINTS).points
    assert points is not None
    assert [taught.name for taught in points] == ["handover", "glass", "soldering"]
    assert all(taught.missed_by_m < 0.003 for taught in points)
    assert cell.client.via_points() == points

    moved = cell.client.ask(
        "via_points",
        add(
            point(
                name="glass",
                left=VIA_POINTS[1].left,
                right=VIA_POINTS[1].right,
                tool=[0.5, 0.1, 0.3],
            )
        ),
    )
    assert {taught["name"]: taught["tool"] for taught in moved["points"]}["glass"] == [
        0.5,
        0.1,
        0.3,
    ]
    assert len(moved["points"]) == 3

    assert [taught.name for taught in cell.client.remove("glass").points or ()] == [
        "handover",
        "soldering",
    ]
    assert cell.client.clear().points == ()
    assert cell.kinds() == ["skill"] * 4
    assert cell.taken[0].value.via_points == VIA_POINTS


def test_reply_warns_of_a_missed_via_point(cell: Cell) -> None:
    """There are no other warnings."""
    assert cell.client.add(VIA_POINTS).warnings == ()
    tool = [HANDOVER.tool[0], HANDOVER.tool[1] + 0.2, HANDOVER.tool[2]]
    reply = cell.client.ask("via_points", add(point(name="loose", tool=tool, std=0.2)))
    missed = next(taught["missed_by_m"] for taught in reply["points"] if taught["name"] == "loose")
    assert missed > 0.1
    assert reply["warnings"][0].startswith(f"via-point 'loose' is missed by {1000 * missed:.0f} mm")


def test_what_the_loop_adopts_is_what_a_recording_keeps(cell: Cell, skill: StoredSkill) -> None:
    cell.client.add(VIA_POINTS, tolerance=0.04)
    (event,) = cell.taken
    expected = adapted(skill, VIA_POINTS, tolerance=0.04)
    assert event.payload == cell.kept[0] == expected.file
    assert type(event.value) is Skill  # the recording has the skill's file separately
    assert event.value.digest == expected.digest


def test_what_is_taught_is_its_users_alone(cell: Cell) -> None:
    cell.client.add(VIA_POINTS)
    saved = cell.folder / "state" / cell.settings.cell
    assert stat.S_IMODE(next(saved.glob("via-points-*.json")).stat().st_mode) == 0o600
    assert stat.S_IMODE(saved.stat().st_mode) == 0o700


def test_via_points_that_cannot_be_saved_are_not_taught(cell: Cell) -> None:
    (cell.folder / "state").write_text("a file where a folder is needed")
    with pytest.raises(RefusedError, match="via-points"):
        cell.client.add(VIA_POINTS)
    assert cell.kinds() == []
    assert cell.names() == []


def test_unsaved_via_points_are_reported(cell: Cell, skill: Skill) -> None:
    """The via-points are in force, but their file cannot be replaced."""
    SavedViaPoints(cell.settings).path(skill).mkdir(parents=True)
    (warning,) = cell.client.add(VIA_POINTS).warnings
    assert warning.startswith("the via-points end at a restart: they cannot be saved (")
    assert cell.names() == [point.name for point in VIA_POINTS]


NOT_EMPTY: list[tuple[Any, str]] = [
    (None, "$: null (or NaN) given; an object with its fields needed"),
    (b"hold!", "not JSON: JSON is malformed"),
]
REFUSED: dict[str, list[tuple[Any, str]]] = {
    "via_points": [
        (add(point(left=[1.0, 2.0])), "$.points[0].left: 2 numbers, 3 needed"),
        (
            add(point(left=[0.1, 0.2, 10.5])),
            "$.points[0].left[2]: 10.5 given; -10 to 10 m accepted",
        ),
        (add(point(right=None)), "$.points[0]: field `right` is missing"),
        (add(point(name="")), "$.points[0].name: '' given; 1 to 64 letters"),
        (add(point(std=0.0)), "$.points[0].std: 0.0 given; a number from 1e-05 to 1 accepted"),
        (add(point(radius=0.3)), "$.points[0].radius: 0.3 given; a number from 0 to 0.2 accepted"),
        (add(point(follow="both")), "$.points[0].follow: 'both' given; left, none, right accepted"),
        (
            add(point(), point(name="b"), point()),
            "$.points[2].name: 'a' given twice, names once each needed",
        ),
        (
            add(point(tool=[3.0, 0.0, 0.0])),
            "$.points[0].tool: [3.0, 0.0, 0.0] outside the skill's workspace, (",
        ),
        (
            add(point(tool=[0.2, 0.0, 0.3])),
            "$.points[0].tool: [0.2, 0.0, 0.3] out of the arm's reach by 0.145 m: 0.35 to 0.88 m "
            "from the",
        ),
        (
            add(point(tool=[0.6, 0.0, 0.01])),
            "$.points[0].tool: [0.6, 0.0, 0.01] out of the arm's reach by 0.010 m",
        ),
        (add(), "$.points: none given, 1 to 100 needed"),
        (add(*(point(name=f"p{i}") for i in range(101))), "$.points: 101 given, 1 to 100 needed"),
        (add(point(), tolerance=-1.0), "$.tolerance: -1.0 given; a number from 0 to 10 accepted"),
        (
            {"op": "remove", "names": ["nothing"]},
            "$.names[0]: no via-point 'nothing'; in force: handover, glass, soldering",
        ),
        (
            {"op": "remove", "names": ["glass", "nothing"]},
            "$.names[1]: no via-point 'nothing'; in force: handover, glass, soldering",
        ),
        ({}, "$: field `op` is missing"),
        (b'{"op": "list", "op": "clear"}', "'op' given twice in one object; each name once needed"),
        (b"[" * 100_000, "not JSON: maximum recursion depth"),
        (b" " * 262_145, "a request of 262145 bytes, at most 262144 accepted"),
    ],
    "skill": [
        (
            {"name": "nothing"},
            "$.name: no skill 'nothing' in the skill folder; its skills: soldering",
        ),
        *(({"name": name}, "$.name: ") for name in (".npz", "a/b", "", "x" * 129)),
        ({"name": 3}, "$.name: 3 given; 1 to 64 letters"),
        ({}, "$: field `name` is missing"),
    ],
    "resume": [
        *NOT_EMPTY,
        ({"by": 5}, "$.by: 5 given; a name of up to 64 letters, digits, spaces and . _ - accepted"),
    ],
    "reset": [*NOT_EMPTY, ({"now": True}, "$: unknown field 'now'; known are none")],
}


@pytest.mark.parametrize(
    ("suffix", "request_", "message"),
    [(suffix, *row) for suffix, rows in REFUSED.items() for row in rows],
    ids=lambda value: str(value)[:60] if isinstance(value, str) else "",
)
def test_a_request_is_refused_whole_and_with_a_reason(
    taught_cell: Cell, suffix: str, request_: Any, message: str
) -> None:
    assert taught_cell.refusal(suffix, request_).startswith(message)


@pytest.mark.parametrize(
    "payload",
    [
        None,
        b"hold!",
        {"now": True},
        {"by": 5},
        b'{"by": "a", "by": "b"}',
        b" " * 262_145,
        b"[" * 100_000,
    ],
)
def test_a_hold_that_is_not_understood_holds(taught_cell: Cell, payload: Any) -> None:
    reply = taught_cell.reply("hold", payload)
    assert reply.ok is not None
    assert b"the arm holds, but the request was not understood: " in reply.ok.payload.to_bytes()
    assert taught_cell.kinds()[-1] == "hold"


# --- skills and segments ---


@pytest.mark.parametrize("name", ["soldering", "soldering.npz"])
def test_skill_is_loaded_by_name_and_keeps_its_via_points(
    cell: Cell, skill: StoredSkill, name: str
) -> None:
    """Via-points stay with the skill that they were taught to."""
    cell.client.add(VIA_POINTS)
    assert len(cell.client.load_skill(name).points or ()) == len(VIA_POINTS)
    other = with_file(replace(skill, learned_from="other demonstrations"))
    (cell.folder / "other.npz").write_bytes(other.file)
    assert cell.client.ask("skill", {"name": "other"})["points"] == []
    assert cell.taken[-1].value.digest == other.digest
    assert cell.names() == []
    cell.client.add(VIA_POINTS[:1])
    assert len(cell.client.load_skill(name).points or ()) == len(VIA_POINTS)
    assert len(cell.client.load_skill("other").points or ()) == 1


@pytest.mark.parametrize(
    ("state", "message"),
    [
        ("running", "did not take the request: it is starting, ending or stalled"),
        ("fails", "failed in the tick"),
    ],
)
def test_a_skill_that_no_tick_adopted_is_not_adopted_later(
    cell: Cell, monkeypatch: pytest.MonkeyPatch, state: str, message: str
) -> None:
    monkeypatch.setattr("thirdhand.daemon.request_inbox.ADOPTION_TIMEOUT_S", 0.05)
    setattr(cell, state, state == "fails")
    with pytest.raises(RefusedError, match=message):
        cell.client.add(VIA_POINTS)
    monkeypatch.undo()
    setattr(cell, state, state == "running")
    cell.client.ask("hold")  # taken after all other waiting requests
    assert cell.kinds() == ["hold"]
    assert cell.names() == []
    assert [point.name for point in cell.client.add(VIA_POINTS[:1]).points or ()] == [HANDOVER.name]


@pytest.mark.parametrize(
    "name",
    [
        "../secret",
        "..",
        "/etc/passwd",
        "sub/inside",
        "a\0b",
        "link",
        "loop",
        "pipe",
        ".hidden",
        "x" * 200,
        "{folder}/../secret",
        "{folder}/soldering",
        "soldering.npz/../../secret",
        "~/secret",
        "secret\n",
        "",
    ],
)
def test_a_skill_is_loaded_from_its_folder_only(
    cell: Cell, skill: Skill, tmp_path: Path, name: str
) -> None:
    """A file elsewhere is not loaded under any name, and its path is not revealed."""
    outside = tmp_path / "elsewhere"
    outside.mkdir()
    for path in (
        outside / "secret.npz",
        cell.folder.parent / "secret.npz",
        cell.folder / ".hidden.npz",
    ):
        path.write_bytes(skill.file)
    (cell.folder / "sub").mkdir()
    (cell.folder / "sub" / "inside.npz").write_bytes(skill.file)
    (cell.folder / "link.npz").symlink_to(outside / "secret.npz")
    (cell.folder / "loop.npz").symlink_to(cell.folder / "loop.npz")
    os.mkfifo(cell.folder / "pipe.npz")
    with pytest.raises(RefusedError) as refused:
        cell.client.ask("skill", {"name": name.format(folder=cell.folder)})
    assert str(refused.value).startswith("$.name")
    assert str(outside) not in str(refused.value)
    assert cell.kinds() == []
    assert cell.failures == []


def test_the_segment_of_the_task_is_told_by_client_and_command(
    cell: Cell, sessions: tuple[zenoh.Session, zenoh.Session], capsys: pytest.CaptureFixture[str]
) -> None:
    assert "There are: start, handover, glass, soldering" in cell.refusal(
        "segment", {"name": "elsewhere"}
    )
    reply = cell.client.set_segment("glass")
    assert (reply.mode, reply.reason, cell.kinds()[-1]) == ("hold", "no_hands", "segment")
    command = [
        "segment",
        "soldering",
        "--connect",
        *endpoints(sessions[0]),
        "--cell",
        cell.settings.cell,
    ]
    for mode, reason, text in (
        (Mode.HOLD, Reason.NO_HANDS, "hold (no_hands)"),
        (Mode.FOLLOW, Reason.NONE, "follow"),
    ):
        cell.mode = mode
        cell.reason = reason
        assert main(command) == 0
        assert re.search(
            rf"^at soldering since tick \d+: {re.escape(text)}$",
            capsys.readouterr().out,
            re.MULTILINE,
        )
    assert cell.kinds()[-3:] == ["segment"] * 3


def test_the_task_is_begun_by_client_and_command(
    cell: Cell, sessions: tuple[zenoh.Session, zenoh.Session], capsys: pytest.CaptureFixture[str]
) -> None:
    """A skill that needs no request says so."""
    assert "needs no request" in cell.client.begin().note
    reached = ["--connect", *endpoints(sessions[0]), "--cell", cell.settings.cell]
    assert main(["begin", *reached]) == 0
    assert re.search(r"begun at tick \d+: hold \(no_hands\); the", capsys.readouterr().out)
    assert cell.kinds()[-2:] == ["begin"] * 2


def test_skill_out_of_reach_is_refused(
    sessions: tuple[zenoh.Session, zenoh.Session],
    skill: StoredSkill,
    skill_worker: SkillWorker,
    tmp_path: Path,
) -> None:
    """A skill that is partly out of reach is loaded with a warning."""
    positions = skill.tool_positions
    half = Reach(min_x=float(np.quantile(positions[:, 0], 0.4)))  # 40 % are nearer to the base
    for reach, is_refused in ((FAR_LEFT, True), (half, False)):
        folder = tmp_path / str(is_refused)
        folder.mkdir()
        number = int(np.count_nonzero(beyond_m(Settings(reach=reach), positions)))
        sentence = (
            f"{number} of {len(positions)} positions of the tool in skill 'soldering' are out of "
            "the arm's reach, the"
        )
        with contextlib.closing(Cell(*sessions, skill, skill_worker, folder, reach)) as cell:
            if is_refused:
                assert sentence in cell.refusal("skill", {"name": "soldering"})
                assert cell.kept == []
            else:
                (warning,) = cell.client.load_skill("soldering").warnings
                assert warning.startswith(sentence)
                assert cell.kinds() == ["skill"]


@pytest.mark.parametrize("reach", [FAR_LEFT, Reach(min_x=0.95)])
def test_a_skill_out_of_reach_is_not_served(
    reach: Reach, skill: StoredSkill, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    (tmp_path / "soldering.npz").write_bytes(skill.file)
    settings = Settings(files=Files(state=str(tmp_path)), reach=reach)
    with pytest.raises(
        SkillError,
        match=r"positions of the tool .* out of the arm's reach, the farthest by \d\.\d+ m: ",
    ):
        load_skill(tmp_path / "soldering.npz", settings)
    served = load_skill(tmp_path / "soldering.npz", Settings(files=Files(state=str(tmp_path))))
    assert served.digest == skill.digest
    assert caplog.text == ""


def with_residual_risk(skill: StoredSkill, accepted_by: str) -> StoredSkill:
    """The skill with a gate that holds only 3 % of exchanged hands."""
    risk = {"residual": ["the gate holds 3.0 % of hands swapped"], "accepted_by": accepted_by}
    figures = msgspec.json.encode(msgspec.json.decode(skill.figures) | risk).decode()
    return decoded(with_file(replace(skill, figures=figures)).file, origin="skill")


def test_residual_risk_must_be_accepted(
    sessions: tuple[zenoh.Session, zenoh.Session],
    skill: StoredSkill,
    skill_worker: SkillWorker,
    tmp_path: Path,
    caplog: pytest.LogCaptureFixture,
) -> None:
    """Otherwise the skill is not served."""
    refusal = (
        "not served: nobody has accepted its residual risk: the gate holds 3.0 % of hands swapped. "
        "Who takes"
    )
    for accepted_by in ("", "Ada"):
        risky = with_residual_risk(skill, accepted_by)
        folder = tmp_path / f"by {accepted_by}"
        folder.mkdir()
        (folder / "risky.npz").write_bytes(risky.file)
        settings = Settings(files=Files(state=str(folder)))
        with contextlib.closing(Cell(*sessions, risky, skill_worker, folder)) as cell:
            if accepted_by:
                sentence = "accepted by Ada: the gate holds 3.0 % of hands swapped"
                served = load_skill(folder / "risky.npz", settings)
                assert (risky.residual_risk, served.residual_risk) == (sentence, sentence)
                assert f"residual risk of skill 'soldering', {sentence}" in caplog.text
                assert f"residual risk {sentence}" in cell.client.load_skill("soldering").warnings
                assert served.for_loop().residual_risk == sentence
                assert adapted(served, VIA_POINTS, tolerance=0.05).residual_risk == sentence
            else:
                with pytest.raises(SkillError, match=refusal):
                    load_skill(folder / "risky.npz", settings)
                assert refusal in cell.refusal("skill", {"name": "soldering"})
                assert cell.kept == []


# --- hold, resume and reset ---


class SlowWorkshop(SkillWorker):
    """A skill worker in this process that waits for permission to adapt."""

    def __init__(self) -> None:
        super().__init__()
        self.begun = threading.Event()
        self.let = threading.Event()

    def adapt(
        self,
        skill: Skill,
        via_points: Sequence[requests.ViaPoint],
        *,
        tolerance: float,
        timeout_s: float = 0.0,
    ) -> Skill:
        self.begun.set()
        assert self.let.wait(20)
        return adapted(skill, via_points, tolerance=tolerance)


@pytest.fixture
def slow() -> Iterator[SlowWorkshop]:
    running = SlowWorkshop()
    yield running
    running.close()


@pytest.mark.parametrize("suffix", ORDERS)
def test_a_plain_request_is_answered_with_the_tick_that_took_it(cell: Cell, suffix: str) -> None:
    first = cell.client.ask(suffix)
    second = cell.client.ask(suffix, {})
    assert 0 < first["tick"] < second["tick"]
    assert cell.kinds() == [suffix, suffix]


def test_named_hold_is_ended_by_its_name_only(cell: Cell) -> None:
    """Holds by other names remain."""
    mine = {"by": "me"}
    for name in ("me", "you"):
        cell.client.hold(name)
    assert cell.refusal("resume", mine).startswith("$.by: somebody else holds the arm too")
    cell.client.resume()
    assert cell.refusal("resume", mine).startswith("$.by: 'me' does not hold the arm")
    cell.client.hold("me")
    cell.client.resume("me")
    assert cell.kinds() == ["hold", "hold", "resume", "hold", "resume"]


def test_hold_is_answered_while_a_slow_request_runs(
    opened: Callable[[SkillWorker], Cell], slow: SlowWorkshop
) -> None:
    cell = opened(slow)
    with ThreadPoolExecutor(1) as pool:
        teaching = pool.submit(cell.client.add, VIA_POINTS)
        assert slow.begun.wait(10)
        held = cell.client.ask("hold")
        assert cell.kinds() == ["hold"]
        assert cell.client.ask("status")["cell"] == cell.settings.cell
        slow.let.set()
        taught = teaching.result(20)
    assert cell.kinds() == ["hold", "skill"]
    assert held["tick"] < taught.tick


def test_requests_that_wait_are_answered_before_the_end(
    opened: Callable[[SkillWorker], Cell], slow: SlowWorkshop
) -> None:
    cell = opened(slow)
    with ThreadPoolExecutor(2) as pool:
        teaching = pool.submit(cell.client.add, VIA_POINTS)
        assert slow.begun.wait(10)
        closing = pool.submit(cell.close)
        slow.let.set()
        assert teaching.result(20).points
        closing.result(20)
