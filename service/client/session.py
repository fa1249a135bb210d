"""Zenoh sessions between named endpoints, without scouting."""

from __future__ import annotations

import datetime
import json
import os
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import zenoh

from service.contract.explain import ExplainedError

CERTIFICATE, KEY, AUTHORITY = "certificate.pem", "key.pem", "authority.pem"  # in the folder of a role
ENDPOINTS_TIMEOUT_S = 30.0  # a busy machine answers late


class UnreachableError(ExplainedError, OSError):
    """There is no Zenoh session, or nobody answers."""


class RefusedError(ExplainedError, ValueError):
    """The daemon refused a request; the message is its answer."""


def open_session(
    *,
    connect: Sequence[str] = (),
    listen: Sequence[str] = (),
    otherwise: Sequence[str] = (),
    timeout_s: float = 10.0,
    certificate: str | Path | None = None,
    zenoh_config: str | Path | None = None,
    more: Mapping[str, Any] | None = None,
) -> zenoh.Session:
    """An open Zenoh session between named endpoints, without scouting; `more` of Zenoh's settings.

    A session that only connects is a client of the first endpoint that answers. (Peers do not meet
    through a router.) One that listens is a peer, or a router if it connects too. A `mode` in
    `zenoh_config`, a file of Zenoh's own, overrides that; all else set here overrides the file. A
    client without `connect` takes the file's endpoints, or else those in `otherwise`.

    `certificate` is a folder that `thirdhand certificates` made for a role, for endpoints that
    begin with `tls/`. Where one of the two is None, $THIRDHAND_CERTIFICATE or
    $THIRDHAND_ZENOH_CONFIG is used. The caller closes the session. Raises UnreachableError.
    """
    config = _zenoh_config(zenoh_config or os.environ.get("THIRDHAND_ZENOH_CONFIG"))
    if otherwise and not connect and not listen:
        connect = _endpoints_in(config) or otherwise
    role = ("router" if connect else "peer") if listen or not connect else "client"
    settings: dict[str, Any] = {
        "mode": json.loads(config.get_json("mode")) or role,
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        "listen/endpoints": list(listen),
        "connect/endpoints": list(connect),
        "connect/timeout_ms": int(timeout_s * 1000),
        "connect/exit_on_failure": True,
        "connect/retry": {"period_init_ms": 100, "period_max_ms": 1000, "period_increase_factor": 2},
        "listen/exit_on_failure": True,
        "adminspace": {"enabled": bool(listen), "permissions": {"read": True, "write": False}},
        "plugins_loading/enabled": False,
        "namespace": None,  # the contract's keys are absolute
        "transport/shared_memory/enabled": False,  # no faster here, and it bypasses all bounds on messages
        **_tls(certificate or os.environ.get("THIRDHAND_CERTIFICATE")),
        **(more or {}),
    }
    try:
        for name, value in settings.items():
            config.insert_json5(name, json.dumps(value))
        return zenoh.open(config)
    except zenoh.ZError as error:
        raise UnreachableError(_why_not(str(error).split(" at ")[0], connect, listen)) from None


def _why_not(reason: str, connect: Sequence[str], listen: Sequence[str]) -> str:
    """The reason why there is no session between these endpoints, in words."""
    form = r"[a-z]+/.+:.+|unixsock-stream/.+"
    wrong = next((endpoint for endpoint in (*connect, *listen) if not re.match(form, endpoint)), None)
    if wrong is not None:
        how = f"connect to {wrong}" if wrong in connect else f"listen on {wrong}"
        return f"cannot {how}: an endpoint of the form <protocol>/<address>, like tcp/127.0.0.1:7447, needed"
    if connect and "connect" in reason:
        secured = any(endpoint.startswith("tls/") for endpoint in connect)
        return (
            f"nobody answers at {', '.join(connect)}: "
            "is a daemon running and listening there, or a router, and not overrun?"
            + " And is the certificate that was given, if any, of the daemon's authority, and the daemon's own "
            "not expired?" * secured
        )
    return f"cannot listen on {', '.join(listen)}: {reason}" if listen else f"no Zenoh session: {reason}"


def _zenoh_config(path: str | Path | None) -> zenoh.Config:
    """The configuration in a file of Zenoh's own, or Zenoh's defaults. Raises UnreachableError."""
    if not path:
        return zenoh.Config()
    try:
        file = Path(path).expanduser()
        file.read_bytes()
        return zenoh.Config.from_file(file)
    except (OSError, RuntimeError, zenoh.ZError) as error:
        reason = error.strerror if isinstance(error, OSError) else " ".join(str(error).split())
        raise UnreachableError(f"cannot read the Zenoh configuration {path}: {reason}") from None


def _endpoints_in(config: zenoh.Config) -> tuple[str, ...]:
    """The endpoints to connect to in a configuration, for every mode or for clients."""
    found = json.loads(config.get_json("connect/endpoints"))
    return tuple(found.get("client") or () if isinstance(found, dict) else found or ())


def _tls(folder: str | Path | None) -> dict[str, Any]:
    """Zenoh's settings for mutual TLS with the certificate in a folder; empty without a folder.

    Raises UnreachableError where the folder is incomplete.
    """
    if not folder:
        return {}
    try:
        own, key, authority = (Path(folder).expanduser() / name for name in (CERTIFICATE, KEY, AUTHORITY))
    except RuntimeError:
        raise UnreachableError(f"certificate {folder}: there is no such user's folder") from None
    for path in (own, key, authority):
        if not os.access(path, os.R_OK):
            raise UnreachableError(f"cannot read {path}: a folder made by `thirdhand certificates` needed")
    _check_dates(own)
    _check_dates(authority)
    settings: dict[str, Any] = {"enable_mtls": True, "root_ca_certificate": str(authority)}
    for side in ("listen", "connect"):
        settings |= {f"{side}_certificate": str(own), f"{side}_private_key": str(key)}
    settings |= {"verify_name_on_connect": True, "close_link_on_expiration": True}
    return {"transport/link/tls": settings}  # replaces any other TLS settings


def _check_dates(path: Path) -> None:
    """Raises UnreachableError for a certificate that is not valid now, as Zenoh gives no reason."""
    from cryptography import x509  # most sessions need no certificate

    try:
        certificate = x509.load_pem_x509_certificate(path.read_bytes())
    except ValueError as error:
        raise UnreachableError(f"{path} does not hold a certificate: {error}") from None
    begin, end = certificate.not_valid_before_utc, certificate.not_valid_after_utc
    now = datetime.datetime.now(datetime.UTC)
    if now > end:
        raise UnreachableError(
            f"{path} expired on {end:%Y-%m-%d %H:%M} UTC: a new certificate needed, by `thirdhand certificates`"
        )
    if now < begin:
        raise UnreachableError(
            f"{path} is valid from {begin:%Y-%m-%d %H:%M} UTC on, and the clock here says {now:%Y-%m-%d %H:%M}: "
            "is that right?"
        )


def endpoints(session: zenoh.Session) -> tuple[str, ...]:
    """The endpoints at which a session listens, with the ports that the system assigned."""
    for reply in session.get(f"@/{session.zid()}/*", timeout=ENDPOINTS_TIMEOUT_S):
        if reply.ok is not None:
            return tuple(json.loads(reply.ok.payload.to_bytes())["locators"])
    return ()
