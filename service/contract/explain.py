"""Validation errors in words: where in the input, what was given, what would be accepted."""

from __future__ import annotations

import copy
import difflib
import errno
import re
from typing import Any, TypeVar

import msgspec
from msgspec import inspect

LONGEST = 300  # characters of what others say is wrong
MOST_PROBLEMS = 50  # told at once
WANTED = {  # by the operating system's number of an error
    errno.EEXIST: "a folder needed, and that is something else",
    errno.ENOTDIR: "a folder needed, and that is something else",
    errno.EISDIR: "a file needed, and that is a folder",
    errno.ENOSPC: "room on that disk needed",
    errno.EDQUOT: "room in this user's quota needed",
    errno.EROFS: "a place that can be written needed",
    errno.EACCES: "permission of this user needed",
    errno.EPERM: "permission of this user needed",
    errno.EADDRINUSE: "another program has it; another port, or 0 for any that is free, needed",
    errno.EADDRNOTAVAIL: "an address of this machine needed",
}
T = TypeVar("T")


class ExplainedError(Exception):
    """Tells people what failed, was given and is accepted: commands print it and exit 1."""


def in_words(error: BaseException, *, named: bool = True) -> str:
    """An error in words, without numbers of the operating system and names of codecs: which file
    (if `named`), what failed, and what is needed.
    """
    if isinstance(error, UnicodeDecodeError):
        return f"the byte 0x{error.object[error.start]:02x} is not valid; a text in UTF-8 needed"
    if not isinstance(error, OSError) or isinstance(error, ExplainedError) or error.strerror is None:
        return str(error) or type(error).__name__
    wanted = WANTED.get(error.errno or 0, "")
    file = f"{error.filename}: " * (named and error.filename is not None)
    return file + error.strerror + f"; {wanted}" * bool(wanted)


_PATH = re.compile(
    r"""(?mx) (?<!\w)(?: '(?:[^'\\\n]|\\.)*' | "(?:[^"\\\n]|\\.)*" )  # a quotation stays as it is
    | ^\$:[ ] | \$((?:\.\w+ | \[(?:\d+|\.\.\.)\])+)"""
)


def in_file(text: str) -> str:
    """The text with each JSON path as an author of a file names the value: `$.arm.urdf` becomes
    `[arm] urdf`, `$.points[0].left` becomes `points, entry 1, left`; the root needs no name.
    """
    return _PATH.sub(lambda found: _named(found[1]) if found[1] else found[0].replace("$: ", ""), text)


def _named(path: str) -> str:
    parts = [
        name or (f"entry {int(index) + 1}" if index.isdigit() else "an entry")
        for name, index in re.findall(r"\.(\w+)|\[(\d+|\.\.\.)\]", path)
    ]
    if re.match(r"\.\w+\.", path):
        parts[:2] = [f"[{parts[0]}] {parts[1]}"]
    return ", ".join(parts)


class InvalidError(ExplainedError, ValueError):
    """What does not pass validation: all that is wrong with it, a line each."""


def validated(given: Any, kind: type[T]) -> T:
    """A struct of structs from what a file holds. Raises InvalidError with all that is wrong, in
    the words of `in_file`.

    What is wrong is left out and the rest looked at again. The checks of several values come last;
    what they say of a section in which something was left out is not told.
    """
    rest, problems, doubted = copy.deepcopy(given), list[str](), set[str]()
    while len(problems) < MOST_PROBLEMS:
        try:
            value = msgspec.convert(rest, kind)
        except msgspec.ValidationError as error:
            lines = explained(error, rest, kind).splitlines()
            if str(error).startswith("$.") and " - at `" not in str(error):
                problems += [line for line in lines if not any(f"$.{name}" in line for name in doubted)]
                break
            problems += lines
            left_out = _leave_out(rest, lines[0])
            if not left_out:
                break
            doubted.add(left_out)
        else:
            if not problems:
                return value
            break
    raise InvalidError(in_file("\n".join(problems)))


def _leave_out(given: Any, said: str) -> str:
    """Takes away the value that an error tells of; in which section it stood, or nothing."""
    found = re.match(r"\$(?:\.(\w+))?(?:\.(\w+))?[^:]*: (?:unknown field '(.*)'; known)?", said)
    section, name, unknown = found.groups() if found else (None, None, None)
    inner = given.get(section) if isinstance(given, dict) and section else given
    if isinstance(inner, dict) and (key := unknown or name) in inner:
        del inner[key]
        return section or str(key)
    if isinstance(given, dict) and section in given:
        del given[section]
        return str(section)
    return ""


def explained(error: Exception, given: Any, kind: Any) -> str:
    """The message of a validation error of `given` against the type `kind`:

    `$.points[0].left: 2 numbers, 3 needed`.
    """
    message, found, path = str(error).rpartition(" - at `")
    message, path = (message, path.rstrip("`")) if found else (str(error), "$")
    if message.startswith("$"):
        return message  # said by a check of our own, which knows better
    try:
        value, node, accepted = _at(path, given, inspect.type_info(kind))
    except (LookupError, TypeError, AttributeError):  # a name in what was given looks like a path
        return f"$: {error}"
    unknown = re.match(r"(?s)Object contains unknown field `(.*)`", message)
    if unknown and isinstance(node, inspect.StructType):
        known = _known(node)
        near = difflib.get_close_matches(unknown[1], known, n=1)
        told = f"{path}: unknown field {_short(unknown[1])}; known are {', '.join(known) or 'none'}"
        return told + (f"; did you mean {near[0]}?" if near else "")
    if message.startswith("Object missing required field"):
        return f"{path}: {message.removeprefix('Object missing required ')} is missing"
    if (
        isinstance(error, msgspec.ValidationError)
        and (needed := _needed(node, value, accepted))
        and message.startswith(("Expected", "Invalid"))
    ):
        if isinstance(node, inspect.TupleType | inspect.VarTupleType) and isinstance(value, list):
            counted = "numbers" if isinstance(node, inspect.TupleType) else "given"
            return f"{path}: {len(value) or 'none'} {counted}, {needed}"
        return f"{path}: {_short(value)} given; {needed}"
    return f"{path}: {message[:LONGEST]}"


def _known(node: inspect.StructType) -> list[str]:
    return [*([node.tag_field] if node.tag_field else []), *(field.encode_name for field in node.fields)]


def _at(path: str, value: Any, node: inspect.Type) -> tuple[Any, Any, str]:
    """What stands at a path, the type needed there, and what the type's author says is accepted."""
    accepted = ""
    for field, index in re.findall(r"\.(\w+)|\[(\d+)\]", path):
        node = _chosen(node, value)
        if isinstance(node, inspect.StructType) and field:
            if field == node.tag_field:
                return value.get(field), inspect.LiteralType((node.tag,)), ""
            inner = {f.encode_name: f.type for f in node.fields}[field]
        elif isinstance(node, inspect.UnionType) and field:
            tags = tuple(t.tag for t in node.types if isinstance(t, inspect.StructType))
            return value.get(field), inspect.LiteralType(tags), ""
        elif isinstance(node, inspect.TupleType):
            inner = node.item_types[int(index)]
        elif isinstance(node, inspect.VarTupleType | inspect.ListType):
            inner = node.item_type
        else:
            return None, None, ""
        value = value[field] if field else value[int(index)]
        accepted, node = "", inner
        if isinstance(node, inspect.Metadata):
            accepted, node = (node.extra or {}).get("accepted", ""), node.type
    return value, _chosen(node, value), accepted


def _chosen(node: Any, value: Any) -> Any:
    """The one of several tagged structs that a value says it is."""
    if isinstance(node, inspect.UnionType) and isinstance(value, dict):
        tagged = (one for one in node.types if isinstance(one, inspect.StructType) and one.tag_field)
        return next((one for one in tagged if value.get(one.tag_field) == one.tag), node)
    return node


def _needed(node: Any, value: Any, accepted: str) -> str:
    """What a type accepts, in words."""
    if accepted:
        return f"{accepted} accepted"
    match node:
        case inspect.LiteralType(values):
            return f"{', '.join(map(str, values))} accepted"
        case inspect.IntType() | inspect.FloatType():
            return f"{_range(node)} accepted"
        case inspect.TupleType(item_types):
            return f"{len(item_types)} needed" if isinstance(value, list) else f"{len(item_types)} numbers needed"
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
        return "what is nested too deep"
    return text if len(text) <= 60 else text[:57] + "..."


def _range(node: inspect.IntType | inspect.FloatType) -> str:
    whole = "a whole number" if isinstance(node, inspect.IntType) else "a number"
    low = f"above {node.gt}" if node.gt is not None else f"from {node.ge}" if node.ge is not None else ""
    high = f"below {node.lt}" if node.lt is not None else f"to {node.le}" if node.le is not None else ""
    return " ".join(part for part in (whole, low, high) if part)
