"""Settings: safe defaults, and errors that name the field and the accepted values."""

from __future__ import annotations

import argparse
import contextlib
import copy
import functools
import math
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec
import pytest

from support.turning import NEAR_SEAM, cell_in, continuous_cell, continuous_urdf
from thirdhand.cli.usage import reaching
from thirdhand.client.client_settings import client_settings
from thirdhand.contract.requests import List, ViaPointsRequest, decode_request
from thirdhand.daemon.launch import described
from thirdhand.recordings.shipped import cell_of
from thirdhand.settings.config import (
    FOLLOWING,
    WAM,
    Files,
    Settings,
    converted,
    load,
    parse,
    robot_description,
)
from thirdhand.settings.file_content import SettingsError
from thirdhand.settings.network import Network, is_local
from thirdhand_sim.scene import Scene, SceneError


def refusal(text: str) -> str:
    """The words in which a configuration is refused."""
    with pytest.raises(SettingsError) as caught:
        parse(text, origin="cell.toml")
    return str(caught.value)


@pytest.mark.parametrize(
    "name",
    [
        "",
        "/",
        "*",
        "a/*/b",
        r"a\nb",
        "a//b",
        r"a\u0000b",
        "..",
        "x" * 201,
        "ä" * 101,
        "/".join(["x" * 40] * 5),
    ],
)
def test_a_cell_that_is_no_key_or_no_folder_is_refused(name: str) -> None:
    assert refusal(f'cell = "{name}"').startswith("cell.toml: cell: ")


@pytest.mark.parametrize(
    ("text", "path", "accepted"),
    [
        ("rate_hz = 1001", "rate_hz", "from 50 to 1000"),
        ("[hands]\nunits = 'mm'", "hands", "stale_ms"),
        ("[hands]\nunit = 'inch'", "[hands] unit", "mm"),
        ("[hands]\nstale_ms = 0", "[hands] stale_ms", "above 0"),
        (
            "[hands]\nbase_from_tracker = [0, 0, 0, 0, 0, 0, 0]",
            "[hands] base_from_tracker",
            "1 needed (x y z w)",
        ),
        (
            "[trackers.a]\nunit = 'm'\n[trackers.b]\nbase_from_tracker = [1]",
            "[trackers.b] base_from_tracker",
            "7 needed",
        ),
        ("[trackers.a]\nunits = 'm'", "[trackers] a: unknown field 'units'", "did you mean unit?"),
        (
            "[trackers.'a b']\nunit = 'm'",
            "trackers",
            "'a b' given; 1 to 64 letters, digits and _ . / -",
        ),
        (
            "[hands]\nframe = 'a'\n[trackers.a]\nunit = 'm'",
            "[trackers] a",
            "another one than 'base' and [hands] frame",
        ),
        ("[tool]\nmax_speed = -1", "[tool] max_speed", "above 0"),
        ("[joints]\nvelocity = [9, 1, 1, 1, 1, 1, 1]", "[joints] velocity, entry 1", "1.5"),
        ("[joints]\nlower = [-3, -1, -1, 0, -1, -1, -1]", "[joints] lower, entry 1", "-2.6"),
        ("[joints]\nupper = [1, 1, 1, 3.2, 1, 1, 1]", "[joints] upper, entry 4", "3.1"),
        (
            "[joints]\nupper = [-2.6, 1, 1, 3, 1, 1, 1]",
            "[joints] lower, entry 1",
            "less than [joints] upper, entry 1 =",
        ),
        (
            "[arm]\nposture = [0, 0, 0, 0, 0, 2, 0]",
            "[arm] posture, entry 6",
            "-1.5707 to 1.5707 accepted",
        ),
        (
            "[network]\nlisten = 'tcp/0.0.0.0:1'",
            "[network] listen",
            "'tcp/0.0.0.0:1' given; a list needed",
        ),
        ("[obstacles]\nclearence = 1", "unknown field 'clearence'", "did you mean clearance?"),
        ("[files]\nstate = '~nobody-of-this-name/x'", "[files] state", "no user of this name"),
        ('[network]\ncertificate = "a\\u0000b"', "[network] certificate", "no zero bytes"),
        (
            "[network]\nlisten = ['tcp/127.0.0.1:1', 'udp/[::]:1']",
            "[network] listen, entry 2",
            "or else allow_insecure = true needed",
        ),
        (
            "[network]\nlisten = ['tls/127.0.0.1:1']",
            "[network] certificate",
            "the folder of one needed",
        ),
        (
            "[network]\ncertificate = 'x'\nlisten = ['tcp/127.0.0.1:1']",
            "[network] listen, entry 1",
            "tls/... needed",
        ),
        (
            "[network]\nconnect = ['tcp/127.0.0.1:1', 'tcp/10.0.0.1:1']",
            "[network] connect, entry 2",
            "or else allow_insecure",
        ),
        ("[network]\nrevoked = ['tracker']", "[network] revoked", "no client has a certificate"),
        (
            "[network]\ncertificate = 'x'\nlisten = ['tls/127.0.0.1:1']\nrevoked = ['tracker-2', "
            "'tracer']",
            "[network] revoked, entry 2",
            "with a number, like tracker-2",
        ),
        (
            "[hands]\nbase_from_tracker = [101, 0, 0, 0, 0, 0, 1]",
            "[hands] base_from_tracker",
            "100 m or less on each",
        ),
    ],
)
def test_an_error_names_the_path_and_what_is_accepted(text: str, path: str, accepted: str) -> None:
    message = refusal(text)
    assert message.startswith("cell.toml: ")
    assert path in message
    assert accepted in message.split(path, 1)[1]


def test_contradictions_are_reported_at_once() -> None:
    """Each contradicting value is valid by itself."""
    text = """
    [reach]
    inner = 3
    outer = 2
    [joints]
    jerk = [1, 1, 0, 1, 1, 1, 1]
    velocity = [9, 1, 1, 1, 1, 1, 8]
    """
    lines = refusal(text).removeprefix("cell.toml: ").splitlines()
    assert sorted(re.split("[:;]", line)[0] for line in lines) == [
        "[joints] jerk, entry 3",
        "[joints] velocity, entry 1",
        "[joints] velocity, entry 7",
        "[reach] inner",
    ]


@pytest.mark.parametrize(
    ("arm", "first"),
    [
        ("urdf = 'nowhere.urdf'", "[arm] urdf"),
        (f"urdf = '{WAM}'", "[arm] plate"),
        (f"urdf = '{WAM}'\nplate = 'tool_plate'", "[joints] acceleration"),
    ],
)
def test_a_urdf_that_cannot_be_used_is_reported_first(arm: str, first: str) -> None:
    text = f"[arm]\n{arm}\n[hands]\nunit = 'ft'\n[tool]\ncolour = 'red'\nmax_speed = -1"
    assert refusal(text).startswith(f"cell.toml: {first}: ")


def test_a_toml_error_is_told_with_its_place() -> None:
    for text in ("rate_hz = 500\nhands = [", f"rate_hz = {'9' * 4301}", f"rate_hz = {'9' * 9000}"):
        assert refusal(text).startswith("cell.toml: ")
    assert "line 2" in refusal("rate_hz = 500\nhands = = 3\n")


def test_a_file_is_read_whole_or_not_at_all(tmp_path: Path) -> None:
    file = tmp_path / "cell.toml"
    file.write_text('cell = "lab/bench2"\n[hands]\nunit = "mm"\n', encoding="utf-8")
    assert (load(file).cell, load(file).hands.unit) == ("lab/bench2", "mm")
    with pytest.raises(SettingsError, match=r"nowhere\.toml"):
        load(tmp_path / "nowhere.toml")


@pytest.mark.parametrize(
    ("endpoint", "local"),
    [
        ("tcp/127.0.0.1:7447", True),
        ("tcp/127.3.2.1:0?x=1", True),
        ("tcp/[::1]:7447#iface=lo", True),
        ("udp/localhost:1", True),
        ("unixsock-stream/tmp/socket", True),
        ("tcp/0.0.0.0:7447", False),
        ("tcp/[::]:7447", False),
        ("tcp/192.168.1.5:7447", False),
        ("ws/bench.local:80", False),
        ("tcp/127.0.0.1.evil.example:7447", False),
        ("serial//dev/ttyUSB0", False),
        ("nothing", False),
    ],
)
def test_an_endpoint_is_local_where_no_other_machine_reaches_it(endpoint: str, local: bool) -> None:
    assert is_local(endpoint) == local


def test_endpoint_of_the_command_line_goes_first(monkeypatch: pytest.MonkeyPatch) -> None:
    """An endpoint of the command line or the environment is used before that of the settings."""
    settings = Settings(network=Network(listen=("tcp/127.0.0.1:1",)))
    args = argparse.Namespace(connect=None, cell=None)
    assert reaching(args).connect == ()
    assert reaching(args, settings).connect == ("tcp/127.0.0.1:1",)
    monkeypatch.setenv("THIRDHAND_CONNECT", "tcp/127.0.0.1:2")
    assert reaching(args, settings).connect == ("tcp/127.0.0.1:2",)
    args.connect = ["tcp/127.0.0.1:3"]
    assert reaching(args, settings).connect == ("tcp/127.0.0.1:3",)


def test_daemon_listens_on_this_machine_only() -> None:
    """Listening on this machine only is the default."""
    network = Settings().network
    assert [is_local(endpoint) for endpoint in network.listen] == [True]
    assert (network.connect, network.certificate, network.allow_insecure) == ((), "", False)
    insecure = parse(
        "[network]\nlisten = ['tcp/0.0.0.0:1']\nallow_insecure = true", origin="cell.toml"
    )
    assert insecure.network.listen == ("tcp/0.0.0.0:1",)
    routed = parse(
        "[network]\nconnect = ['tcp/10.0.0.1:1']\nallow_insecure = true", origin="cell.toml"
    )
    assert routed.network.connect == ("tcp/10.0.0.1:1",)


def leaves(value: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """The paths of all numbers with decimals in settings."""
    if isinstance(value, float):
        yield path
    for key, inner in (
        value.items()
        if isinstance(value, dict)
        else enumerate(value if isinstance(value, list) else ())
    ):
        yield from leaves(inner, (*path, key))


@pytest.mark.parametrize(
    "number", [1e-308, -1e-308, 1e-10, 1e10, 1e300, -1e308, math.inf, math.nan]
)
def test_absurd_numbers_are_refused_everywhere(number: float) -> None:
    """No cell has numbers of such sizes."""
    usual = msgspec.json.decode(msgspec.json.encode(Settings()))
    paths = list(leaves(usual))
    assert len(paths) > 100
    for path in paths:
        document = copy.deepcopy(usual)
        functools.reduce(lambda part, key: part[key], path[:-1], document)[path[-1]] = number
        with pytest.raises(
            SettingsError, match=str(path[-1]) if isinstance(path[-1], str) else str(path[-2])
        ):
            converted(document, origin="cell.toml")


@pytest.mark.parametrize(
    ("encoding", "words"),
    [
        ("utf-8-sig", ""),
        ("utf-16", "text in UTF-8 needed, and it is UTF-16"),
        ("latin-1", "text in UTF-8 needed, and it is not at byte 10"),
    ],
)
def test_a_text_of_another_encoding_is_read_or_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, encoding: str, words: str
) -> None:
    """Editors of Windows write such settings, client settings and scenes."""
    path = tmp_path / "thirdhand" / "client.toml"
    path.parent.mkdir()
    path.write_text("# for the \u00e4rm\n", encoding=encoding)
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path))
    for read in (load, lambda _: client_settings(), Scene.load):
        refused = (
            pytest.raises((SettingsError, SceneError), match=words)
            if words
            else contextlib.nullcontext()
        )
        with refused:
            read(path)
    if not words:
        data = path.read_bytes()
        assert decode_request(data[:3] + b'{"op": "list"}', ViaPointsRequest) == List()


def test_a_key_of_many_parts_is_refused_before_it_is_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    text = "\n" + ".".join(["a"] * 20_000) + " = 1"
    assert "line 2 has 19999 dots, at most 1000 accepted" in refusal(text)
    path = tmp_path / "thirdhand" / "client.toml"
    path.parent.mkdir()
    path.write_text(text)
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path))
    for read in (client_settings, lambda: Scene.load(path)):
        with pytest.raises(
            (SettingsError, SceneError), match="line 2 has 19999 dots, at most 1000 accepted"
        ):
            read()


def test_paths_become_absolute_where_the_configuration_is_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "my" / "share").mkdir(parents=True)
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "my" / "arm.urdf").write_bytes(WAM.with_name("ur5.urdf").read_bytes())
    cell = (
        WAM.with_name("ur5.toml")
        .read_text()
        .replace('urdf = "ur5.urdf"', 'urdf = "arm.urdf"\npackages = ["share"]')
    )
    network = (
        '[network]\nlisten = ["tls/localhost:0"]\ncertificate = "secrets"\nzenoh_config = '
        '"../zenoh.json5"'
    )
    files = '[files]\nrecord = "records"\nskill = "mine.npz"\nstate = "~/state"'
    (tmp_path / "my" / "cell.toml").write_text(f"{cell}\n{network}\n{files}\n")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("HOME", "/home/me")
    read = cell_of("my/cell.toml", rate_hz=250)
    assert read.arm.urdf == str(tmp_path / "my/arm.urdf")
    assert read.arm.packages == (str(tmp_path / "my/share"),)
    assert read.network.certificate == str(tmp_path / "my/secrets")
    assert read.network.zenoh_config == str(tmp_path / "my/../zenoh.json5")
    assert read.files.record == str(tmp_path / "records")
    assert read.files.skill == str(tmp_path / "my/mine.npz")
    assert read.files.state == "/home/me/state"
    reparsed = parse(described(read), origin="of the demo's daemon", folder=tmp_path / "elsewhere")
    monkeypatch.chdir(tmp_path / "elsewhere")
    assert reparsed == msgspec.structs.replace(read, network=Network(), files=Files())
    assert robot_description(reparsed) == robot_description(read)


def test_continuous_joint_gets_its_velocity_from_settings(tmp_path: Path) -> None:
    """A continuous joint without a velocity gets it from the settings."""
    bare = re.sub(
        r'(<joint name="wrist_3_joint" type="continuous">.*\n.*)<limit[^>]*/>',
        r"\1",
        continuous_urdf(),
    )
    assert bare.count("<limit") == continuous_urdf().count("<limit") - 1
    posture = (NEAR_SEAM, -1.676, 2.118, -2.755, -1.287, 0.0)
    cell = cell_in(tmp_path, bare, posture=posture)
    assert cell.joints.velocity[5] == 2.0
    assert (cell.joints.lower[5], cell.joints.upper[5], cell.joints.kinds[5]) == (
        -6000.0,
        6000.0,
        "continuous",
    )
    text = (tmp_path / "cell.toml").read_text(encoding="utf-8")
    (tmp_path / "cell.toml").write_text(re.sub(r"velocity = .*", "", text), encoding="utf-8")
    with pytest.raises(
        SettingsError,
        match=r"\[joints\] velocity: missing; the URDF does not define it, 6 numbers needed",
    ):
        load(tmp_path / "cell.toml")


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ('kinds = ["revolute"]', "[joints] kinds: 1 kinds, 6 needed"),
        (
            f"kinds = {['revolute'] * 6}",
            "[joints] kinds: ['revolute', 'revolute', 'revolute', 'revolute', 'revolute', 're",
        ),
        ('kinds = ["floating"]', "[joints] kinds, entry 1"),
        (
            f"lower = {[-7000.0, *[-3.0] * 5]}",
            "[joints] lower, entry 1: -7000.0 given; -6000.0 or more accepted",
        ),
    ],
)
def test_kinds_and_limits_that_contradict_the_urdf_are_refused(
    tmp_path: Path, line: str, message: str
) -> None:
    continuous_cell(tmp_path)
    text = (tmp_path / "cell.toml").read_text(encoding="utf-8")
    (tmp_path / "cell.toml").write_text(
        text.replace("[joints]", f"[joints]\n{line}"), encoding="utf-8"
    )
    with pytest.raises(SettingsError) as caught:
        load(tmp_path / "cell.toml")
    assert message in str(caught.value)


def test_follow_chooses_between_lag_and_calm_motion() -> None:
    tools = [parse(f'[tool]\nfollow = "{name}"', origin="cell.toml").tool for name in FOLLOWING]
    assert tools[1] == Settings().tool
    assert tools[0].room > tools[1].room > tools[2].room
    assert tools[0].jerk == tools[1].jerk > tools[2].jerk


LAB = """
rate_hz = 250
[tool]
max_speed = 0.5
max_jerk = 200
[network]
listen = ["tcp/127.0.0.1:0"]
[cells.bench1]
[cells."lab/bench2"]
rate_hz = 500
tool = { max_speed = 0.3 }
[cells.bench3]
cell = "hall/bench3"
network.listen = ["tcp/127.0.0.1:7448"]
"""


def test_file_of_several_cells_holds_shared_and_own_values(tmp_path: Path) -> None:
    path = tmp_path / "lab.toml"
    path.write_text(LAB, encoding="utf-8")
    first, second, third = (
        cell_of(f"{path}:{name}") for name in ("bench1", "lab/bench2", "bench3")
    )
    assert [settings.cell for settings in (first, second, third)] == [
        "bench1",
        "lab/bench2",
        "hall/bench3",
    ]
    assert [settings.rate_hz for settings in (first, second, third)] == [250, 500, 250]
    assert [(settings.tool.max_speed, settings.tool.max_jerk) for settings in (first, second)] == [
        (0.5, 200.0),
        (0.3, 200.0),
    ]
    assert third.network.listen == ("tcp/127.0.0.1:7448",)
    assert first.network.listen == second.network.listen == ("tcp/127.0.0.1:0",)


@pytest.mark.parametrize(
    ("text", "cell", "words"),
    [
        (LAB, "", "no cell given; FILE.toml:NAME with one of bench1, lab/bench2, bench3 needed"),
        ("", "bench1", "cell 'bench1' given; the file has no tables [cells.NAME]; FILE.toml alone"),
        ("cells = 3", "a", "tables by the cells' names needed, like [cells.bench1.tool]"),
        ("[cells.a.tool]\nmax_sped = 1", "a", "max_sped"),
        ("[cells.a]\ntool = 3", "a", "tool: 3 given"),
    ],
)
def test_unknown_cell_is_refused_with_the_known_ones(text: str, cell: str, words: str) -> None:
    """The error names the cells of the file."""
    with pytest.raises(SettingsError) as raised:
        parse(text, origin="lab.toml", cell=cell)
    assert words in str(raised.value)


@pytest.mark.parametrize(
    ("network", "endpoints"),
    [
        ({}, ("tcp/127.0.0.1:7447",)),
        (
            {"listen": ("tcp/0.0.0.0:1", "tcp/[::]:2"), "allow_insecure": True},
            ("tcp/127.0.0.1:1", "tcp/127.0.0.1:2"),
        ),
        ({"listen": ("tcp/127.0.0.1:0",)}, ()),
        ({"listen": ("tcp/127.0.0.1:0",), "connect": ("tcp/[::1]:5",)}, ("tcp/[::1]:5",)),
        ({"listen": ("unixsock-stream//run/th.sock",)}, ("unixsock-stream//run/th.sock",)),
    ],
)
def test_programs_reach_the_daemon_where_it_listens(
    network: dict[str, Any], endpoints: tuple[str, ...]
) -> None:
    """The programs run on the daemon's machine."""
    assert Network(**network).reached_at == endpoints
