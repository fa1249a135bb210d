"""Readability of the code by folder: `python -m tests.support.air` prints shares of parallel
assignments, of local names without meaning, and of functions with many branches.

Conditional expressions in each other, and comprehensions with a condition over several loops, are
found too.
"""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parents[2]
FOLDERS = ("kmp", "service", "sim", "tests")
MAX_BRANCHES = 10
BRANCHES = (
    ast.If,
    ast.For,
    ast.While,
    ast.IfExp,
    ast.BoolOp,
    ast.ExceptHandler,
    ast.comprehension,
)
VAGUE = """
    again another apart at beside both each found given gone here it its kept known made off one
    own past rest said same seen shown so some then there these those told wanted way what which
    who
"""


class Air(NamedTuple):
    """Dense code: `file:line name` of each case, and the total numbers of assignments, names,
    functions.
    """

    nested: list[str]
    parallel: list[str]
    assignments: int
    vague: list[str]
    names: int
    branchy: list[str]
    functions: int

    @property
    def shares(self) -> tuple[float, float, float]:
        """Shares [%] of parallel assignments, vague names and functions with many branches."""
        return (
            100 * len(self.parallel) / self.assignments,
            100 * len(self.vague) / self.names,
            100 * len(self.branchy) / self.functions,
        )


def _is_parallel(node: ast.Assign) -> bool:
    return isinstance(node.targets[0], ast.Tuple) and isinstance(node.value, ast.Tuple)


def _is_nested(node: ast.AST) -> bool:
    if isinstance(node, ast.IfExp):
        return any(isinstance(part, ast.IfExp) for part in (node.body, node.orelse))
    loops = getattr(node, "generators", [])
    return len(loops) > 1 and any(loop.ifs for loop in loops)


def _stored(node: ast.AST) -> Iterator[str]:
    """The names that a statement or comprehension binds."""
    targets: list[ast.expr] = []
    if isinstance(node, ast.Assign):
        targets = node.targets
    elif isinstance(node, ast.For | ast.comprehension):
        targets = [node.target]
    for target in targets:
        for name in ast.walk(target):
            if isinstance(name, ast.Name) and isinstance(name.ctx, ast.Store):
                yield name.id


def air_of(folder: str) -> Air:
    """The dense code below a folder of the project."""
    air = Air([], [], 0, [], 0, [], 0)
    vague_names = set(VAGUE.split())
    for path in sorted((ROOT / folder).rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            place = f"{path.relative_to(ROOT)}:{getattr(node, 'lineno', 0)}"
            if _is_nested(node):
                air.nested.append(place)
            names = list(_stored(node))
            air.vague.extend(f"{place} {name}" for name in names if name in vague_names)
            air = air._replace(names=air.names + len(names))
            if isinstance(node, ast.Assign):
                air = air._replace(assignments=air.assignments + 1)
                if _is_parallel(node):
                    air.parallel.append(place)
            elif isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                air = air._replace(functions=air.functions + 1)
                count = sum(isinstance(branch, BRANCHES) for branch in ast.walk(node))
                if count > MAX_BRANCHES:
                    air.branchy.append(f"{place} {node.name} {count}")
    return air


if __name__ == "__main__":
    for folder in FOLDERS:
        parallel, vague, branchy = air_of(folder).shares
        print(
            f"{folder}: {parallel:.1f} % parallel assignments, {vague:.1f} % vague names, "
            f"{branchy:.1f} % of the functions have more than {MAX_BRANCHES} branches"
        )
