"""`thirdhand serve --check`: the conditions of a start. Only ports are bound, for a moment."""

from __future__ import annotations

import argparse
import errno
import importlib
import os
import platform
import shutil
import socket
from collections.abc import Callable
from pathlib import Path
from typing import Any

from thirdhand.cli.serve import settings_of, skill_path
from thirdhand.cli.status import in_gb
from thirdhand.client.session import check_files
from thirdhand.contract.channels import tcp_address
from thirdhand.contract.explain import ExplainedError, in_file, in_words
from thirdhand.contract.printable import printable
from thirdhand.daemon.single_instance import allow_descriptors, holder_of, state_folder
from thirdhand.process import bytecode, foreign_modules
from thirdhand.scribe.paths import MB, existing_folder
from thirdhand.settings.config import Files, Settings, robot_description, urdf_path
from thirdhand.settings.network import Network, is_local

ROUTER_TIMEOUT_S = 2.0


def check(args: argparse.Namespace) -> int:
    """Print one line for each condition; exit code 1 if the daemon could not start or record."""
    settings = Settings()

    def configuration() -> str:
        nonlocal settings
        settings = settings_of(args)
        return f"cell {settings.cell}, {settings.rate_hz} Hz"

    def is_met(what: str, examine: Callable[..., str], *given: Any) -> bool:
        try:
            level = "ok"
            text = examine(*given)
        except (ExplainedError, ImportError, OSError, ValueError) as error:
            level = "wrong"
            text = "; ".join(in_file(in_words(error)).splitlines())
        print(f"{level:<5}  {what:<14} {printable(text)}", flush=True)
        return level == "ok"

    if not is_met("configuration", configuration):
        return 1
    files = settings.files
    network = settings.network
    live = [f"tcp/127.0.0.1:{args.live}"] * bool(args.live)
    conditions: list[tuple[Any, ...]] = [
        ("imports", _imports),
        ("arm", _arm, settings),
        ("hands", _hands, settings),
        ("skill", _skill, settings, skill_path(settings, args)),
        ("state", lambda: _folder(state_folder(settings))),
        ("descriptors", lambda: f"{allow_descriptors()} open files"),
        *[("recordings", _folder, Path(files.record)), ("disk", _disk, files)] * bool(files.record),
        *[("certificates", _certificates, network)]
        * bool(network.certificate or network.zenoh_config),
        *(("port", _endpoint, endpoint, settings) for endpoint in (*network.listen, *live)),
        *(("router", _endpoint, endpoint, None) for endpoint in network.connect),
    ]
    is_wrong = bool([condition for condition in conditions if not is_met(*condition)])
    if uncompiled := bytecode.missing():
        print(f"note   {'bytecode':<14} {printable(uncompiled)}", flush=True)
    return int(is_wrong)


def _imports() -> str:
    """Import what a start imports."""
    with foreign_modules.named():
        importlib.import_module("thirdhand.daemon.daemon")
    return f"Python {platform.python_version()} has all that a daemon imports"


def _arm(settings: Settings) -> str:
    robot_description(settings)  # with its meshes
    return (
        f"{urdf_path(settings)}, {len(settings.joints.names)} joints, tool on {settings.arm.plate}"
    )


def _hands(settings: Settings) -> str:
    stale_ms = settings.hands.stale_ms
    needed = f"samples needed every {stale_ms:g} ms ([hands] stale_ms)"
    return f"{needed}, {1000 / stale_ms:g} Hz or more"


def _skill(settings: Settings, path: Path) -> str:
    from thirdhand.skills.reach import beyond_m, out_of_reach  # slow imports
    from thirdhand.skills.skill_file import skill_in

    skill = skill_in(path)
    skill.check_accepted()
    reach = out_of_reach(skill, beyond_m(settings, skill.tool_positions), settings)
    if reach.is_refused:
        raise ExplainedError(reach.text)
    return "; ".join(filter(None, (f"{skill.name!r} in {path}", reach.text, skill.residual_risk)))


def _folder(folder: Path) -> str:
    existing = existing_folder(folder)
    if not existing.is_dir():
        raise ExplainedError(f"{existing} is not a folder; a folder, or nothing, needed there")
    system = os.statvfs(existing)
    if system.f_flag & os.ST_RDONLY:
        raise OSError(errno.EROFS, os.strerror(errno.EROFS), str(existing))
    if not system.f_blocks:
        raise ExplainedError(f"{existing} stores no files; a folder on a disk needed")
    if not os.access(existing, os.R_OK | os.W_OK | os.X_OK, effective_ids=True):
        raise ExplainedError(
            f"{folder}: {existing} cannot be written by user {os.geteuid()}; its owner can allow "
            "that"
        )
    return f"{folder} can be {'written' if existing == folder.absolute() else 'made'}"


def _disk(files: Files) -> str:
    free_mb = shutil.disk_usage(existing_folder(Path(files.record))).free / MB
    text = f"{in_gb(free_mb)} free for recordings of up to {files.segment_mb:g} MB each"
    if free_mb < files.segment_mb:
        raise ExplainedError(f"{text}; room on that disk needed")
    return text


def _certificates(network: Network) -> str:
    check_files(network.certificate, network.zenoh_config)
    return f"{network.certificate or network.zenoh_config} can be read"


def _endpoint(endpoint: str, settings: Settings | None) -> str:
    """Try to listen on the endpoint of a cell with these settings, or to connect to a router's."""
    # the rest may hold keys
    where = endpoint.partition("#")[0]
    address = tcp_address(endpoint)
    if address is None:
        return f"{where} is not examined"
    try:
        if settings is None:
            socket.create_connection(address, timeout=ROUTER_TIMEOUT_S).close()
            return f"{where} accepts connections"
        family, kind, number, _, socket_address = socket.getaddrinfo(
            *address, type=socket.SOCK_STREAM
        )[0]
        with socket.socket(family, kind, number) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind(socket_address)
    except OSError as error:
        holder = None if settings is None else holder_of(settings)
        if holder is not None and endpoint in holder[1]:
            return f"{where} is in use by this cell's running daemon, process {holder[0]}"
        raise ExplainedError(f"{where}: {in_words(error)}") from None
    return f"{where} is free" + ", and other machines can reach it" * (not is_local(where))
