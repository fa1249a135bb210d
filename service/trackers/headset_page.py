"""The page by which a headset's browser is the tracker: hands by WebXR, and the cell drawn around
the person.
"""

from __future__ import annotations

from service.client import Client, Tracker
from service.trackers.cell_view import Latest
from service.trackers.hands_page import HandsPage
from service.trackers.pinch import Pinches
from service.trackers.web_server import ServerCertificate

FRAME = "webxr"  # x to the right, y up, -z ahead of where the headset was when its floor was set, metres


class HeadsetPage(HandsPage):
    """The page and its server."""

    def __init__(
        self,
        tracker: Tracker,
        client: Client,
        latest: Latest,
        *,
        cell: str,
        certificate: ServerCertificate | None = None,
        token: str = "",
        pinches: Pinches | None = None,
    ) -> None:
        super().__init__(
            *(tracker, client, latest),
            cell=cell,
            page="headset.html",
            scripts=("link", "scene"),
            frame=FRAME,
            certificate=certificate,
            token=token,
            pinches=pinches,
        )
