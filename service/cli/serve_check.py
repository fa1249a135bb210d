"""`thirdhand serve --check`: the conditions of a start, examined without a start.

Nothing is written, no cell is occupied, and a port is bound only for a moment.
"""

from __future__ import annotations

import datetime
import os
import re
import shutil
import socket
from collections.abc import Callable, Iterator
from pathlib import Path

from service.cli.diagnosis import FREE_MB, Finding, wrong
from service.client.session import AUTHORITY, CERTIFICATE, check_dates, check_files
from service.contract.explain import in_file, in_words
from service.contract.printable import printable_lines
from service.daemon.single_instance import holder_of, state_folder
from service.scribe.paths import MB
from service.settings.config import Settings, robot_description, urdf_path
from service.settings.network import is_local

EXPIRES_SOON = datetime.timedelta(days=30)
ROUTER_TIMEOUT_S = 2.0
PROTOCOLS = "tcp|tls|ws"  # of endpoints whose ports can be tried


def check(configuration: Callable[[], Settings], skill: Callable[[Settings], Path], live_port: int | None) -> int:
    """Print one line for each condition; exit code 1 if the daemon would not start or not record.

    `configuration` returns the settings or raises, and `skill` returns the path of the skill.
    """
    found = []
    for finding in _findings(configuration, skill, live_port):
        found.append(finding)
        print(" ".join(printable_lines(finding.text()).splitlines()), flush=True)
    return 1 if any(finding.level == "wrong" for finding in found) else 0


def _findings(
    configuration: Callable[[], Settings], skill: Callable[[Settings], Path], live_port: int | None
) -> Iterator[Finding]:
    try:
        settings = configuration()
    except (OSError, ValueError) as error:
        yield wrong("configuration", _reason(error))
        return
    yield Finding("ok", "configuration", f"cell {settings.cell}, {settings.rate_hz} Hz")
    yield _tried("arm", lambda: _arm(settings))
    yield _tried("skill", lambda: _skill(settings, skill(settings)))
    yield _folder("state", state_folder(settings))
    if settings.files.record:
        yield _folder("recordings", folder := Path(settings.files.record).expanduser())
        yield _disk(folder, settings.files.segment_mb)
    if settings.network.certificate or settings.network.zenoh_config:
        yield _tried("certificates", lambda: _certificates(settings))
    own = holder_of(settings)
    for endpoint in settings.network.listen:
        yield _port(endpoint, own)
    if live_port:
        yield _port(f"tcp/127.0.0.1:{live_port}", own)
    for endpoint in settings.network.connect:
        yield _router(endpoint)


def _tried(what: str, examine: Callable[[], Finding]) -> Finding:
    """The result of an examination, or the reason why it failed."""
    try:
        return examine()
    except (OSError, ValueError) as error:
        return wrong(what, _reason(error))


def _reason(error: Exception) -> str:
    return "; ".join(in_file(in_words(error)).splitlines())


def _arm(settings: Settings) -> Finding:
    from service.core.arm.stage import Arm  # a slow import

    Arm(settings, robot_description(settings))
    states = "joint states are measured" if settings.arm.source == "state" else "its posture is assumed"
    count = len(settings.joints.names)
    return Finding("ok", "arm", f"{urdf_path(settings)}, {count} joints, tool on {settings.arm.plate}; {states}")


def _skill(settings: Settings, path: Path) -> Finding:
    from service.learning.reach import beyond_m, out_of_reach  # slow imports
    from service.learning.skill_file import skill_in

    skill = skill_in(path)
    skill.check_accepted()
    reach = out_of_reach(skill, beyond_m(settings, skill.tool_positions), settings)
    level = "wrong" if reach.is_refused else "note" if reach.text or skill.residual_risk else "ok"
    remarks = "; ".join(filter(None, (reach.text, skill.residual_risk and f"residual risk: {skill.residual_risk}")))
    return Finding(level, "skill", f"{skill.name!r} in {path}{f': {remarks}' if remarks else ''}")


def _existing(folder: Path) -> Path:
    """The folder, or the nearest one above it that exists."""
    return next(path for path in (folder.absolute(), *folder.absolute().parents) if os.path.lexists(path))


def _folder(what: str, folder: Path) -> Finding:
    found = _existing(folder)
    if not found.is_dir():
        return wrong(what, f"{folder}: {found} is not a folder")
    if not os.access(found, os.W_OK | os.X_OK, effective_ids=True):
        return wrong(what, f"{folder}: {found} cannot be written by user {os.geteuid()}; its owner can allow that")
    return Finding("ok", what, f"{folder} {'can be written' if found == folder.absolute() else 'can be made'}")


def _disk(folder: Path, segment_mb: float) -> Finding:
    try:
        free_mb = shutil.disk_usage(_existing(folder)).free / MB
    except OSError as error:
        return wrong("disk", in_words(error))
    level = "wrong" if free_mb < segment_mb else "note" if free_mb < FREE_MB else "ok"
    text = f"{free_mb / 1000:.1f} GB free for recordings of up to {segment_mb:g} MB each"
    return Finding(level, "disk", text + "; room on that disk needed" * (level != "ok"))


def _certificates(settings: Settings) -> Finding:
    network = settings.network
    check_files(network.certificate, network.zenoh_config)
    if not network.certificate:
        return Finding("ok", "certificates", f"none; {network.zenoh_config} can be read")
    folder = Path(network.certificate).expanduser()
    ends = [end for name in (CERTIFICATE, AUTHORITY) if (end := check_dates(folder / name)) is not None]
    soon = bool(ends) and min(ends) - datetime.datetime.now(datetime.UTC) < EXPIRES_SOON
    text = f"{folder}, valid until {min(ends):%Y-%m-%d}" if ends else f"{folder}"
    return Finding("note" if soon else "ok", "certificates", text + "; make new ones in time" * soon)


def _address(endpoint: str) -> tuple[str, int] | None:
    """Host and port of an endpoint; None for other kinds of endpoints."""
    match = re.fullmatch(rf"(?:{PROTOCOLS})/\[?([^\]]+?)\]?:(\d+)([?#].*)?", endpoint)
    return None if match is None else (match[1], int(match[2]))


def _port(endpoint: str, own: tuple[int, frozenset[str]] | None) -> Finding:
    where = endpoint.partition("#")[0]  # what follows may hold a key
    if (address := _address(endpoint)) is None:
        return Finding("note", "port", f"{where} is not examined")
    try:
        family, kind, number, _, at = socket.getaddrinfo(*address, type=socket.SOCK_STREAM)[0]
        with socket.socket(family, kind, number) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind(at)
    except OSError as error:
        if own is not None and endpoint in own[1]:
            return Finding("ok", "port", f"{where} is in use by this cell's running daemon, process {own[0]}")
        return wrong("port", f"{where}: {in_words(error)}")
    return Finding("ok", "port", f"{where} is free{'' if is_local(where) else ', and other machines can reach it'}")


def _router(endpoint: str) -> Finding:
    where = endpoint.partition("#")[0]
    if (address := _address(endpoint)) is None:
        return Finding("note", "router", f"{where} is not examined")
    try:
        socket.create_connection(address, timeout=ROUTER_TIMEOUT_S).close()
    except OSError as error:
        return wrong("router", f"{where}: {in_words(error)}")
    return Finding("ok", "router", f"{where} accepts connections")
