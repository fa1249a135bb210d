"""The library for clients of the daemon: connections, requests as calls, trackers, followers, and
the cells on a network. `import thirdhand` has the same names.
"""

from thirdhand.client.calls import Client
from thirdhand.client.client_settings import CLIENT_FILE, ClientSettings, client_settings
from thirdhand.client.connection import Connection, connect
from thirdhand.client.presence import Cell, Overheard, cells, living, why_silent
from thirdhand.client.replies import decoded
from thirdhand.client.session import (
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
from thirdhand.client.streams import (
    BRAKE_AFTER_S,
    ENCODINGS,
    Command,
    Follower,
    Publisher,
    Tracker,
    Watch,
    no_room_to_brake,
)
from thirdhand.contract.messages import SceneObject
from thirdhand.contract.requests import ViaPoint
from thirdhand.settings.file_content import SettingsError

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
    "Publisher",
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
    "why_silent",
]
