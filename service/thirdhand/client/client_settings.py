"""The settings by which a client reaches its cell: arguments, else the environment, else a file."""

from __future__ import annotations

import contextlib
import os
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import msgspec
import zenoh

from thirdhand.client.session import open_session
from thirdhand.contract.channels import ENDPOINT, CellName, lacking
from thirdhand.contract.explain import InvalidError, in_words, validated
from thirdhand.settings.file_content import (
    SettingsError,
    UnreadableError,
    UnusableError,
    text_in,
    toml_in,
)
from thirdhand.settings.user_folder import HomelessError, user_folder

CLIENT_FILE = (
    "$XDG_CONFIG_HOME/thirdhand/client.toml, ~/.config/thirdhand/client.toml where that is not set"
)

Endpoints = Annotated[
    tuple[str, ...], msgspec.Meta(extra={"accepted": "an endpoint, or a list of them,"})
]


class ClientSettings(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The settings by which a client reaches its cell."""

    # the first that answers is used; none: those of `zenoh_config`, else ENDPOINT
    connect: Endpoints = ()
    cell: CellName = "thirdhand"  # prefix of all keys
    certificate: str = ""  # the folder of the client's role; empty: none
    zenoh_config: str = ""  # a file with Zenoh's own settings; empty: none

    def __post_init__(self) -> None:
        for i, endpoint in enumerate(self.connect):
            if lacks := lacking(endpoint):
                raise ValueError(f"$.connect[{i}]: {lacks}")
        if {".", ".."} & set(self.cell.split("/")):
            raise ValueError(
                f"$.cell: {self.cell!r} given; no . or .. between the slashes accepted"
            )

    def session(self, *, timeout_s: float | None = 10.0, at_once: bool = False) -> zenoh.Session:
        """A session to the daemon, recorder or router, as `open_session` opens it."""
        return open_session(
            connect=self.connect,
            otherwise=[ENDPOINT],
            timeout_s=timeout_s,
            certificate=self.certificate,
            zenoh_config=self.zenoh_config,
            at_once=at_once,
        )


def client_settings(
    *,
    connect: Sequence[str] | None = None,
    cell: str | None = None,
    certificate: str | Path | None = None,
    zenoh_config: str | Path | None = None,
) -> ClientSettings:
    """The settings of a client. An argument that is None is taken from $THIRDHAND_CONNECT
    (endpoints separated by commas), $THIRDHAND_CELL, $THIRDHAND_CERTIFICATE or
    $THIRDHAND_ZENOH_CONFIG, else from the file thirdhand/client.toml in $XDG_CONFIG_HOME, by
    default ~/.config, else it has its default.

    Raises SettingsError, which names the wrong file, variable or option.
    """
    path = _file()
    settings = {} if path is None else _checked(str(path), _read(path))
    options = {
        "connect": list(connect or ()),
        "cell": cell,
        "certificate": certificate,
        "zenoh_config": zenoh_config,
    }
    for name, option in options.items():
        if text := os.environ.get(variable := f"THIRDHAND_{name.upper()}"):
            listed = [part.strip() for part in text.split(",")] if name == "connect" else text
            settings |= _checked(f"${variable}", {name: listed})
        if option or option == "":
            settings |= _checked(
                f"--{name.replace('_', '-')}", {name: option if name == "connect" else str(option)}
            )
    return msgspec.convert(settings, ClientSettings)


def _checked(origin: str, given: dict[str, Any]) -> dict[str, Any]:
    """Return the given values if they are valid. Raises SettingsError."""
    try:
        validated(given, ClientSettings)
    except InvalidError as error:
        problems = str(error)
        if origin.startswith(("$", "-")):  # a variable or an option already names the value
            problems = re.sub(rf"(?m)^{next(iter(given))}(, entry \d+)?: ", "", problems)
        raise SettingsError(f"{origin}: {problems}") from None
    return given


def _file() -> Path | None:
    """The client's file, if there is one."""
    with contextlib.suppress(HomelessError):
        path = user_folder("config") / "client.toml"
        return path if path.exists() else None
    return None


def _read(path: Path) -> dict[str, Any]:
    """The content of a client's file; relative paths start from its folder. Raises
    SettingsError.
    """
    try:
        content = toml_in(text_in(path))
    except (OSError, UnusableError) as error:
        raise UnreadableError(
            f"cannot read client settings {path}: {in_words(error, named=False)}"
        ) from None
    except ValueError as error:
        raise SettingsError(f"{path}: {error}") from None
    if isinstance(content.get("connect"), str):
        content["connect"] = [content["connect"]]
    for name in ("certificate", "zenoh_config"):
        if isinstance(value := content.get(name), str) and value and not value.startswith("~"):
            content[name] = str(path.parent / value)
    return content
