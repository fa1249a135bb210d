"""The library for clients of the daemon: sessions, requests as calls, trackers, followers, and the
cells on a network.
"""

from service.client.calls import Client
from service.client.client_settings import CLIENT_FILE, ClientSettings, client_settings
from service.client.presence import Cell, Overheard, cells, living, why_silent
from service.client.replies import decoded
from service.client.session import (
    AUTHORITY,
    CERTIFICATE,
    KEY,
    RefusedError,
    StartingError,
    UnreachableError,
    endpoints,
    open_session,
)
from service.client.streams import BRAKE_AFTER_S, ENCODINGS, Command, Follower, Tracker, no_room_to_brake, publisher

__all__ = [
    "AUTHORITY",
    "BRAKE_AFTER_S",
    "CERTIFICATE",
    "CLIENT_FILE",
    "ENCODINGS",
    "KEY",
    "Cell",
    "Client",
    "ClientSettings",
    "Command",
    "Follower",
    "Overheard",
    "RefusedError",
    "StartingError",
    "Tracker",
    "UnreachableError",
    "cells",
    "client_settings",
    "decoded",
    "endpoints",
    "living",
    "no_room_to_brake",
    "open_session",
    "publisher",
    "why_silent",
]
