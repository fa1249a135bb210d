"""The page by which a headset's browser is the tracker: hands by WebXR, and the cell drawn around
the person.
"""

from __future__ import annotations

from service.trackers.hands_page import HandsPage

FRAME = "webxr"  # x to the right, y up, -z ahead of where the headset was when its floor was set, metres


class HeadsetPage(HandsPage):
    """The page and its server."""

    page, scripts, frame = "headset.html", ("link", "controls", "scene"), FRAME
