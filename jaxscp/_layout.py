"""Which column and row of the subproblem's QP is what.

Columns are ordered node by node, so that the pattern is a chain of blocks with the
flight time, which every block sees, at the end. Integrals travel along the chain as
running totals: a single row over the whole flight would tie every node to every other.
"""

import dataclasses
from typing import Any

import numpy as np

from ._discretization import Quadrature
from ._peaks import Watch
from ._transcription import Transcription


@dataclasses.dataclass(frozen=True)
class Structure:
    """All that decides a subproblem's sparsity pattern: hashable, no numbers.

    - `nodes`, `control_nodes`: N, M. `state_size`, `control_size`: n, m.
    - `watch`, `parts`: what is enforced between the nodes, and in how many parts of an
        interval. `integrals`: q.
    - `fixed_states` (N x n), `fixed_controls` (m), `fixed_integrals` (q), `fixed_time`:
        which entries are equalities.
    - `right_control`, `right_state`: which right ends an interval's quantities see.
    - `relaxed`: with virtual control. `ball`: with a hard infinity-norm trust region.
    """

    nodes: int
    control_nodes: int
    state_size: int
    control_size: int
    watch: Watch
    parts: int
    integrals: int
    fixed_states: tuple[tuple[bool, ...], ...]
    fixed_controls: tuple[bool, ...]
    fixed_integrals: tuple[bool, ...]
    fixed_time: bool
    right_control: bool
    right_state: bool
    relaxed: bool = False
    ball: bool = False

    @property
    def limits(self) -> int:
        """Limits of the state that are enforced between the nodes."""
        return self.watch.limits if self.parts else 0

    @classmethod
    def of(cls, transcription: Transcription, **options: bool) -> "Structure":
        problem = transcription.problem
        integrals = problem.integrals.values()
        return cls(
            nodes=transcription.nodes,
            control_nodes=transcription.control_nodes,
            state_size=problem.state_size,
            control_size=problem.control_size,
            watch=transcription.watch,
            parts=transcription.discretization.between,
            integrals=len(problem.integrals),
            fixed_states=tuple(map(tuple, transcription.fixed_states.tolist())),
            fixed_controls=problem.control.fixed,
            fixed_integrals=tuple(integral.bounds.fixed[0] for integral in integrals),
            fixed_time=problem.final_time.fixed[0],
            right_control=transcription.discretization.holds_right,
            right_state=transcription.discretization.quadrature is Quadrature.TRAPEZOID,
            **options,
        )


class Layout:
    """Column of each variable; -1 where there is none.

    - `states` (N, n), `controls` (M, m), `time`: the scaled step.
    - `totals` (N, q): the integrals up to each node.
    - `buffers` (N, p): virtual buffers of the path constraints at a node and in the
        interval behind it. `limit_buffers` (N-1, e): of the state's limits there, if the
        structure is relaxed. `integral_buffers` (2, q): of the integrals.
    - `virtual` (2, N-1, n): positive and negative part of the virtual control.
    - `norms` (N, 2), `time_norm`: bounds on the step's infinity norms.
    - `columns`: how many there are.
    """

    def __init__(self, structure: Structure):
        nodes, free = structure.nodes, structure.control_nodes
        n, m = structure.state_size, structure.control_size
        p, q = structure.watch.path, structure.integrals
        self.columns = 0
        self.states, self.controls = _none(nodes, n), _none(free, m)
        self.totals, self.buffers = _none(nodes, q), _none(nodes, p)
        self.virtual, self.norms = _none(2, nodes - 1, n), _none(nodes, 2)
        self.limit_buffers = _none(nodes - 1, structure.limits)
        for k in range(nodes):
            self.states[k] = self._take(n)
            if k > 0:
                self.totals[k] = self._take(q)
            if k < free:
                self.controls[k] = self._take(m)
            self.buffers[k] = self._take(p)
            if structure.relaxed and k < nodes - 1:
                self.virtual[:, k] = self._take(2 * n).reshape(2, n)
                self.limit_buffers[k] = self._take(structure.limits)
            if structure.ball:
                self.norms[k] = self._take(2)
        self.integral_buffers = self._take(2 * q).reshape(2, q)
        self.time = int(self._take(1)[0])
        self.time_norm = int(self._take(1)[0]) if structure.ball else -1
        self.fixed_states = np.array(structure.fixed_states, bool)
        controls = np.array(structure.fixed_controls, bool)
        self.fixed_controls = np.broadcast_to(controls, (free, m))
        self.fixed_integrals = np.array(structure.fixed_integrals, bool)
        self.fixed_time = np.array([structure.fixed_time])

    def _take(self, count: int) -> np.ndarray:
        self.columns += count
        return np.arange(self.columns - count, self.columns)


def _none(*shape: int) -> np.ndarray:
    return np.full(shape, -1)


class Entries:
    """Nonzeros of a matrix under construction, block by block."""

    def __init__(self):
        self.count = 0
        self._parts: list[tuple[np.ndarray, ...]] = []

    def new_rows(self, *shape: int) -> np.ndarray:
        """Numbers of further rows."""
        size = int(np.prod(shape))
        self.count += size
        return np.arange(self.count - size, self.count).reshape(shape)

    def add(self, rows, columns, values) -> None:
        """Entries at `rows` and `columns`, broadcast against each other."""
        shape = np.broadcast_shapes(np.shape(rows), np.shape(columns))
        entries = (np.broadcast_to(part, shape) for part in (rows, columns, values))
        self._parts.append(tuple(part.ravel() for part in entries))

    def matrix(self, columns: int) -> Any:
        """All entries in compressed columns; zeros among them keep their places."""
        # Imported where needed: SciPy takes a fifth of a second.
        from scipy.sparse import csc_matrix

        parts = self._parts or [(np.zeros(0, int), np.zeros(0, int), np.zeros(0))]
        rows, across, values = (np.concatenate(part) for part in zip(*parts, strict=True))
        order = np.lexsort((rows, across))
        rows, across = rows[order], across[order]
        if np.any((np.diff(across) == 0) & (np.diff(rows) == 0)):
            raise ValueError("Entries: an entry appears twice.")
        starts = np.searchsorted(across, np.arange(columns + 1))
        return csc_matrix((values[order], rows, starts), shape=(self.count, columns))
