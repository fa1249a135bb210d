"""`python docs/library_page.py` writes library.md: all that `kmp` offers, as its docstrings say."""

from __future__ import annotations

import inspect
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import kmp
from kmp import estimator, orientation

PAGE = Path(__file__).with_name("library.md")
HEAD = """# The library `kmp`

<!-- Written by `python docs/library_page.py` from the docstrings in kmp/: change it there. -->

All names are those of `import kmp`, but where a heading has a module. The
[tutorial](../kmp/README.md) shows how they go together, and
[a page of its own](coming-from.md) where to find what other libraries have.

Letters: N reference points, M queries, V via-points, T samples, I inputs, O outputs. Values are
immutable. What is wrong in a call is a ValueError that names the argument.

"""
GROUPS = {
    "Learn": ("learn", "Learned", "Score", "GaussianMixture", "gaussian_process_reference", "Gaussians"),
    "Primitives": ("KMP", "MotionPrediction", "Uncertainty", "OrientationKMP", "LocalKMP", "CoordinateFrame"),
    "Kernels and means": ("GaussianKernel", "PeriodicKernel", "VelocityKernel", "AffineMean"),
    "Beyond": ("LinearConstraints", "superposed", "Correlation", "improve", "Improvement"),
    "Files and warnings": ("save", "load", "Stored", "RankReached", "ViaPointMissed"),
}
WITHOUT_METHODS = {"GaussianKernel", "PeriodicKernel", "VelocityKernel", "KMPRegressor"}
INSIDE = {"to_plot", "inner"}
MADE_BY_THE_LIBRARY = {"KMP", "Learned", "Score", "MotionPrediction", "Uncertainty", "Improvement", "Stored"}


def page() -> str:
    """The page."""
    parts = [HEAD.rstrip()]
    for group, names in GROUPS.items():
        parts += [f"## {group}", *(part for name in names for part in _told(name, getattr(kmp, name)))]
    parts += ["## Orientations, `kmp.orientation`", inspect.cleandoc(orientation.__doc__ or "")]
    for name, value in inspect.getmembers(orientation, inspect.isfunction):
        if value.__module__ == orientation.__name__ and not name.startswith("_"):
            parts += _told(name, value)
    parts += ["## With scikit-learn, `kmp.estimator`", *_told("KMPRegressor", estimator.KMPRegressor)]
    return "\n\n".join(parts) + "\n"


def _told(name: str, value: Any) -> Iterator[str]:
    """A function, or a class and what its values do."""
    warns = inspect.isclass(value) and issubclass(value, Warning)
    yield f"### {name}"
    if name not in MADE_BY_THE_LIBRARY and not warns:
        yield _called(name, value)
    yield inspect.cleandoc(value.__doc__ or "")
    if not inspect.isclass(value) or warns or name in WITHOUT_METHODS:
        return
    for part, one in inspect.getmembers(value):
        ours = getattr(inspect.unwrap(getattr(one, "fget", getattr(one, "func", one))), "__module__", "") or ""
        if part.startswith("_") or not ours.startswith("kmp.") or part in INSIDE or not one.__doc__:
            continue
        yield _called(f"{name}.{part}", one) if callable(one) else f"`{name}.{part}`:"
        yield inspect.cleandoc(one.__doc__)


def _called(name: str, value: Any) -> str:
    """How it is called: its arguments by their names, without types, which the docstrings tell."""
    signature = inspect.signature(value)
    parameters = [one.replace(annotation=one.empty) for one in signature.parameters.values() if one.name != "self"]
    arguments = str(signature.replace(parameters=parameters, return_annotation=signature.empty))
    told = name + arguments
    if len(told) > 96:
        told = f"{name}(\n    " + arguments[1:-1].replace(", ", ",\n    ") + ",\n)"
    return f"```python\n{told}\n```"


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
