"""Quadratic programs of a fixed sparsity pattern, and PIQP, which solves them."""

import dataclasses
import functools
import threading
from collections import OrderedDict

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import piqp
from scipy.sparse import csc_matrix

from ._types import Array, Float


class SparsePattern:
    """Where the nonzeros of one matrix stand, in compressed columns.

    Built once from row and column indices in any order; [`SparsePattern.order`][] says
    in which order their values belong. Hashable, so that it can be static in `jax.jit`.
    """

    def __init__(self, rows: np.ndarray, columns: np.ndarray, shape: tuple[int, int]):
        order = np.lexsort((rows, columns))
        rows, columns = rows[order], columns[order]
        if rows.size and np.any((np.diff(columns) == 0) & (np.diff(rows) == 0)):
            raise ValueError("SparsePattern: an entry appears twice.")
        self.order = order
        self.indices = rows.astype(np.int32)
        self.indptr = np.searchsorted(columns, np.arange(shape[1] + 1)).astype(np.int32)
        self.shape = shape
        self._key = (shape, self.indices.tobytes(), self.indptr.tobytes())
        self._hash = hash(self._key)

    def __hash__(self) -> int:
        return self._hash

    def __eq__(self, other: object) -> bool:
        return isinstance(other, SparsePattern) and self._key == other._key

    def matrix(self) -> csc_matrix:
        """A matrix of this pattern; its `data` is filled in later."""
        # A nonzero everywhere, so that no entry is dropped as a zero of the structure.
        data = np.ones(self.indices.size)
        return csc_matrix((data, self.indices, self.indptr), shape=self.shape)


class QP(eqx.Module):
    """minimize 1/2 z'Pz + c'z subject to Az = b, Gz <= h, lower <= z <= upper.

    Matrices are value vectors in the order of their static patterns; `P` is given by its
    upper triangle.
    """

    P: Float[Array, " P_nonzeros"]
    c: Float[Array, " variables"]
    A: Float[Array, " A_nonzeros"]
    b: Float[Array, " equalities"]
    G: Float[Array, " G_nonzeros"]
    h: Float[Array, " inequalities"]
    lower: Float[Array, " variables"]
    upper: Float[Array, " variables"]
    patterns: tuple[SparsePattern, SparsePattern, SparsePattern] = eqx.field(static=True)


class QPReport(eqx.Module):
    """How the solver fared.

    - `solved`, `infeasible`: truth values.
    - `primal_residual`, `dual_residual`: as the solver reports them.
    - `solves`: QPs solved, `iterations`: interior-point iterations, `seconds`: time in
        the solver.
    """

    solved: Array
    infeasible: Array
    primal_residual: Array
    dual_residual: Array
    solves: Array
    iterations: Array
    seconds: Array

    @classmethod
    def none(cls) -> "QPReport":
        """Of a solve that has not happened."""
        flags = jnp.array(True), jnp.array(False)
        residuals, counts = (jnp.zeros(()),) * 2, (jnp.zeros((), int),) * 2
        return cls(*flags, *residuals, *counts, jnp.zeros(()))

    def after(self, earlier: "QPReport") -> "QPReport":
        """This outcome, with an earlier solve's effort added."""
        return dataclasses.replace(
            self,
            solves=earlier.solves + self.solves,
            iterations=earlier.iterations + self.iterations,
            seconds=earlier.seconds + self.seconds,
        )


class QPSolution(eqx.Module):
    """Primal and dual solution of a [`QP`][].

    - `z`: variables. `y`, `w`: multipliers of Az = b and of Gz <= h.
    - `bound`: multipliers of the limits, upper minus lower.
    """

    z: Float[Array, " variables"]
    y: Float[Array, " equalities"]
    w: Float[Array, " inequalities"]
    bound: Float[Array, " variables"]
    report: QPReport


class PIQP(eqx.Module):
    """The proximal interior-point solver PIQP, called on the host.

    Schwan et al., "PIQP: A Proximal Interior-Point Quadratic Programming Solver", 2023.

    **Arguments:**

    - `tolerance`: absolute tolerance on residuals and duality gap.
    - `max_iterations`: interior-point iterations allowed.
    - `multistage`: factorize by stages (fast where the pattern is a chain of blocks)
        rather than as a general sparse matrix.
    """

    tolerance: float = eqx.field(static=True, default=1e-9)
    max_iterations: int = eqx.field(static=True, default=100)
    multistage: bool = eqx.field(static=True, default=True)

    def solve(self, qp: QP) -> QPSolution:
        """Solve inside or outside `jax.jit`; the structure is set up once and reused."""
        data = (qp.P, qp.c, qp.A, qp.b, qp.G, qp.h, qp.lower, qp.upper)
        vector = jax.ShapeDtypeStruct
        (variables,), (equalities,), (inequalities,) = qp.c.shape, qp.b.shape, qp.h.shape
        shapes = tuple(
            vector((size,), jnp.float64)
            for size in (variables, equalities, inequalities, variables)
        )
        z, y, w, bound, report = jax.pure_callback(
            functools.partial(_solve_on_host, self, qp.patterns),
            (*shapes, vector((6,), jnp.float64)),
            data,
            vmap_method="sequential",
        )
        solved, infeasible, iterations, primal, dual, seconds = report
        report = QPReport(
            solved=solved > 0,
            infeasible=infeasible > 0,
            primal_residual=primal,
            dual_residual=dual,
            solves=jnp.ones((), int),
            iterations=iterations.astype(int),
            seconds=seconds,
        )
        return QPSolution(z, y, w, bound, report)


class _Workspace:
    """A PIQP instance and the matrices it was set up with."""

    def __init__(self, settings: PIQP, patterns):
        self.lock = threading.Lock()
        self.matrices = [pattern.matrix() for pattern in patterns]
        self.ready = False
        self.solver = piqp.SparseSolver()
        options = self.solver.settings
        options.kkt_solver = (
            piqp.KKTSolver.sparse_multistage
            if settings.multistage
            else piqp.KKTSolver.sparse_ldlt
        )
        options.eps_abs = options.eps_duality_gap_abs = settings.tolerance
        options.max_iter = settings.max_iterations
        # Trust regions bound every subproblem: dual infeasibility can only be a false
        # alarm, which wide ranges of multipliers do set off.
        options.eps_dual_inf = 1e-15
        options.compute_timings = True

    def solve(self, P, c, A, b, G, h, lower, upper):
        for matrix, values in zip(self.matrices, (P, A, G), strict=True):
            matrix.data[:] = values
        P, A, G = self.matrices
        arguments = (P, c, A, b, G, None, h, lower, upper)
        if self.ready:
            self.solver.update(*arguments)
        else:
            self.solver.setup(*arguments)
            self.ready = True
        self.solver.solve()
        return self.solver.result


# One workspace a structure: PIQP's symbolic factorization costs as much as a solve.
_WORKSPACES: OrderedDict[tuple, _Workspace] = OrderedDict()
_WORKSPACES_LOCK = threading.Lock()
_MOST_WORKSPACES = 16


def _workspace(settings: PIQP, patterns) -> _Workspace:
    key = (settings, patterns)
    with _WORKSPACES_LOCK:
        if key not in _WORKSPACES:
            _WORKSPACES[key] = _Workspace(settings, patterns)
        _WORKSPACES.move_to_end(key)
        while len(_WORKSPACES) > _MOST_WORKSPACES:
            _WORKSPACES.popitem(last=False)
        return _WORKSPACES[key]


def _solve_on_host(settings: PIQP, patterns, data):
    P, c, A, b, G, h, lower, upper = (np.asarray(part) for part in data)
    finite = all(np.isfinite(part).all() for part in (P, c, A, b, G))
    if not finite:
        # PIQP would loop on NaN; the caller reads `solved` and the numbers say why.
        sizes = (c.size, b.size, h.size, c.size)
        report = np.array([0.0, 0.0, 0.0, np.nan, np.nan, 0.0])
        return (*(np.full(size, np.nan) for size in sizes), report)
    workspace = _workspace(settings, patterns)
    with workspace.lock:
        result = workspace.solve(P, c, A, b, G, h, lower, upper)
        info = result.info
        report = np.array(
            [
                info.status == piqp.PIQP_SOLVED,
                info.status == piqp.PIQP_PRIMAL_INFEASIBLE,
                info.iter,
                info.primal_res,
                info.dual_res,
                info.run_time,
            ],
            dtype=float,
        )
        bound = result.z_bu - result.z_bl
        return result.x.copy(), result.y.copy(), result.z_u.copy(), bound, report
