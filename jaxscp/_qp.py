"""Quadratic programs of a fixed sparsity pattern, and PIQP, which solves them.

Everything here runs on the host, in NumPy; `_subproblem` calls it from JAX.
"""

import dataclasses
from typing import TYPE_CHECKING

import equinox as eqx
import numpy as np
import piqp

if TYPE_CHECKING:
    from scipy.sparse import csc_matrix


@dataclasses.dataclass
class QP:
    """minimize 1/2 z'Pz + c'z subject to Az = b, Gz <= h, lower <= z <= upper.

    `P` is given by its upper triangle.
    """

    P: "csc_matrix"
    c: np.ndarray
    A: "csc_matrix"
    b: np.ndarray
    G: "csc_matrix"
    h: np.ndarray
    lower: np.ndarray
    upper: np.ndarray

    def in_one_vector(self) -> np.ndarray:
        """All numbers one after the other; from now on the fields are parts of it."""
        matrices = (self.P, self.A, self.G)
        vectors = ("c", "b", "h", "lower", "upper")
        parts = [part.data for part in matrices] + [getattr(self, v) for v in vectors]
        whole = np.concatenate(parts)
        pieces = np.split(whole, np.cumsum([part.size for part in parts])[:-1])
        for matrix, piece in zip(matrices, pieces, strict=False):
            matrix.data = piece
        for name, piece in zip(vectors, pieces[len(matrices) :], strict=True):
            setattr(self, name, piece)
        return whole

    @property
    def is_finite(self) -> bool:
        """Whether all numbers but the limits are finite."""
        parts = (self.P.data, self.A.data, self.G.data, self.c, self.b)
        limits = np.isfinite(self.h) | np.isposinf(self.h)
        return bool(limits.all()) and all(np.isfinite(part).all() for part in parts)


@dataclasses.dataclass
class QPSolution:
    """Primal and dual solution of a [`QP`][], and how the solver fared.

    - `z`: variables. `y`, `w`: multipliers of Az = b and of Gz <= h.
    - `bound`: multipliers of the limits, upper minus lower.
    - `solved`, `infeasible`: outcome. `primal_residual`, `dual_residual`: as reported.
    - `iterations`: interior-point iterations. `seconds`: time in the solver.
    """

    z: np.ndarray
    y: np.ndarray
    w: np.ndarray
    bound: np.ndarray
    solved: bool
    infeasible: bool
    primal_residual: float
    dual_residual: float
    iterations: int
    seconds: float


class PIQP(eqx.Module):
    """Settings of PIQP, the proximal interior-point solver of the subproblems.

    Schwan et al., "PIQP: A Proximal Interior-Point Quadratic Programming Solver", 2023.

    **Arguments:**

    - `finest`: least absolute tolerance on residuals and duality gap. A method asks for
        what its own progress needs.
    - `max_iterations`: interior-point iterations allowed.
    """

    finest: float = eqx.field(static=True, default=1e-10)
    max_iterations: int = eqx.field(static=True, default=100)


class Workspace:
    """A PIQP instance for one sparsity pattern: what it solved before changes nothing.

    By stages it is set up once, then only updated: the symbolic factorization of the
    setup costs as much as a solve.

    **Arguments:**

    - `multistage`: factorize by stages, fast where the pattern is a chain of narrow
        blocks, rather than as a general sparse matrix.
    """

    def __init__(self, settings: PIQP, *, multistage: bool):
        self._ready = False
        # An update takes the equilibration out of the old numbers and leaves rounding.
        self._lasts = multistage
        self._solver = piqp.SparseSolver()
        options, backends = self._solver.settings, piqp.KKTSolver
        options.kkt_solver = (
            backends.sparse_multistage if multistage else backends.sparse_ldlt
        )
        self._finest = settings.finest
        options.max_iter = settings.max_iterations
        # Trust regions bound every subproblem: dual infeasibility can only be a false
        # alarm, which wide ranges of multipliers do set off.
        options.eps_dual_inf = 1e-15
        if multistage:
            # The blocks come scaled; equilibrating them takes a fifth of the time.
            options.preconditioner_iter = 0
            # Next to rounding: the absolute tolerance is what counts.
            options.eps_rel = options.eps_duality_gap_rel = 1e-12
        else:
            # Prices of virtual variables dwarf the rest of the cost.
            options.preconditioner_scale_cost = True
        options.compute_timings = True

    def solve(self, qp: QP, precision: float = 0.0) -> QPSolution:
        """Solve one QP of this workspace's pattern, as exactly as `precision` says."""
        if not qp.is_finite:
            # PIQP would iterate on NaN; the caller finds out why they are there.
            return _unsolved(qp)
        options = self._solver.settings
        # In this order NaN asks for the finest.
        exact = precision if precision > self._finest else self._finest
        options.eps_abs = options.eps_duality_gap_abs = exact
        change = self._solver.update if self._ready else self._solver.setup
        change(qp.P, qp.c, qp.A, qp.b, qp.G, None, qp.h, qp.lower, qp.upper)
        self._ready = self._lasts
        self._solver.solve()
        result, info = self._solver.result, self._solver.result.info
        return QPSolution(
            z=result.x.copy(),
            y=result.y.copy(),
            w=result.z_u.copy(),
            bound=result.z_bu - result.z_bl,
            solved=info.status == piqp.PIQP_SOLVED,
            infeasible=info.status == piqp.PIQP_PRIMAL_INFEASIBLE,
            primal_residual=info.primal_res,
            dual_residual=info.dual_res,
            iterations=info.iter,
            seconds=info.run_time,
        )


def _unsolved(qp: QP) -> QPSolution:
    z, y, w = (np.full(part.size, np.nan) for part in (qp.c, qp.b, qp.h))
    return QPSolution(z, y, w, z, False, False, np.nan, np.nan, 0, 0.0)
