"""`python docs/settings_page.py` writes settings.md: every setting of a cell with its
default, its accepted values and the comment beside it.
"""

from __future__ import annotations

import ast
import inspect
import io
import textwrap
import tokenize
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec
from msgspec import inspect as types

from thirdhand.settings import config

PAGE = Path(__file__).with_name("settings.md")
HEAD = """# Settings

<!-- Written by `python docs/settings_page.py` from service/thirdhand/settings/config.py: change it there. -->

Write the settings that you want to change into a TOML file, and start the daemon with it:
`thirdhand serve --config cell.toml`. Options of `thirdhand serve` override the file. Several cells
may share [one file](network.md#one-file-for-many-cells).

```toml
cell = "hall/bench-1"
rate_hz = 500

[hands]
unit = "mm"
base_from_tracker = [0.80, 0.0, 0.02, 0.0, 0.0, 1.0, 0.0]

[tool]
max_speed = 0.5
```

* Units are part of the name (`_ms`, `_hz`, `_mb`) or stand in brackets in the last column.
* Positions are in frame `base`, unless the last column names another frame.
* Quaternions are x y z w. A pose is x y z in metres, then a quaternion.
* Paths may begin with `~`. Relative paths of `[arm] urdf` and `packages`, `[network] certificate`
  and `zenoh_config` start from the folder of the file, those of `[files]` from the folder where the
  command runs.
"""


def page() -> str:
    """The text of the page."""
    return (
        HEAD
        + "".join(_section(config.Settings, ""))
        + "".join(
            part
            for field in types.type_info(config.Settings).fields  # type: ignore[attr-defined]
            for kind, name in _tables(field)
            for part in _section(kind, name)
        )
    )


def _tables(field: types.Field) -> Iterator[tuple[Any, str]]:
    """The class of a table of the file, and its heading; none for a single setting."""
    if isinstance(field.type, types.StructType):
        yield field.type.cls, field.name
    if isinstance(field.type, types.DictType):
        yield field.type.value_type.cls, f"{field.name}.NAME"  # type: ignore[attr-defined]


def _section(kind: Any, name: str) -> Iterator[str]:
    """The heading, text and table of one table of the file. Without a name: of its top level."""
    comments = _comments(kind)
    if name:
        yield f"\n## [{name}]\n\n{_paragraphs(kind)}\n"
    yield "\n| setting | default | accepted | meaning |\n|---|---|---|---|\n"
    for field in types.type_info(kind).fields:  # type: ignore[attr-defined]
        if not isinstance(field.type, types.StructType | types.DictType):
            cells = (
                f"`{field.name}`",
                _value(_default(field)),
                _accepted(field.type),
                comments.get(field.name, ""),
            )
            yield f"| {' | '.join(cell.replace('|', chr(92) + '|') for cell in cells)} |\n"


def _paragraphs(kind: Any) -> str:
    return "\n\n".join(
        textwrap.fill(" ".join(part.split()), 100) for part in inspect.getdoc(kind).split("\n\n")
    )


def _comments(kind: Any) -> dict[str, str]:
    """The comment above or beside each field of a class, by the field's name."""
    source = textwrap.dedent(inspect.getsource(kind))
    comments: dict[int, str] = {}
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type == tokenize.COMMENT:
            comments[token.start[0]] = token.string.removeprefix("#").strip()
    texts: dict[str, str] = {}
    for node in ast.parse(source).body[0].body:  # type: ignore[attr-defined]
        if isinstance(node, ast.AnnAssign):
            first = node.lineno
            while source.splitlines()[first - 2].strip().startswith("#"):
                first -= 1
            rows = range(first, (node.end_lineno or node.lineno) + 1)
            texts[ast.unparse(node.target)] = " ".join(
                comments[row] for row in rows if row in comments
            )
    return texts


def _default(field: types.Field) -> Any:
    return (
        field.default_factory() if field.default_factory is not msgspec.NODEFAULT else field.default
    )


def _value(value: Any) -> str:
    """A default as TOML, or a remark if there is none."""
    if value is msgspec.NODEFAULT:
        return "must be given"
    return f"`{_toml(value)}`"


def _toml(value: Any) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, str):
        return f'"{value}"'
    if isinstance(value, tuple):
        return f"[{', '.join(map(_toml, value))}]"
    return str(value)


def _accepted(kind: Any) -> str:
    """The accepted values of a setting, in words."""
    if isinstance(kind, types.Metadata):
        words = (kind.extra or {}).get("accepted")
        return str(words).rstrip(",") if words else _accepted(kind.type)
    if isinstance(kind, types.LiteralType):
        return ", ".join(f"`{_toml(value)}`" for value in kind.values)
    if isinstance(kind, types.BoolType):
        return "`true`, `false`"
    if isinstance(kind, types.StrType):
        return f"text, {kind.max_length} characters at most" if kind.max_length else "text"
    if isinstance(kind, types.TupleType):
        return f"{len(kind.item_types)} numbers{_each(kind.item_types[0])}"
    if isinstance(kind, types.VarTupleType):
        inner = (
            kind.item_type.type if isinstance(kind.item_type, types.Metadata) else kind.item_type
        )
        if isinstance(inner, types.StructType):
            fields = "; ".join(f"`{field.name}`: {_accepted(field.type)}" for field in inner.fields)
            return f"tables with {fields}"
        if isinstance(inner, types.LiteralType):
            return f"a list of {_accepted(inner)}"
        return (
            f"a list of {'texts' if isinstance(inner, types.StrType) else f'numbers{_each(inner)}'}"
        )
    return ", ".join(
        filter(
            None, ("whole number" if isinstance(kind, types.IntType) else "number", _range(kind))
        )
    )


def _each(kind: Any) -> str:
    bounds = _range(kind)
    return f", each {bounds}" if bounds else ""


def _range(kind: Any) -> str:
    """The bounds of a number, empty where it has none."""
    bounds = [
        f"{word} {bound:g}"
        for word, bound in (
            ("above", getattr(kind, "gt", None)),
            ("from", getattr(kind, "ge", None)),
            ("below", getattr(kind, "lt", None)),
            ("up to", getattr(kind, "le", None)),
        )
        if bound is not None
    ]
    return ", ".join(bounds).replace(", up to", " up to")


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
