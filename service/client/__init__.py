"""The library for clients of the daemon: connections, requests as calls, trackers, followers, and
the cells on a network. `import thirdhand` has the same names.
"""

from service.client.calls import Client
from service.client.client_settings import CLIENT_FILE, ClientSettings, client_settings
from service.client.connection import Connection, connect
from service.client.presence import Cell, Overheard, cells, living, why_silent
from service.client.replies import decoded
from service.client.session import (
    AUTHORITY,
    CERTIFICATE,
    KEY,
    RefusedError,
    StartingError,
    UncertainError,
    UnreachableError,
    endpoints,
    open_session,
)
from service.client.streams import (
    BRAKE_AFTER_S,
    ENCODINGS,
    Command,
    Follower,
    Tracker,
    Watch,
    no_room_to_brake,
    publisher,
)
from service.contract.messages import SceneObject
from service.contract.requests import ViaPoint
from service.settings.file_content import SettingsError

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
    "Connection",
    "Follower",
    "Overheard",
    "RefusedError",
    "SceneObject",
    "SettingsError",
    "StartingError",
    "Tracker",
    "UncertainError",
    "UnreachableError",
    "ViaPoint",
    "Watch",
    "cells",
    "client_settings",
    "connect",
    "decoded",
    "endpoints",
    "living",
    "no_room_to_brake",
    "open_session",
    "publisher",
    "why_silent",
]
