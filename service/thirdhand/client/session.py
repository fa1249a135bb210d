"""Zenoh sessions between named endpoints, without multicast discovery."""

from __future__ import annotations

import codecs
import json
import os
import re
import socket
import ssl
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any, TypeVar

import zenoh

from thirdhand.contract.channels import lacking, tcp_address
from thirdhand.contract.explain import ExplainedError, in_words
from thirdhand.settings.file_content import LARGEST_CONFIGURATION, UnusableError, content

# files in the folder of a role
CERTIFICATE = "certificate.pem"
KEY = "key.pem"
AUTHORITY = "authority.pem"
FOLDER_NEEDED = f"a folder with {CERTIFICATE}, {KEY} and {AUTHORITY} needed"
ENDPOINTS_TIMEOUT_S = 30.0  # on a busy machine Zenoh answers late
ATTEMPT_S = 1.0  # timeout of one attempt
RETRY_S = 0.05  # pause before the next attempt
SERVER_PROBLEMS = {  # by OpenSSL's code of a failed verification; others: another authority
    9: "is not valid yet by the clock of this machine",
    10: "has expired",
    26: "is that of another role",
    62: "is not for this name",
    64: "is not for this address",
}
CLIENT_PROBLEMS = {  # by the alert of TLS that the server sends
    **dict.fromkeys(("UNKNOWN_CA", "DECRYPT_ERROR"), "is not from the authority there"),
    **dict.fromkeys(
        ("BAD_CERTIFICATE", "CERTIFICATE_UNKNOWN", "CERTIFICATE_REQUIRED"), "is not valid there"
    ),
    "CERTIFICATE_EXPIRED": "has expired by the clock there",
}
FIXED_SETTINGS: dict[str, Any] = {  # of Zenoh, for every session
    "scouting/multicast/enabled": False,
    "scouting/gossip/enabled": False,
    "connect/exit_on_failure": True,
    "connect/retry": {"period_init_ms": 100, "period_max_ms": 200, "period_increase_factor": 2},
    "listen/exit_on_failure": True,
    "plugins_loading/enabled": False,
    "namespace": None,  # the contract's keys are absolute
    # [batches] A tick publishes up to four messages, each a batch of its own. With Zenoh's 2,
    # `put` waits for the thread that sends, for 1 ms, and drops the message.
    "transport/link/tx/queue/size/real_time": 16,
    # it is not faster here, and it bypasses the bounds on messages
    "transport/shared_memory/enabled": False,
}
_zenoh_pids: set[int] = set()  # this process once Zenoh runs threads in it; a fork has none
Attempted = TypeVar("Attempted")


class UnreachableError(ExplainedError, OSError):
    """No Zenoh session can be opened, or no daemon answers."""


class CertificateError(UnreachableError):
    """A certificate is missing, wrong or not valid now; waiting does not help."""


class StartingError(UnreachableError):
    """The daemon is not ready yet; the message has the progress of its start."""


class UncertainError(UnreachableError):
    """No answer to a request arrived, and it may have been carried out."""


class RefusedError(ExplainedError, ValueError):
    """The daemon refused a request; the message is its answer."""


def open_session(
    *,
    connect: Sequence[str] = (),
    listen: Sequence[str] = (),
    otherwise: Sequence[str] = (),
    timeout_s: float | None = 10.0,
    certificate: str | Path | None = None,
    zenoh_config: str | Path | None = None,
    more: Mapping[str, Any] = MappingProxyType({}),
    at_once: bool = False,
) -> zenoh.Session:
    """An open Zenoh session between named endpoints; `more` has further settings of Zenoh.

    A session that only connects is a client of the first endpoint that answers, because peers do
    not meet through a router. A session that listens is a peer, or a router if it also connects. A
    `mode` in the file `zenoh_config` overrides that; all other settings here override the file. A
    client without `connect` takes the file's endpoints, or else those in `otherwise`.

    Opening is tried for `timeout_s` [s]. None, for a session that only connects: until Ctrl-C, with
    one message on standard error, so that programs may be started in any order. With `at_once`, the
    call fails immediately if the system reports that nothing listens, or that there is no way.

    `certificate` is the folder of a role, for endpoints that begin with `tls/`; None:
    $THIRDHAND_CERTIFICATE, empty: none. Without `zenoh_config`, $THIRDHAND_ZENOH_CONFIG is used.
    The caller closes the session. Raises UnreachableError, and CertificateError at once if TLS
    fails for a certificate.
    """
    _check_endpoints(connect, listen)
    config = _zenoh_config(zenoh_config or os.environ.get("THIRDHAND_ZENOH_CONFIG"))
    if otherwise and not connect and not listen:
        connect = _endpoints_in(config, otherwise)
    folder = os.environ.get("THIRDHAND_CERTIFICATE") if certificate is None else certificate
    settings = _settings(config, connect, listen, timeout_s) | _tls(folder) | dict(more)
    if at_once:
        _check_reachable(connect)

    def opened() -> zenoh.Session:
        try:
            return _opened(config, settings)
        except zenoh.ZError as error:
            if folder or not zenoh_config:  # else the file may have certificates of its own
                _check_certificates(connect, folder)
            raise UnreachableError(_why_not(str(error).split(" at ")[0], connect, listen)) from None

    return tried(opened, 0.0 if listen else timeout_s)


def _settings(
    config: zenoh.Config, connect: Sequence[str], listen: Sequence[str], timeout_s: float | None
) -> dict[str, Any]:
    """Zenoh's settings for a session between these endpoints, by name."""
    role = "client" if connect else "peer"
    if connect and listen:
        role = "router"
    attempt_s = ATTEMPT_S if timeout_s is None else timeout_s
    if not listen:
        attempt_s = min(attempt_s, ATTEMPT_S)  # Python notices Ctrl-C only between attempts
    return {
        **FIXED_SETTINGS,
        "mode": json.loads(config.get_json("mode")) or role,
        "listen/endpoints": list(listen),
        "connect/endpoints": list(connect),
        "connect/timeout_ms": int(1000 * attempt_s),
        "adminspace": {"enabled": bool(listen), "permissions": {"read": True, "write": False}},
    }


def _opened(config: zenoh.Config, settings: Mapping[str, Any]) -> zenoh.Session:
    """An open session with these settings. Raises zenoh.ZError."""
    for name, value in settings.items():
        config.insert_json5(name, json.dumps(value))
    _zenoh_pids.add(os.getpid())
    return zenoh.open(config)


def _check_endpoints(connect: Sequence[str], listen: Sequence[str]) -> None:
    """Raise UnreachableError for an endpoint that is not valid."""
    for how, endpoints_of_kind in (("connect to", connect), ("listen on", listen)):
        for endpoint in endpoints_of_kind:
            if lacks := lacking(endpoint):
                raise UnreachableError(f"cannot {how} {endpoint}: {lacks}")


def _check_reachable(connect: Sequence[str]) -> None:
    """Raise UnreachableError if the system connects to none of these endpoints."""
    if failed := _failures(connect):
        raise UnreachableError(
            _unreached(failed)
            or f"nothing listens at {', '.join(connect)}: is a daemon or a router running there?"
        )


def _check_certificates(connect: Sequence[str], folder: str | Path | None) -> None:
    """Raise CertificateError if TLS fails at one of these endpoints."""
    for endpoint in connect:
        if problem := tls_problem(endpoint, folder):
            raise CertificateError(problem) from None


def is_forked() -> bool:
    """True in a fork of a process that had opened a session: there, all of Zenoh hangs."""
    return bool(_zenoh_pids) and os.getpid() not in _zenoh_pids


def check_process() -> None:
    """Raise UnreachableError in such a fork."""
    if is_forked():
        raise UnreachableError(
            "this process was forked after a connection had been opened, so none works here: "
            'start it by multiprocessing.get_context("spawn"), or before the first connection'
        )


def check_open(session: zenoh.Session) -> None:
    """Raise UnreachableError for a session that was closed, or that another thread closes, and in a
    fork.
    """
    check_process()
    try:
        closed = session.is_closed()
    except RuntimeError:  # Zenoh has lent the session to the thread that closes it
        closed = True
    if closed:
        raise UnreachableError("the connection was closed in this program: open a new one")


def subscribed(
    session: zenoh.Session, expression: str, take: Callable[[zenoh.Sample], None]
) -> zenoh.Subscriber[None]:
    """A subscriber that calls `take` in Zenoh's thread: Python would wait, as a program ends, for
    the one that it makes for a plain function.
    """
    return session.declare_subscriber(expression, zenoh.handlers.Callback(take, indirect=False))


def _failures(endpoints: Sequence[str]) -> dict[str, OSError]:
    """The reasons why no endpoint can be reached, by endpoint; empty if one accepts or hangs."""
    failed: dict[str, OSError] = {}
    for endpoint in endpoints:
        if (address := tcp_address(endpoint)) is None:
            return {}
        try:
            socket.create_connection(address, timeout=ATTEMPT_S).close()
        except TimeoutError:
            return {}
        except OSError as error:
            failed[endpoint] = error
        else:
            return {}
    return failed


def _unreached(failed: Mapping[str, OSError]) -> str:
    """The failures other than refusals, in words; empty if there are none."""
    return "; ".join(
        f"{endpoint} cannot be reached: {in_words(error)}"
        for endpoint, error in failed.items()
        if not isinstance(error, ConnectionRefusedError)
    )


def tls_problem(endpoint: str, folder: str | Path | None) -> str:
    """The reason why a TLS handshake with an endpoint fails, in words; empty if it succeeds or
    fails for another cause. Zenoh itself gives no reason.

    In TLS 1.3 the server reports after the handshake that it refuses the client's certificate. At
    an endpoint of `tcp`, a handshake that succeeds is the problem.
    """
    if (address := tcp_address(endpoint)) is None:
        return ""
    is_plain = not endpoint.startswith("tls/")
    try:
        tls = _client_context(None if is_plain else folder)
        with (
            socket.create_connection(address, timeout=ATTEMPT_S) as plain,
            tls.wrap_socket(plain, server_hostname=address[0]) as secured,
        ):
            if is_plain:
                return (
                    f"{endpoint} accepts TLS only: tls/{endpoint.partition('/')[2]}, and a "
                    "certificate, needed"
                )
            secured.recv(1)
    except ssl.SSLCertVerificationError as error:
        words = SERVER_PROBLEMS.get(error.verify_code, f"is not from the authority in {folder}")
        return f"the certificate of the daemon or router at {endpoint} {words}"
    except ssl.SSLError as error:
        return "" if is_plain else _refusal(endpoint, folder, error)
    except OSError:
        pass
    return ""


def _client_context(folder: str | Path | None) -> ssl.SSLContext:
    """A client's TLS context with the certificate in a folder; without one, it verifies nothing."""
    tls = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    if folder:
        certificate, key, authority = (
            Path(folder).expanduser() / name for name in (CERTIFICATE, KEY, AUTHORITY)
        )
        tls.load_verify_locations(authority)
        tls.load_cert_chain(certificate, key)
    else:
        tls.check_hostname = False
        tls.verify_mode = ssl.CERT_NONE
    return tls


def _refusal(endpoint: str, folder: str | Path | None, error: ssl.SSLError) -> str:
    """The reason why a server refuses a client's certificate, in words; empty for other errors."""
    problem = CLIENT_PROBLEMS.get(str(error.reason).partition("ALERT_")[2], "")
    if folder or not problem:
        return problem and f"{endpoint} refuses the certificate in {folder}, which {problem}"
    return (
        f"{endpoint} requires a certificate, and none was given: the folder of your role "
        "needed, in $THIRDHAND_CERTIFICATE or in the file of client settings"
    )


def tried(
    attempt: Callable[[], Attempted], timeout_s: float | None, *, silent: bool | None = None
) -> Attempted:
    """The result of `attempt`, which is repeated while it raises UnreachableError.

    The error is raised after `timeout_s` [s], in which no start made progress; None: never. A
    CertificateError is raised at once. One message on standard error reports the waiting unless
    `silent`, which by default holds if there is a timeout.
    """
    check_process()
    begun_s = time.monotonic()
    reported = ""
    silent = timeout_s is not None if silent is None else silent
    while True:
        try:
            return attempt()
        except CertificateError:
            raise
        except UnreachableError as error:
            if isinstance(error, StartingError) and str(error) != reported:
                begun_s = time.monotonic()
            reported = str(error)
            waited_s = time.monotonic() - begun_s
            if timeout_s is not None and waited_s >= timeout_s:
                raise
            if not silent and waited_s > ATTEMPT_S / 2:
                _report_waiting(error, timeout_s)
                silent = True
            time.sleep(RETRY_S)


def _report_waiting(error: UnreachableError, timeout_s: float | None) -> None:
    until = "until Ctrl-C" if timeout_s is None else f"up to {timeout_s:g} s"
    print(f"waiting, {until}: {error}", file=sys.stderr, flush=True)


def _why_not(reason: str, connect: Sequence[str], listen: Sequence[str]) -> str:
    """A message with the reason why there is no session between these endpoints."""
    if connect and "connect" in reason:
        return _unreached(_failures(connect)) or (
            f"nobody answers at {', '.join(connect)}: is a daemon, `thirdhand record --listen` or "
            "a router listening there, and is it not overloaded?"
        )
    os_error = re.search(r"\(os error (\d+)\)", reason)
    words = (
        in_words(OSError(number := int(os_error[1]), os.strerror(number))) if os_error else reason
    )
    return (
        f"cannot listen on {', '.join(listen)}: {words}" if listen else f"no Zenoh session: {words}"
    )


def _zenoh_config(path: str | Path | None) -> zenoh.Config:
    """The configuration in a Zenoh file, or Zenoh's defaults. Raises UnreachableError."""
    if not path:
        return zenoh.Config()
    try:
        file = Path(path).expanduser()
        if content(file, LARGEST_CONFIGURATION).startswith(codecs.BOM_UTF8):
            raise UnusableError("Zenoh reads no byte order mark: save it as UTF-8 without one")
        return zenoh.Config.from_file(file)
    except (OSError, RuntimeError, UnusableError, zenoh.ZError) as error:
        reason = error.strerror if isinstance(error, OSError) else " ".join(str(error).split())
        raise UnreachableError(f"cannot read the Zenoh configuration {path}: {reason}") from None


def _endpoints_in(config: zenoh.Config, otherwise: Sequence[str]) -> Sequence[str]:
    """The endpoints to connect to in a configuration, for every mode or for clients; `otherwise`
    without any.
    """
    configured = json.loads(config.get_json("connect/endpoints"))
    if isinstance(configured, dict):
        configured = configured.get("client")
    return tuple(configured or ()) or otherwise


def _tls(folder: str | Path | None) -> dict[str, Any]:
    """Zenoh's settings for mutual TLS with the certificate in a folder; empty without a folder.

    Raises UnreachableError for an incomplete folder.
    """
    if not folder:
        return {}
    try:
        certificate, key, authority = (
            Path(folder).expanduser() / name for name in (CERTIFICATE, KEY, AUTHORITY)
        )
    except RuntimeError:
        raise UnreachableError(
            f"certificate {folder}: no user of this name has a folder here"
        ) from None
    for path in (certificate, key, authority):
        if not os.access(path, os.R_OK):
            raise UnreachableError(f"cannot read {path}: {FOLDER_NEEDED}")
    try:
        tls = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
        tls.load_verify_locations(authority)
        tls.load_cert_chain(certificate, key, password="none")
    except ssl.SSLError:
        raise UnreachableError(
            f"cannot use {certificate}, {key} and {authority}: certificates in PEM, and the key of "
            "the first without a password, needed"
        ) from None
    settings: dict[str, Any] = {"enable_mtls": True, "root_ca_certificate": str(authority)}
    for side in ("listen", "connect"):
        settings |= {f"{side}_certificate": str(certificate), f"{side}_private_key": str(key)}
    settings |= {"verify_name_on_connect": True, "close_link_on_expiration": True}
    return {"transport/link/tls": settings}  # replaces any other TLS settings


def check_files(certificate: str | Path, zenoh_config: str | Path) -> None:
    """Raise UnreachableError if `open_session` would refuse this folder or file; empty: none."""
    _zenoh_config(zenoh_config)
    _tls(certificate)


def endpoints(session: zenoh.Session) -> tuple[str, ...]:
    """The endpoints at which a session listens, with the ports that the system assigned."""
    for reply in session.get(f"@/{session.zid()}/*", timeout=ENDPOINTS_TIMEOUT_S):
        if reply.ok is not None:
            return tuple(json.loads(reply.ok.payload.to_bytes())["locators"])
    return ()
