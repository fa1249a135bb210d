"""Compiled code on disk: one file for each function, signature and processor.

Numba's own cache looks only at the file of a function, so a changed function that it calls, or a
changed constant that it imports, would stay as it was. Here the name of a file has a digest of the
function's module and of all modules of this project that it imports, directly or not. Checkouts and
installed versions with the same sources therefore share their files, wherever they are.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import itertools
import os
import pickle
import re
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numba
from numba import config
from numba.core.bytecode import FunctionIdentity
from numba.core.compiler import CompileResult
from numba.core.serialize import dumps


def _number_anew() -> None:
    """Give this process a range of its own for the numbers of compiled functions.

    A symbol of compiled code consists of the function's name, this number, and the numbers of
    types. Each process counts them, and a forked process continues from its parent's counts.
    Without a range of its own, two processes could give one symbol to different codes, and a third
    process, which loads both, would call the wrong code.
    """
    FunctionIdentity._unique_ids = itertools.count(int.from_bytes(os.urandom(6), "big") << 20)  # noqa: SLF001


_number_anew()
os.register_at_fork(after_in_child=_number_anew)

UNUSED_S = 90 * 86400.0  # a file that was not read for this time is removed
IMPORTS = re.compile(
    rb"^ *(?:from +([\w.]+) +import +(\([^)]*\)|.*)|import +([\w.]+))", re.MULTILINE
)
WORDS = re.compile(r"\w+")
_DIGEST_BYTES = 32


class CompiledCache:
    """The cache of one function, as a dispatcher of Numba uses it."""

    def __init__(self, function: Callable[..., Any], folder: Path) -> None:
        code = function.__code__
        sources = _sources_digest(Path(code.co_filename), function.__module__.partition(".")[0])
        name = f"{function.__module__}.{function.__qualname__}-{code.co_firstlineno}"
        python = f"{sys.implementation.cache_tag}, Numba {numba.__version__}"
        self._name = re.sub(r"[<>]", "", name)
        self._key = sources, python
        self._folder = folder

    @classmethod
    def of(cls, function: Callable[..., Any]) -> CompiledCache | None:
        """The cache of a function; None for a function without a file or with a closure, and where
        no folder can be written.
        """
        folder = cache_folder()
        is_cachable = function.__closure__ is None and Path(function.__code__.co_filename).is_file()
        return cls(function, folder) if folder is not None and is_cachable else None

    @property
    def cache_path(self) -> str:
        """The folder of the cache."""
        return str(self._folder)

    def load_overload(self, signature: Any, target: Any) -> CompileResult | None:
        """The function compiled for a signature; None if it is not cached, or damaged."""
        target.refresh()
        with contextlib.suppress(OSError):
            content = self._path(signature, target.codegen()).read_bytes()
            digest = content[:_DIGEST_BYTES]
            payload = content[_DIGEST_BYTES:]
            if hashlib.sha256(payload).digest() == digest:
                return CompileResult._rebuild(target, *pickle.loads(payload))  # noqa: SLF001
        return None

    def save_overload(self, signature: Any, result: CompileResult) -> None:
        """Write a function that was compiled for a signature; a full disk is no failure."""
        if result.lifted or result.library.has_dynamic_globals:
            return
        payload = dumps(result._reduce())  # noqa: SLF001
        path = self._path(signature, result.library.codegen)
        with contextlib.suppress(OSError):
            _remove_unused(self._folder)
            part = path.with_suffix(f".{os.getpid()}")
            try:
                part.write_bytes(hashlib.sha256(payload).digest() + payload)
                part.replace(path)
            finally:
                part.unlink(missing_ok=True)

    def flush(self) -> None:
        """Remove what is cached of this function."""
        for path in self._folder.glob(f"{self._name}-*"):
            path.unlink(missing_ok=True)

    def _path(self, signature: Any, codegen: Any) -> Path:
        key = hashlib.sha256(repr((self._key, str(signature), codegen.magic_tuple())).encode())
        return self._folder / f"{self._name}-{key.hexdigest()[:24]}.nbc"


@functools.cache
def cache_folder() -> Path | None:
    """The first folder that can be written: `NUMBA_CACHE_DIR`, or the user's cache, or the one of
    this package's bytecode; None if there is none.
    """
    user_cache = config.CACHE_DIR or os.path.join(
        os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache"), "numba"
    )
    for folder in (Path(user_cache, "kmp"), Path(__file__).parent / "__pycache__"):
        with contextlib.suppress(OSError):
            if folder.is_absolute():
                folder.mkdir(parents=True, exist_ok=True)
                tempfile.TemporaryFile(dir=folder).close()
                return folder
    return None


@functools.cache
def _remove_unused(folder: Path) -> None:
    """Remove files of versions that are not run any more; once in a process."""
    for path in folder.glob("*.nbc"):
        with contextlib.suppress(OSError):
            if time.time() - path.stat().st_atime > UNUSED_S:
                path.unlink()


@functools.cache
def _sources_digest(file: Path, package: str) -> str:
    """Digest of a module's file and of all that it imports of its package and of `kmp`."""
    pending = [file]
    digests: dict[Path, str] = {}
    while pending:
        path = pending.pop()
        if path not in digests:
            digests[path], imported = _read(path, package)
            pending += imported
    return hashlib.sha256("".join(sorted(digests.values())).encode()).hexdigest()


@functools.cache
def _read(file: Path, package: str) -> tuple[str, tuple[Path, ...]]:
    """Digest of a file, and the files of the modules that it imports."""
    content = file.read_bytes()
    imported = {
        found
        for name in _imported_names(content)
        if (found := _module_file(name, package)) is not None
    }
    return hashlib.sha256(content).hexdigest(), tuple(imported)


def _imported_names(content: bytes) -> Iterator[str]:
    """The dotted names that a module's text imports; whether they are modules is not known yet."""
    for origin, names, module in IMPORTS.findall(content):
        yield (origin or module).decode()
        for word in WORDS.findall(names.decode()):
            yield f"{origin.decode()}.{word}"


@functools.cache
def _module_file(name: str, package: str) -> Path | None:
    """The file of a module of `kmp` or of this package; None for any other name."""
    top, *parts = name.split(".")
    if top not in {package, "kmp"} or not hasattr(sys.modules.get(top), "__path__"):
        return None
    path = Path(sys.modules[top].__path__[0], *parts)
    candidates = (path / "__init__.py", path.with_suffix(".py"))
    return next((candidate for candidate in candidates if candidate.is_file()), None)
