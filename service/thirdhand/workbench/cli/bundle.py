"""`thirdhand bundle`: one archive without secrets, for the person who is asked for help."""

from __future__ import annotations

import argparse
import contextlib
import io
import os
import re
import subprocess
import tarfile
import time
from collections.abc import Callable, Mapping, Sequence
from datetime import UTC, datetime
from importlib import metadata
from pathlib import Path

import msgspec

from thirdhand.cli.doctor import doctor
from thirdhand.cli.status import status
from thirdhand.cli.usage import check_writable, reaching
from thirdhand.contract.explain import ExplainedError, in_words
from thirdhand.recordings.mcap_file import machine
from thirdhand.recordings.shipped import cell_of
from thirdhand.scribe.paths import MB, named_after, stem_of
from thirdhand.settings.config import Settings, without_secrets
from thirdhand.settings.whole_file import whole

LOG_BYTES = 2_000_000
JOURNAL_LINES = 5000
JOURNAL_TIMEOUT_S = 20.0
_KEY = re.compile(
    r"-----BEGIN [A-Z ]*PRIVATE KEY-----.*?(-----END [A-Z ]*PRIVATE KEY-----|\Z)", re.DOTALL
)
_PARAMETERS = re.compile(r"""\b([a-z][\w+-]*/[^\s"'#]+)#[^\s"']*[^\s"',]""")
HEAD = """This archive holds no keys, certificates, parameters of endpoints or files of Zenoh.
Recordings show how hands and arm moved. Read it before you pass it on.\n\n"""


def bundle(args: argparse.Namespace) -> int:
    """Write the archive and print its content; exit code 0 also if the daemon does not answer."""
    settings = cell_of(str(args.config)) if args.config else None
    now = datetime.now(UTC)
    args.cell = args.cell or (settings or Settings()).cell
    args.connect = list(reaching(args, settings).connect)
    path = args.output or Path(f"thirdhand-{stem_of(args.cell)}-{now:%Y%m%dT%H%M%SZ}.tar.gz")
    check_writable(path)
    texts = _texts(args, settings)
    folder = (settings.files.record if settings else "") or _recorded_into(texts["status.json"])
    candidates = named_after(args.cell, Path(folder)) if folder else []
    recordings = _newest(candidates, args.minutes)
    about = _contents(texts, recordings)
    if not candidates:
        about += f"no recordings of cell {args.cell}: {_unfound(folder, settings)}\n"
    texts["README.txt"] = HEAD + about
    _write(path, {name: without_keys(text) for name, text in texts.items()}, recordings)
    print(f"{path}, {path.stat().st_size / MB:.1f} MB, holds\n{about}", end="")
    return 0


def _texts(args: argparse.Namespace, settings: Settings | None) -> dict[str, str]:
    """The texts in the archive, by the names of their files."""
    installed = {
        (package.metadata["Name"], package.version) for package in metadata.distributions()
    }
    texts = {
        "status.json": _printed(status, args, json=True, watch=False, exit_code=False),
        "doctor.txt": _printed(doctor, args, json=False, seconds=2.0),
        "versions.txt": "".join(
            f"{name}: {value}\n" for name, value in (*machine().items(), *sorted(installed))
        ),
        "log.txt": _log(args),
    }
    if settings:
        texts["settings.json"] = msgspec.json.encode(without_secrets(settings)).decode()
    return texts


def _recorded_into(status_text: str) -> str:
    """The folder into which the daemon with this status records; empty if it does not."""
    with contextlib.suppress(msgspec.DecodeError, KeyError, TypeError):
        return str(Path(msgspec.json.decode(status_text)["scribe"]["recording"]).parent)
    return ""


def _newest(recordings: Sequence[Path], minutes: float) -> Sequence[Path]:
    """The recordings that were written in the last minutes, or else the last one."""
    after_s = time.time() - 60 * minutes
    return [file for file in recordings if file.stat().st_mtime > after_s] or recordings[-1:]


def _unfound(folder: str, settings: Settings | None) -> str:
    """A message on the folder in which no recordings were found."""
    if folder:
        return f"in {folder}"
    origin = "[files] record" if settings else "--config"
    return f"neither a daemon that records nor {origin} names their folder"


def _contents(texts: Mapping[str, str], recordings: Sequence[Path]) -> str:
    """A line on each file in the archive, and on a status that is missing."""
    lines = [f"{name}: {len(text.encode()) / 1000:.1f} kB" for name, text in texts.items()]
    lines += (f"recordings/{file.name}: {file.stat().st_size / MB:.1f} MB" for file in recordings)
    if not texts["status.json"].startswith("{"):
        lines.append(f"no status: {without_keys(texts['status.json']).strip()}")
    return "".join(f"{line}\n" for line in lines)


def without_keys(text: str) -> str:
    """A text without private keys and without the parameters of endpoints."""
    return _PARAMETERS.sub(r"\1#(left out)", _KEY.sub("(a private key, left out)", text))


def _printed(
    command: Callable[[argparse.Namespace], int], args: argparse.Namespace, **more: object
) -> str:
    """The text that another command prints, or the reason why it failed."""
    with contextlib.redirect_stdout(io.StringIO()) as out:
        try:
            command(argparse.Namespace(**vars(args) | more))
        except (ExplainedError, OSError) as error:
            print(in_words(error))
    return out.getvalue()


def _log(args: argparse.Namespace) -> str:
    """The end of the log, from a file or from the journal of the cell's unit."""
    if args.log:
        with args.log.open("rb") as file:
            file.seek(max(0, file.seek(0, os.SEEK_END) - LOG_BYTES))
            return str(file.read(LOG_BYTES).decode(errors="replace"))
    unit = args.config.stem if args.config else stem_of(args.cell)
    command = [
        "journalctl",
        "--unit",
        f"thirdhand@{unit}",
        "--no-pager",
        "--lines",
        str(JOURNAL_LINES),
    ]
    try:
        done = subprocess.run(command, capture_output=True, timeout=JOURNAL_TIMEOUT_S, check=False)
    except (OSError, subprocess.TimeoutExpired) as error:
        return f"no journal: {in_words(error)}; --log FILE names a log\n"
    return (done.stdout + done.stderr).decode(errors="replace")


def _write(path: Path, texts: dict[str, str], recordings: Sequence[Path]) -> None:
    """Write the archive completely or not at all; a recording that still grows is cut."""
    with whole(path) as part:
        private = os.open(part, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600)
        with (
            open(private, "wb") as file,
            tarfile.open(fileobj=file, mode="w:gz", compresslevel=1) as archive,
        ):
            for name, text in texts.items():
                entry = tarfile.TarInfo(name)
                content = text.encode()
                entry.size = len(content)
                entry.mtime = time.time()
                archive.addfile(entry, io.BytesIO(content))
            for recording in recordings:
                archive.add(recording, f"recordings/{recording.name}")
