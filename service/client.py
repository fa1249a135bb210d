"""What a client of the daemon needs: a Zenoh session that announces nothing, and its requests as
plain calls.
"""

from __future__ import annotations

import datetime
import json
import os
import re
import time
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import zenoh

from service.contract import channels, requests
from service.contract.explain import ExplainedError

CERTIFICATE, KEY, AUTHORITY = "certificate.pem", "key.pem", "authority.pem"  # in the folder of a role
ENDPOINTS_TIMEOUT_S = 30.0  # a machine that is busy answers late


class UnreachableError(ExplainedError, OSError):
    """No Zenoh session, or nobody answers."""


class RefusedError(ExplainedError, ValueError):
    """The daemon's answer to a request that it did not carry out."""


def open_session(
    *,
    connect: Sequence[str] = (),
    listen: Sequence[str] = (),
    timeout_s: float = 10.0,
    certificate: str | Path | None = None,
    more: Mapping[str, Any] | None = None,
) -> zenoh.Session:
    """An open Zenoh session between named endpoints, without scouting; `more` of Zenoh's settings.

    `certificate` is a folder that `thirdhand certificates` made for a role, for endpoints that
    begin with `tls/`; where it is None, the one that $THIRDHAND_CERTIFICATE names is taken. Close
    the session. Raises UnreachableError.
    """
    config = zenoh.Config()
    settings: dict[str, Any] = {
        "mode": "peer",
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        "listen/endpoints": list(listen),
        "connect/endpoints": list(connect),
        "connect/timeout_ms": int(timeout_s * 1000),
        "connect/exit_on_failure": True,
        "connect/retry": {"period_init_ms": 100, "period_max_ms": 1000, "period_increase_factor": 2},
        "listen/exit_on_failure": True,
        "adminspace/enabled": bool(listen),
        "transport/shared_memory/enabled": False,  # it does not pay, and passes by all bounds on what comes in
        **_tls(certificate or os.environ.get("THIRDHAND_CERTIFICATE")),
        **(more or {}),
    }
    try:
        for name, value in settings.items():
            config.insert_json5(name, json.dumps(value))
        return zenoh.open(config)
    except zenoh.ZError as error:
        reason = str(error).split(" at ")[0]
        wrong = next(
            (
                endpoint
                for endpoint in (*connect, *listen)
                if not re.match(r"[a-z]+/.+:.+|unixsock-stream/.+", endpoint)
            ),
            None,
        )
        if wrong is not None:
            how = f"connect to {wrong}" if wrong in connect else f"listen on {wrong}"
            raise UnreachableError(
                f"cannot {how}: an endpoint of the form <protocol>/<address>, like tcp/127.0.0.1:7447, needed"
            ) from None
        if connect and "connect" in reason:
            secured = any(endpoint.startswith("tls/") for endpoint in connect)
            raise UnreachableError(
                f"nobody answers at {', '.join(connect)}: is a daemon running and listening there, and not overrun?"
                + " And is the certificate that was given, if any, of the daemon's authority, and the daemon's own "
                "not expired?" * secured
            ) from None
        raise UnreachableError(f"cannot listen on {', '.join(listen)}: {reason}") from None


def _tls(folder: str | Path | None) -> dict[str, Any]:
    """Zenoh's settings for mutual TLS by the certificate in a folder, if there is one.

    Raises UnreachableError where it is incomplete.
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
    return {f"transport/link/tls/{name}": value for name, value in settings.items()}


def _check_dates(path: Path) -> None:
    """Raises UnreachableError where a certificate is not valid now: Zenoh says nothing of why a
    connection fails.
    """
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
    """The endpoints at which a session really listens, with the ports that it was given."""
    for reply in session.get(f"@/{session.zid()}/*", timeout=ENDPOINTS_TIMEOUT_S):
        if reply.ok is not None:
            return tuple(json.loads(reply.ok.payload.to_bytes())["locators"])
    return ()


class Client:
    """A running daemon's requests as calls.

    Each raises RefusedError with the daemon's words, or UnreachableError where nobody answers.
    """

    def __init__(self, session: zenoh.Session, cell: str = "thirdhand", *, timeout_s: float = 10.0) -> None:
        self._session = session
        self._cell = cell
        self._timeout_s = timeout_s

    def ask(self, suffix: str, request: Any = None) -> dict[str, Any]:
        """The reply to one request; `request` is anything that becomes JSON."""
        payload = requests.encode_json({} if request is None else request)
        if len(payload) > channels.LARGEST_REQUEST:
            raise RefusedError(f"a request of {len(payload)} bytes, at most {channels.LARGEST_REQUEST} accepted")
        for reply in self._session.get(channels.key(self._cell, suffix), payload=payload, timeout=self._timeout_s):
            if reply.ok is not None:
                answer: dict[str, Any] = json.loads(reply.ok.payload.to_bytes())
                return answer
            text = reply.err.payload.to_bytes().decode(errors="replace") if reply.err is not None else "no reason given"
            if text != "Timeout":
                raise RefusedError(text)
        raise UnreachableError(
            f"nobody answers on {channels.key(self._cell, suffix)}: "
            "is the daemon running there, and is the cell's name right?"
        )

    def status(self) -> dict[str, Any]:
        """What `<cell>/status` carries."""
        return self.ask("status")

    def add(self, points: Iterable[requests.ViaPoint], *, tolerance: float = requests.TOLERANCE_M) -> dict[str, Any]:
        """Teaches via-points; returns once they are in force."""
        return self.ask("via_points", requests.Add(tuple(points), tolerance))

    def wait_until_ready(self, *, timeout_s: float = 15.0) -> dict[str, Any]:
        """The status, once a daemon answers on this cell."""
        end = time.monotonic() + timeout_s
        while True:
            try:
                return self.status()
            except UnreachableError:
                if time.monotonic() > end:
                    raise
                time.sleep(0.05)
