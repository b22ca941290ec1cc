"""The QP of a convex subproblem, on the host.

JAX hands over scaled blocks in one vector. Each number of the QP is a constant, or plus
or minus one entry of that vector; which one is found once, by assembling the entries'
positions in place of their values.
"""

import functools
import threading

import numpy as np

from ._assembly import assembled
from ._layout import Layout, Structure
from ._qp import PIQP, QP, QPSolution, Workspace
from ._subproblem_data import Outline


@functools.lru_cache(maxsize=32)
def subproblem_solver(
    structure: Structure, settings: PIQP, outline: Outline
) -> "SubproblemSolver":
    """The one solver of a structure: its pattern is built and set up once."""
    return SubproblemSolver(structure, settings, outline)


# Costates this many times the price of virtual control take it.
_DEAR = 10.0


class SubproblemSolver:
    """Assembles the QPs of one structure, solves them and reads their solutions."""

    def __init__(self, structure: Structure, settings: PIQP, outline: Outline):
        self.layout = Layout(structure)
        self._relaxed = structure.relaxed
        self._between = (structure.nodes - 1) * structure.parts * structure.watch.size
        # Virtual variables make the stages too wide to factorize by stages.
        wide = structure.relaxed or structure.ball
        self._workspace = Workspace(settings, multistage=not wide)
        numbered = outline.cut(1.0 + np.arange(outline.size))
        blank = assembled(self.layout, structure, outline.cut(np.zeros(outline.size)))
        places = assembled(self.layout, structure, numbered)
        self._qp = blank
        self._numbers = blank.in_one_vector()
        # Infinite limits are infinite with any data.
        with np.errstate(invalid="ignore"):
            shift = np.nan_to_num(places.in_one_vector() - self._numbers)
        # Constants stand behind the vector, each in a place of its own.
        behind = outline.size + np.arange(shift.size)
        self._source = np.concatenate([np.zeros(outline.size), self._numbers])
        self._places = np.where(shift == 0.0, behind, np.abs(shift).astype(int) - 1)
        self._signs = np.where(shift < 0.0, -1.0, 1.0)
        self._precision = int(numbered.prices.precision) - 1
        self._relax = int(numbered.prices.relax) - 1
        self._virtual = numbered.prices.virtual_control.ravel().astype(int) - 1
        # Threads may solve problems of the same structure.
        self._lock = threading.Lock()

    def __call__(self, flat: np.ndarray) -> tuple[QPSolution, np.ndarray]:
        """Solution, and the effort as [solves, iterations, seconds]."""
        with self._lock:
            solution = self._workspace.solve(self.assemble(flat), flat[self._precision])
        return solution, np.array([1.0, solution.iterations, solution.seconds])

    def would_relax(self, flat: np.ndarray, solution: QPSolution) -> bool:
        """Whether the relaxed structure has another solution, and may be solved.

        It does where the dynamics cannot be met within the limits, and where that costs
        more than virtual control: by far more, as violations that the price of a path
        constraint or an integral pays for make costates of its size.
        """
        if self._relaxed or not flat[self._relax] > 0:
            return False
        nodes, n = self.layout.states.shape
        costates = np.abs(solution.y[: (nodes - 1) * n])
        return not solution.solved or bool((costates > _DEAR * flat[self._virtual]).any())

    def assemble(self, flat: np.ndarray) -> QP:
        """The QP whose solution is the best step; the same object every time."""
        self._source[: flat.size] = flat
        # Places are in range; to be told so is what makes `take` fast.
        np.take(self._source, self._places, out=self._numbers, mode="clip")
        self._numbers *= self._signs
        return self._qp

    def read(self, solution: QPSolution, effort: np.ndarray) -> np.ndarray:
        """The vector of a [`SubproblemSolution`][]."""
        layout, z, bound, y = self.layout, solution.z, solution.bound, solution.y
        nodes, n = layout.states.shape
        q = layout.totals.shape[1]
        states, controls = bound[layout.states], bound[layout.controls]
        time, totals = bound[[layout.time]], bound[layout.totals[-1]]
        # The rows of fixed entries follow those of the dynamics and the totals.
        position = (nodes - 1) * (n + q)
        for mask, target in (
            (layout.fixed_states, states),
            (layout.fixed_controls, controls),
            (layout.fixed_integrals, totals),
            (layout.fixed_time, time),
        ):
            count = int(mask.sum())
            target[mask] = y[position : position + count]
            position += count
        return np.concatenate(
            [
                z[layout.states].ravel(),
                z[layout.controls].ravel(),
                z[[layout.time]],
                y[: (nodes - 1) * n],
                solution.w[: layout.buffers.size + self._between],
                totals,
                states.ravel(),
                controls.ravel(),
                time,
                [solution.solved, solution.infeasible, self._relaxed],
                [solution.primal_residual, solution.dual_residual],
                effort,
            ]
        )
