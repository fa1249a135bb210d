"""The inside of a primitive, for the package itself, its tests and those who extend it.

It may change in any version. `KMP.inner` is the only way to it.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

from kmp.compiled_query import CompiledQuery
from kmp.database import Changes, Database
from kmp.immutable import Immutable
from kmp.query import Query
from kmp.solution import Solution


@dataclass(frozen=True, eq=False, repr=False)
class Inner(Immutable):
    """A solution, how its database differs from the base's, and what a single query reads."""

    solution: Solution
    changes: Changes
    count: int
    """N of the covariance: the points of the base."""

    @classmethod
    def of_base(cls, solution: Solution) -> Inner:
        """The inside of a primitive that nothing was changed in."""
        database: Database = solution.database
        return cls(solution, database.unchanged(), len(database))

    @cached_property
    def query(self) -> Query:
        """Arrays of a single query, in the layout that the compiled loops read."""
        return Query.of(self.solution, self.count)

    @cached_property
    def compiled_query(self) -> CompiledQuery | None:
        """The same as compiled loops, where Numba is installed and knows the kernel; else None."""
        return CompiledQuery.of(self.query)
