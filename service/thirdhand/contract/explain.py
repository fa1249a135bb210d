"""Validation errors in words: the place in the input, the given value, the accepted ones."""

from __future__ import annotations

import difflib
import errno
import re
from collections.abc import Iterable
from typing import Any, ClassVar, TypeVar

import msgspec
from msgspec import inspect

MAX_MESSAGE = 300  # characters of a message of another library
NEEDED = {  # by the operating system's number of an error
    errno.EEXIST: "a folder needed, and that is something else",
    errno.ENOTDIR: "a folder needed, and that is something else",
    errno.EISDIR: "a file needed, and that is a folder",
    errno.ENOSPC: "room on that disk needed",
    errno.EDQUOT: "room in this user's quota needed",
    errno.EROFS: "a place that can be written needed",
    errno.EACCES: "permission of this user needed",
    errno.EPERM: "permission of this user needed",
    errno.ELOOP: "a link that leads to a file or folder needed",
    errno.ENAMETOOLONG: "a shorter name needed",
    errno.ECONNREFUSED: "a program that listens there needed",
    errno.EADDRINUSE: "another program has it; another port, or 0 for any that is free, needed",
    errno.EADDRNOTAVAIL: "an address of this machine needed",
}
T = TypeVar("T")


class ExplainedError(Exception):
    """An error whose message says what failed, what was given and what is accepted. Commands print
    the message.
    """

    exit_code: ClassVar[int] = 1
    """See `exit_code_of`."""


class NotAcceptedError(ExplainedError, ValueError):
    """A command line or configuration is not accepted."""

    exit_code = 2


def exit_code_of(error: BaseException) -> int:
    """Exit code of a command that an error ends."""
    return error.exit_code if isinstance(error, ExplainedError) else 1


def in_words(error: BaseException, *, named: bool = True) -> str:
    """An error in words: the file (if `named`), what failed, and what is needed; without numbers of
    the operating system and names of codecs.
    """
    if isinstance(error, UnicodeDecodeError):
        return f"the byte 0x{error.object[error.start]:02x} is not valid; a text in UTF-8 needed"
    if (
        not isinstance(error, OSError)
        or isinstance(error, ExplainedError)
        or error.strerror is None
    ):
        return str(error) or type(error).__name__
    needed = NEEDED.get(error.errno or 0, "")
    file = f"{error.filename}: " * (named and error.filename is not None)
    return file + error.strerror + f"; {needed}" * bool(needed)


_PATH = re.compile(
    r"""(?mx) (?<!\w)(?: '(?:[^'\\\n]|\\.)*' | "(?:[^"\\\n]|\\.)*" )  # quotations are left as they are
    | ^\$:[ ] | \$((?:\.\w+ | \[(?:\d+|\.\.\.)\])+)"""
)


def in_file(text: str) -> str:
    """A text with JSON paths replaced by the names in a file: `$.arm.urdf` becomes `[arm] urdf`,
    `$.points[0].left` becomes `points, entry 1, left`; the root has no name.
    """
    return _PATH.sub(
        lambda found: _named(found[1]) if found[1] else found[0].replace("$: ", ""), text
    )


def _named(path: str) -> str:
    parts = [
        name or (f"entry {int(index) + 1}" if index.isdigit() else "an entry")
        for name, index in re.findall(r"\.(\w+)|\[(\d+|\.\.\.)\]", path)
    ]
    if re.match(r"\.\w+\.\w+\.", path):
        parts[:3] = [f"[{parts[0]}.{parts[1]}] {parts[2]}"]
    elif re.match(r"\.\w+\.", path):
        parts[:2] = [f"[{parts[0]}] {parts[1]}"]
    return ", ".join(parts)


class InvalidError(ExplainedError, ValueError):
    """An invalid value; the message has one line for each problem."""


def validated(given: Any, kind: type[T]) -> T:
    """A struct of structs from the contents of a file. Raises InvalidError with the first problem,
    or with all contradictions between valid values, in the words of `in_file`.
    """
    try:
        return msgspec.convert(given, kind)
    except msgspec.ValidationError as error:
        raise InvalidError(in_file(explained(error, given, kind))) from None


def explained(error: Exception, given: Any, kind: Any) -> str:
    """The message of a validation error of `given` against the type `kind`:

    `$.points[0].left: 2 numbers, 3 needed`.
    """
    message, separator, path = str(error).rpartition(" - at `")
    message, path = (message, path.rstrip("`")) if separator else (str(error), "$")
    if message.startswith("$"):
        return message  # from a check of our own, which names the path itself
    try:
        path = _with_name(path, given, kind)
        value, node, accepted = _at(path, given, inspect.type_info(kind))
    except (LookupError, TypeError, AttributeError):  # a name in the given value looks like a path
        return f"$: {error}"
    unknown = re.match(r"(?s)Object contains unknown field `(.*)`", message)
    if unknown and isinstance(node, inspect.StructType):
        return f"{path}: {_unknown_field(unknown[1], node)}"
    if message.startswith("Object missing required field"):
        return f"{path}: {message.removeprefix('Object missing required ')} is missing"
    is_of_value = isinstance(error, msgspec.ValidationError) and message.startswith(
        ("Expected", "Invalid")
    )
    if is_of_value and (needed := _needed(node, value, accepted)):
        return f"{path}: {_refused(node, value, accepted)} {needed}"
    return f"{path}: {message[:MAX_MESSAGE]}"


def _unknown_field(name: str, node: inspect.StructType) -> str:
    """The message about a field that a struct does not have."""
    field_names = _known(node)
    listing = ", ".join(field_names) or "none"
    return f"unknown field {_short(name)}; known are {listing}{did_you_mean(name, field_names)}"


def _refused(node: Any, value: Any, accepted: str) -> str:
    """The refused value in words; of a list where a tuple is needed, only its length."""
    if isinstance(node, inspect.TupleType | inspect.VarTupleType) and isinstance(value, list):
        counted = "numbers" if isinstance(node, inspect.TupleType) and not accepted else "given"
        return f"{len(value) or 'none'} {counted},"
    return f"{_short(value)} given;"


def did_you_mean(given: str, known: Iterable[str], *, cutoff: float = 0.6) -> str:
    """The end of a message that names the most similar known word; empty if no word is similar
    enough, 0 to 1.
    """
    near = difflib.get_close_matches(given, list(known), n=1, cutoff=cutoff)
    return f"; did you mean {near[0]}?" if near else ""


def _with_name(path: str, given: Any, kind: Any) -> str:
    """The path of an error with the name of the table for which msgspec writes `[...]`."""
    before, dots, after = path.partition("[...]")
    tables, node, _ = _at(before, given, inspect.type_info(kind)) if dots else (None, None, "")
    kind_of_tables = node.value_type if isinstance(node, inspect.DictType) else None
    if isinstance(tables, dict) and isinstance(kind_of_tables, inspect.StructType):
        for name, table in tables.items():
            try:
                msgspec.convert(table, kind_of_tables.cls)
            except msgspec.ValidationError:
                return f"{before}.{name}{after}"
    return path


def _known(node: inspect.StructType) -> list[str]:
    return [
        *([node.tag_field] if node.tag_field else []),
        *(field.encode_name for field in node.fields),
    ]


def _at(path: str, value: Any, node: inspect.Type) -> tuple[Any, Any, str]:
    """The value at a path, the type needed there, and the values that the type describes as
    accepted.
    """
    accepted = ""
    for field, index in re.findall(r"\.(\w+)|\[(\d+)\]", path):
        node = _chosen(node, value)
        tags = _tags(node, field)
        if tags is not None:
            return value.get(field), inspect.LiteralType(tags), ""
        inner = _inner(node, field, index)
        if inner is None:
            return None, None, ""
        value = value[field] if field else value[int(index)]
        accepted = ""
        node = inner
        if isinstance(node, inspect.Metadata):
            accepted = (node.extra or {}).get("accepted", "")
            node = node.type
    return value, _chosen(node, value), accepted


def _tags(node: Any, field: str) -> tuple[Any, ...] | None:
    """The tags that a field of tagged structs may have; None if it is not their tag."""
    if isinstance(node, inspect.StructType) and field and field == node.tag_field:
        return (node.tag,)
    if isinstance(node, inspect.UnionType) and field:
        return tuple(member.tag for member in node.types if isinstance(member, inspect.StructType))
    return None


def _inner(node: Any, field: str, index: str) -> Any:
    """The type of a field or an entry; None if the type has no such part."""
    match node:
        case inspect.StructType() if field:
            return {part.encode_name: part.type for part in node.fields}[field]
        case inspect.TupleType():
            return node.item_types[int(index)]
        case inspect.VarTupleType() | inspect.ListType():
            return node.item_type
        case inspect.DictType() if field:
            return node.value_type
    return None


def _chosen(node: Any, value: Any) -> Any:
    """The type of a union that a value is meant for: the struct that its tag names, or the only
    type beside null; without such a type, the union.
    """
    if not isinstance(node, inspect.UnionType):
        return node
    types = [member for member in node.types if not isinstance(member, inspect.NoneType)]
    if len(types) == 1 and value is not None:
        return types[0]
    if isinstance(value, dict):
        tagged = (
            member
            for member in node.types
            if isinstance(member, inspect.StructType) and member.tag_field
        )
        return next(
            (member for member in tagged if value.get(member.tag_field) == member.tag), node
        )
    return node


def _needed(node: Any, value: Any, accepted: str) -> str:  # noqa: C901 - a case for each type
    """The values that a type accepts, in words."""
    if accepted:
        return f"{accepted} accepted"
    match node:
        case inspect.LiteralType(values):
            return f"{', '.join(map(str, values))} accepted"
        case inspect.IntType() | inspect.FloatType():
            return f"{_range(node)} accepted"
        case inspect.TupleType(item_types):
            return (
                f"{len(item_types)} needed"
                if isinstance(value, list)
                else f"{len(item_types)} numbers needed"
            )
        case inspect.VarTupleType(max_length=most) if most:
            return f"{node.min_length or 0} to {most} needed"
        case inspect.VarTupleType(min_length=least) if least:
            return f"at least {least} needed"
        case inspect.VarTupleType() if not isinstance(value, list):
            return f"a list needed, like [{value!r}]" if isinstance(value, str) else "a list needed"
        case inspect.BoolType():
            return "true or false needed"
        case inspect.StrType():
            return "a text needed"
        case inspect.StructType() | inspect.UnionType():
            return "an object with its fields needed"
    return ""


def _short(value: Any) -> str:
    if value is None:
        return "null (or NaN)"
    try:
        text = repr(value)
    except RecursionError:
        return "a value that is nested too deep"
    return text if len(text) <= 60 else text[:57] + "..."


def _range(node: inspect.IntType | inspect.FloatType) -> str:
    whole = "a whole number" if isinstance(node, inspect.IntType) else "a number"
    limits = (("above", node.gt), ("from", node.ge))
    low = next((f"{word} {limit}" for word, limit in limits if limit is not None), "")
    limits = (("below", node.lt), ("to", node.le))
    high = next((f"{word} {limit}" for word, limit in limits if limit is not None), "")
    return " ".join(part for part in (whole, low, high) if part)
