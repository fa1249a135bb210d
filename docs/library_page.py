"""`python docs/library_page.py` writes the two pages on Python from docstrings: reference.md in
kmp/docs on `kmp`, and client.md on `thirdhand.client`.
"""

from __future__ import annotations

import inspect
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import kmp
import thirdhand
from kmp import correlation, orientation, reference, results, selection, sklearn
from thirdhand.contract import requests

HERE = Path(__file__).parent
LIBRARY = """# Reference

<!-- Written by `python docs/library_page.py` from the docstrings in kmp/: change it there. -->

All names are those of `import kmp`, except where a heading names a module.

Letters: N reference points, M queries, V via-points, T samples, I inputs, O outputs. Values are
immutable. A wrong argument, like a wrong shape or a number that is not finite, raises a ValueError
that names it."""
CLIENT = """# The Python client

<!-- Written by `python docs/library_page.py` from the docstrings in service/thirdhand/client: change it there. -->

A Python program talks to a running daemon through a connection:

```python
import thirdhand

with thirdhand.connect() as cell:  # address, cell and certificate as for the commands
    print(cell.wait_until_ready().mode)
    cell.hold()
    for pose in cell.watch("tool/target"):
        print(pose.position)
```

All names are those of `import thirdhand`. The programs in [examples](../examples) use them.

Positions are in metres and in [frame `base`](frames.md). Orientations are quaternions x y z w.
Joints are in radians, or in metres if they slide.

`pip install .` in a clone installs the client alone, for Python 3.11 or later on Linux, macOS and
Windows, with `eclipse-zenoh` and `msgspec`."""
KMP_GROUPS = {
    "Learn": ("learn", "aligned", "GaussianMixture", "Gaussians"),
    "Primitives": (
        "KMP",
        "OrientationKMP",
        "PoseKMP",
        "LocalKMP",
        "CoordinateFrame",
    ),
    "Kernels and means": (
        "GaussianKernel",
        "Matern32",
        "Matern52",
        "PeriodicKernel",
        "VelocityKernel",
        "RadialKernel",
        "Kernel",
        "AffineMean",
    ),
    "Beyond": ("LinearConstraints", "superposed"),
    "Files and warnings": ("save", "load", "RankReached", "ViaPointMissed"),
}
KMP_MODULES = {
    "Results of `learn`": (selection, ("Learned", "Score")),
    "Other results": (results, ("Alternatives", "MotionPrediction", "Uncertainty", "Stored")),
    "References by Gaussian processes": (reference, ("gaussian_process_reference",)),
    "Covariances from a reward": (correlation, ("Correlation", "improve", "Improvement")),
    "With scikit-learn": (sklearn, ("KMPRegressor",)),
}
CLIENT_GROUPS = {
    "Connect": ("connect", "Connection", "Watch", "SceneObject"),
    "Requests": ("Client",),
    "A driver or a tracker of one's own": ("Arm", "Hands"),
    "Hands and joints": ("Tracker", "Follower", "Command", "Publisher"),
    "Sessions": ("client_settings", "ClientSettings", "open_session", "endpoints"),
    "Cells on a network": ("cells", "Cell", "living", "why_silent", "Overheard"),
    "Errors": (
        "UnreachableError",
        "StartingError",
        "UncertainError",
        "RefusedError",
        "SettingsError",
    ),
}
VALUES = ("ViaPoint", "ViaPointInForce", "Reply")  # of thirdhand.contract.requests
WITHOUT_METHODS = {
    *("GaussianKernel", "Matern32", "Matern52", "PeriodicKernel", "VelocityKernel"),
    *("RadialKernel", "KMPRegressor"),
}
INSIDE = {"inner"}
SAME = {"LocalKMP.plot": "KMP.plot"}  # members with the docstring of another one
# errors of wrong shapes and of numbers that are not finite, or those of another member
PLAIN_ERROR = re.compile(
    r"\s+Raises\s+ValueError\s+(?:"
    r"if\s+(?:(?:the|a)\s+shape\s+differs|(?:the\s+)?shapes\s+(?:do\s+not\s+agree|differ)"
    r"|O\s+differs|[FI]\s+or\s+O\s+differs)(?:\s+or\s+a\s+number\s+is\s+not\s+finite)?"
    r"|as\s+(?:`[\w.]+`|that|the\s+constructor)(?:\s+and\s+`[\w.]+`)?(?:\s+do(?:es)?)?)\.(?=\s|$)"
)
# values that a caller receives and does not construct
RETURNED = {
    *(
        "KMP",
        "Kernel",
        "Learned",
        "Score",
        "MotionPrediction",
        "Uncertainty",
        "Improvement",
        "Stored",
    ),
    *("Command", "Cell", "ViaPointInForce", "Reply"),
}


def pages() -> dict[Path, str]:
    """The texts of the pages, by their files."""
    return {
        HERE.parent / "kmp" / "docs" / "reference.md": _library(),
        HERE / "client.md": _client(),
    }


def _library() -> str:
    """The page on `kmp`."""
    parts = [LIBRARY, *_groups(KMP_GROUPS, kmp)]
    parts += ["## Orientations, `kmp.orientation`", inspect.cleandoc(orientation.__doc__ or "")]
    for name, value in inspect.getmembers(orientation, inspect.isfunction):
        if value.__module__ == orientation.__name__ and not name.startswith("_"):
            parts += _described(name, value)
    for heading, (module, names) in KMP_MODULES.items():
        parts.append(f"## {heading}, `{module.__name__}`")
        parts += [part for name in names for part in _described(name, getattr(module, name))]
    return "\n\n".join(parts) + "\n"


def _client() -> str:
    """The page on `thirdhand.client`."""
    parts = [CLIENT, *_groups(CLIENT_GROUPS, thirdhand), "## Values, `thirdhand.contract.requests`"]
    parts += [part for name in VALUES for part in _described(name, getattr(requests, name))]
    return "\n\n".join(parts) + "\n"


def _groups(groups: dict[str, tuple[str, ...]], module: Any) -> Iterator[str]:
    """The sections of a page: the names of a module below their headings."""
    for group, names in groups.items():
        yield f"## {group}"
        for name in names:
            yield from _described(name, getattr(module, name))


def _described(name: str, value: Any) -> Iterator[str]:
    """A function, or a class and its methods and properties."""
    raised = inspect.isclass(value) and issubclass(value, Warning | Exception)
    yield f"### {name}"
    if name not in RETURNED and not raised:
        yield _signature(name, value)
    yield _text(value)
    if not inspect.isclass(value) or raised or name in WITHOUT_METHODS:
        return
    for part, member in inspect.getmembers(value):
        module = getattr(
            inspect.unwrap(getattr(member, "fget", getattr(member, "func", member))),
            "__module__",
            "",
        )
        ours = (module or "").startswith(("kmp.", "thirdhand."))
        if (
            part.startswith("_")
            or not ours
            or part in INSIDE
            or not member.__doc__
            or _is_inherited(value, part)
        ):
            continue
        yield _signature(f"{name}.{part}", member) if callable(member) else f"`{name}.{part}`:"
        original = SAME.get(f"{name}.{part}")
        yield f"As `{original}`." if original else _text(member)


def _text(value: Any) -> str:
    """A docstring without the errors that the head of the page names for all."""
    return PLAIN_ERROR.sub("", inspect.cleandoc(value.__doc__ or ""))


def _is_inherited(value: type, part: str) -> bool:
    """True if a class of the client has a member from another one, which is listed there."""
    return any(
        part in vars(base) for base in value.__mro__[1:] if base.__module__.startswith("thirdhand.")
    )


def _signature(name: str, value: Any) -> str:
    """A call with the names of its arguments; their types are in the docstring."""
    signature = inspect.signature(value)
    parameters = [
        one.replace(annotation=one.empty)
        for one in signature.parameters.values()
        if one.name != "self"
    ]
    arguments = str(signature.replace(parameters=parameters, return_annotation=signature.empty))
    arguments = arguments.replace("'", '"')  # as the formatter writes it
    text = name + arguments
    if len(text) > 96:
        text = f"{name}(\n    " + re.sub(r", (?![^(]*\))", ",\n    ", arguments[1:-1]) + ",\n)"
    return f"```python\n{text}\n```"


if __name__ == "__main__":
    for path, text in pages().items():
        path.write_text(text, encoding="utf-8")
