"""`thirdhand hands`: the hands of a person for a cell, as a browser or a camera tracks them."""

from __future__ import annotations

import argparse
import contextlib
import os
import re
import secrets
import signal
import string
import sys
import webbrowser
from pathlib import Path

from thirdhand.cli.usage import UsageError, reached
from thirdhand.client import Client, Tracker
from thirdhand.client.hands import Hands
from thirdhand.contract.explain import ExplainedError, in_words
from thirdhand.process.own_class import explained, own_class
from thirdhand.process.progress import say
from thirdhand.settings.file_content import begin_of
from thirdhand.settings.network import is_local
from thirdhand.settings.user_folder import user_folder
from thirdhand.workbench.cli.web_address import serve_page, web_address
from thirdhand.workbench.trackers.address import Address
from thirdhand.workbench.trackers.cell_view import Latest
from thirdhand.workbench.trackers.hands_page import HandsPage, HeadsetPage
from thirdhand.workbench.trackers.lead import Lead
from thirdhand.workbench.trackers.mouse_page import MousePage
from thirdhand.workbench.trackers.pinch import Pinches
from thirdhand.workbench.trackers.web_server import server_certificate

ORDER_TIMEOUT_S = 5.0  # a page waits for the answer to its order for this long
TOKEN_FILE = "page-token"  # in the user's folder: open pages connect again after a restart
TOKEN_LETTERS = string.ascii_lowercase + string.digits
TOKEN_LENGTH = 12  # 62 bits, and few enough to type on a headset


def hands(args: argparse.Namespace) -> int:
    """Publish hands until Ctrl-C; exit code 0 if a video file or SIGTERM ends it."""
    before = signal.signal(signal.SIGTERM, lambda *_: sys.exit(0))
    try:
        if args.own:
            return _own(args)
        return _camera(args) if args.camera is not None else _web(args)
    finally:
        signal.signal(signal.SIGTERM, before)


def _own(args: argparse.Namespace) -> int:
    kind = own_class(args.own, Hands)
    with reached(args, None) as session, explained(kind):
        say(f"publishing the hands of {args.own}; Ctrl-C ends it")
        kind().publish(session, args.cell, is_over=lambda: False)
    return 0


def _camera(args: argparse.Namespace) -> int:
    from thirdhand.workbench.trackers.camera import (  # slow imports, which only this source needs
        HandCamera,
        mediapipe,
        publish,
    )
    from thirdhand.workbench.trackers.hand_model import hand_model

    for file in (args.model, Path(args.camera)):
        if file is not None and file.is_file():
            begin_of(file)
    mediapipe()  # before the model is downloaded
    with (
        HandCamera(
            hand_model(args.model, say), view_deg=args.view, hand_length=args.hand_length
        ) as camera,
        reached(args, None) as session,
        Tracker(session, args.cell, timeout_s=None) as tracker,
    ):
        say(f"publishing the hands that camera {args.camera} sees; Ctrl-C ends it")
        publish(tracker, camera, args.camera, say)
    return 0


def _web(args: argparse.Namespace) -> int:
    listen = web_address("--listen", args.listen)
    certificate = server_certificate(args.https, user_folder("state")) if args.https else None
    if certificate is None and args.web and not is_local(f"tcp/{listen}"):
        raise UsageError(
            f"--listen {listen}: browsers track hands by HTTPS only, except on this machine: "
            "--https NAME with the name or address of this machine needed, or 127.0.0.1 and a "
            "cable (`adb reverse`)"
        )
    with reached(args, None) as session, Tracker(session, args.cell, timeout_s=None) as tracker:
        client = Client(session, args.cell, timeout_s=ORDER_TIMEOUT_S)
        served = {"cell": args.cell, "certificate": certificate, "token": _token()}
        page: HandsPage
        if args.mouse:
            page = MousePage(tracker, client, Latest(session, args.cell), **served)
        else:
            pinches = Pinches(
                session, args.cell, clutch=args.pinch_clutch, gripper=args.pinch_gripper
            )
            latest = Latest(session, args.cell)
            lead = Lead(session, args.cell, args.lead, latest) if args.lead else None
            page = HeadsetPage(tracker, client, latest, pinches=pinches, lead=lead, **served)

        def listening(address: Address) -> None:
            page_address = Address(certificate.name, address.port) if certificate else address
            url = f"{page.server.scheme}://{page_address}/?token={page.server.token}"
            print(url, flush=True)
            if args.mouse:
                invite(url, address, browser=args.open)
                return
            if certificate is None:
                say(f"for a headset on a cable: adb reverse tcp:{address.port} tcp:{address.port}")
            else:
                say(
                    "the browser will warn of a certificate that it does not know: continue "
                    "nevertheless"
                )
            say(
                "open this address in the headset's browser, press Start, and hold both hands in "
                "view; Ctrl-C ends it"
            )

        try:
            serve_page(page.server, "--listen", listen, listening)
        finally:
            counters = page.hands
            say(
                f"{counters.published} messages with hands published, {counters.lost} lost, "
                f"{counters.delayed} too late"
            )
    return 0


def invite(url: str, address: Address, *, browser: bool, to_do: str = "drag both hands") -> None:
    """Print what to do on a page, and open it if `browser`."""
    if not is_local(f"tcp/{address}"):
        say("everyone who has this address with its token, and reaches it, can move the arm")
    if browser and webbrowser.open(url):
        say(f"the page opens in your browser: {to_do} there; Ctrl-C ends it")
    else:
        say(f"open this address in a browser, and {to_do} there; Ctrl-C ends it")


def _token() -> str:
    """The token of this user's pages, from a private file; a new one if that cannot be kept."""
    new = "".join(secrets.choice(TOKEN_LETTERS) for _ in range(TOKEN_LENGTH))
    try:
        path = user_folder("state") / TOKEN_FILE
        path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        with contextlib.suppress(FileExistsError):
            private = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
            with open(private, "w", encoding="utf-8") as file:
                file.write(new)
        token = path.read_text(encoding="utf-8").strip()
    except (OSError, UnicodeDecodeError) as error:
        say(
            f"the token of this start is not kept ({in_words(error)}): open pages need the new "
            "address"
        )
        return new
    if not re.fullmatch(f"[{TOKEN_LETTERS}]{{{TOKEN_LENGTH},}}", token):
        raise ExplainedError(
            f"{path}: {TOKEN_LENGTH} or more small letters and digits needed; delete it for a new "
            "one"
        )
    return token
