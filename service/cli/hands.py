"""`thirdhand hands`: the hands of a person for a cell, as a browser or a camera tracks them."""

from __future__ import annotations

import argparse
import socket

from service.cli.usage import UsageError, reached
from service.cli.web_address import serve_page, web_address
from service.client import Client, Tracker
from service.process.progress import say
from service.settings.network import is_local
from service.trackers.cell_view import Latest
from service.trackers.headset_page import HeadsetPage
from service.trackers.web_server import Address, ServerCertificate, server_certificate

ORDER_TIMEOUT_S = 5.0  # a page waits for the answer to its order for this long
ANY_HOST = ("0.0.0.0", "::")
LOOPBACK_NAMES = {"localhost", "127.0.0.1", "::1"}


def hands(args: argparse.Namespace) -> int:
    """Publish hands until Ctrl-C; exit code 0 if a video file or SIGTERM ends it."""
    return _camera(args) if args.camera is not None else _web(args)


def _camera(args: argparse.Namespace) -> int:
    from service.trackers.camera import HandCamera, mediapipe, publish  # slow imports, which only this source needs
    from service.trackers.hand_model import hand_model

    mediapipe()  # before the model is downloaded
    with (
        HandCamera(hand_model(args.model, say), view_deg=args.view, hand_length=args.hand_length) as camera,
        reached(args, None) as session,
        Tracker(session, args.cell, timeout_s=None) as tracker,
    ):
        say(f"publishing the hands that camera {args.camera} sees; Ctrl-C ends it")
        publish(tracker, camera, args.camera, say)
    return 0


def _web(args: argparse.Namespace) -> int:
    listen = web_address("--listen", args.listen)
    certificate = server_certificate(args.https) if args.https else None
    if certificate is None and not is_local(f"tcp/{listen}"):
        raise UsageError(
            f"--listen {listen}: browsers track hands by HTTPS only, except on this machine: --https DIR with the "
            "folder `headset` of `thirdhand certificates` needed, or 127.0.0.1 and a cable (`adb reverse`)"
        )
    with reached(args, None) as session, Tracker(session, args.cell, timeout_s=None) as tracker:
        client = Client(session, args.cell, timeout_s=ORDER_TIMEOUT_S)
        page = HeadsetPage(tracker, client, Latest(session, args.cell), cell=args.cell, certificate=certificate)

        def listening(address: Address) -> None:
            shown = Address(_name_for_browsers(address.host, certificate), address.port)
            print(f"{page.server.scheme}://{shown}/?token={page.server.token}", flush=True)
            if certificate is None:
                say(f"for a headset on a cable: adb reverse tcp:{address.port} tcp:{address.port}")
            else:
                say("the browser will warn of a certificate that it does not know: continue nevertheless")
            say("open this address in the headset's browser, press Start, and hold both hands in view; Ctrl-C ends it")

        try:
            serve_page(page.server, "--listen", listen, listening)
        finally:
            found = page.hands
            say(f"{found.published} messages with hands published, {found.lost} lost, {found.delayed} too late")
    return 0


def _name_for_browsers(host: str, certificate: ServerCertificate | None) -> str:
    """The host in the page's address: of a server at all addresses, a name in its certificate."""
    if host not in ANY_HOST or certificate is None:
        return host
    names = sorted(certificate.names - LOOPBACK_NAMES - {socket.gethostname()})
    return names[0] if names else socket.gethostname()
