"""The tree of a robot's links: each link but the root has one parent. Anything else is rejected
with a message, in a time that is linear in the number of links.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from typing import Protocol

MAX_LINKS = 1000  # a humanoid with its hands has 200
MAX_NAMED_LINKS = 4  # a message names at most this many


class Edge(Protocol):
    """A joint and the two links that it connects."""

    @property
    def name(self) -> str:
        """Name of the joint."""

    @property
    def parent(self) -> str:
        """The link that carries the joint."""

    @property
    def child(self) -> str:
        """The link that the joint carries."""


def root_of(links: Sequence[str], joints: Sequence[Edge]) -> str:
    """The root link. Raises ValueError if links and joints do not form a tree."""
    if len(links) > MAX_LINKS:
        raise ValueError(
            f"{len(links)} links; up to {MAX_LINKS} accepted: leave out what does not belong to "
            "the arm"
        )
    _check_names("link", links)
    _check_names("joint", [joint.name for joint in joints])
    _check_joints(set(links), joints)
    carried = {joint.child for joint in joints}
    roots = [link for link in links if link not in carried]
    if len(roots) > 1:
        raise ValueError(
            f"no joint connects {_named(roots)}; one root needed: connect them by fixed joints"
        )
    reached = _reached(roots, joints)
    if lost := [link for link in links if link not in reached]:
        raise ValueError(
            f"the joints above {_named(lost)} form a cycle; a tree with one root needed"
        )
    return roots[0]


def _check_names(kind: str, names: Sequence[str]) -> None:
    """Raise ValueError for links or joints without a name, or of the same name."""
    if "" in names:
        raise ValueError(f"a {kind} without a name")
    if twice := _named([name for name, count in Counter(names).items() if count > 1]):
        raise ValueError(f"{kind} {twice} is declared twice; each name once needed")


def _check_joints(links: set[str], joints: Sequence[Edge]) -> None:
    """Raise ValueError for joints that do not connect two links, or that carry the same link."""
    above = {joint.child: joint for joint in joints}
    for joint in joints:
        for role, link in (("parent", joint.parent), ("child", joint.child)):
            if not link:
                raise ValueError(f"joint {joint.name!r} names no {role} link")
            if link not in links:
                raise ValueError(
                    f"joint {joint.name!r}: its {role} {link!r} is not declared; a <link> of it "
                    "needed"
                )
        if (second := above[joint.child]) is not joint:
            raise ValueError(
                f"link {joint.child!r} is the child of two joints, {joint.name!r} and "
                f"{second.name!r}; one needed: arms with closed loops are not supported, cut the "
                "loop where it does not carry the tool"
            )


def _reached(roots: Iterable[str], joints: Iterable[Edge]) -> set[str]:
    """The links that can be reached from the roots by joints."""
    below = _children(joints)
    reached = set(roots)
    waiting = list(roots)
    while waiting:
        children = below.get(waiting.pop(), [])
        reached.update(children)
        waiting += children
    return reached


def _children(joints: Iterable[Edge]) -> dict[str, list[str]]:
    children: dict[str, list[str]] = {}
    for joint in joints:
        children.setdefault(joint.parent, []).append(joint.child)
    return children


def _named(names: Sequence[str]) -> str:
    """The first few of some names, for a message."""
    more = f" and {len(names) - MAX_NAMED_LINKS} more" if len(names) > MAX_NAMED_LINKS else ""
    return ", ".join(map(repr, names[:MAX_NAMED_LINKS])) + more
