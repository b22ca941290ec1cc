"""The convex subproblem as a QP whose sparsity pattern never changes.

Columns are ordered node by node, so that the pattern is a chain of blocks with the
flight time, which every block sees, at the end. Integrals travel along the chain as
running totals: a single row over the whole flight would tie every node to every other.
"""

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from ._model import Model, PerConstraint, integral_limits
from ._qp import QP, QPReport, QPSolution, SparsePattern
from ._scaling import Scaling
from ._transcription import Transcription, Variables
from ._types import Array, Float, Scalar


class Layout:
    """Which column of the QP is which variable; -1 where there is none.

    - `states` (N, n), `controls` (M, m), `totals` (N, q), `time`: the step and the
        running totals of the integrals.
    - `buffers` (N, p): virtual buffers. `integral_buffers` (2, q): of the integrals.
    - `virtual` (2, N-1, n): virtual control, positive and negative part; only if
        `relaxed`.
    - `norms` (N, 2), `time_norm`: bounds on the step's infinity norms; only if `ball`.
    """

    def __init__(
        self, transcription: Transcription, *, relaxed: bool = False, ball: bool = False
    ):
        problem = transcription.problem
        nodes, free = transcription.nodes, transcription.control_nodes
        n, m = problem.state_size, problem.control_size
        p, q = sum(transcription.path_sizes.values()), len(problem.integrals)
        self.relaxed, self.ball = relaxed, ball
        self.columns = 0
        self.states, self.controls = _none(nodes, n), _none(free, m)
        self.totals, self.buffers = _none(nodes, q), _none(nodes, p)
        self.virtual, self.norms = _none(2, nodes - 1, n), _none(nodes, 2)
        for k in range(nodes):
            self.states[k] = self._take(n)
            if k > 0:
                self.totals[k] = self._take(q)
            if k < free:
                self.controls[k] = self._take(m)
            self.buffers[k] = self._take(p)
            if relaxed and k < nodes - 1:
                self.virtual[:, k] = self._take(2 * n).reshape(2, n)
            if ball:
                self.norms[k] = self._take(2)
        self.integral_buffers = self._take(2 * q).reshape(2, q)
        self.time = self._take(1)[0]
        self.time_norm = self._take(1)[0] if ball else -1

    def _take(self, count: int) -> np.ndarray:
        self.columns += count
        return np.arange(self.columns - count, self.columns)


def _none(*shape: int) -> np.ndarray:
    return np.full(shape, -1)


class _Entries:
    """Nonzeros of a matrix under construction: static places, traced values."""

    def __init__(self):
        self.rows, self.columns, self.values = [], [], []
        self.count = 0

    def new_rows(self, *shape: int) -> np.ndarray:
        """Numbers of further rows."""
        size = int(np.prod(shape))
        self.count += size
        return np.arange(self.count - size, self.count).reshape(shape)

    def add(self, rows, columns, values) -> None:
        shape = np.broadcast_shapes(np.shape(rows), np.shape(columns))
        self.rows.append(np.broadcast_to(rows, shape).ravel())
        self.columns.append(np.broadcast_to(columns, shape).ravel())
        self.values.append(jnp.ravel(jnp.broadcast_to(values, shape)))

    def finish(self, columns: int) -> tuple[SparsePattern, Float[Array, " nonzeros"]]:
        if not self.rows:
            empty = np.zeros(0, int)
            return SparsePattern(empty, empty, (self.count, columns)), jnp.zeros(0)
        rows, places = np.concatenate(self.rows), np.concatenate(self.columns)
        pattern = SparsePattern(rows, places, (self.count, columns))
        return pattern, jnp.concatenate(self.values)[pattern.order]


class Prices(eqx.Module):
    """What a subproblem charges beyond the model's cost, all scaled.

    - `proximal`: weight of half the squared step, the soft trust region.
    - `virtual_control`: cost of virtual control, if the layout has it.
    - `path`, `integral`: cost of virtual buffers.
    - `radius`: of the hard trust region, if the layout has one.
    """

    proximal: Scalar
    virtual_control: Float[Array, "N-1 n"]
    path: Float[Array, "N p"]
    integral: Float[Array, " q"]
    radius: Scalar


class SubproblemSolution(eqx.Module):
    """Step and multipliers of a subproblem, scaled.

    - `state`, `control`, `final_time`: multipliers of the variables' limits, upper minus
        lower; those of fixed entries stand among them.
    """

    step: Variables
    multipliers: PerConstraint
    state: Float[Array, "N n"]
    control: Float[Array, "M m"]
    final_time: Scalar
    report: QPReport

    @classmethod
    def none(cls, layout: Layout) -> "SubproblemSolution":
        """No step and no multipliers yet."""
        states = jnp.zeros(layout.states.shape)
        controls = jnp.zeros(layout.controls.shape)
        zero = jnp.zeros(())
        multipliers = PerConstraint(
            dynamics=states[1:],
            path=jnp.zeros(layout.buffers.shape),
            integral=jnp.zeros(layout.totals.shape[1]),
        )
        return cls(
            Variables(states, controls, zero),
            multipliers,
            states,
            controls,
            zero,
            QPReport.none(),
        )


def assemble(
    layout: Layout,
    transcription: Transcription,
    scaling: Scaling,
    reference: Variables,
    model: Model,
    prices: Prices,
) -> QP:
    """The QP whose solution is the best step within the model."""
    equalities, b = _equalities(layout, transcription, scaling, reference, model)
    inequalities, h = _inequalities(layout, model, prices)
    P, c = _cost(layout, model, prices)
    lower, upper = _limits(layout, transcription, scaling, reference)
    patterns, values = zip(
        *(part.finish(layout.columns) for part in (P, equalities, inequalities)),
        strict=True,
    )
    return QP(
        P=values[0],
        c=c,
        A=values[1],
        b=b,
        G=values[2],
        h=h,
        lower=lower,
        upper=upper,
        patterns=patterns,
    )


def extract(
    layout: Layout, transcription: Transcription, solution: QPSolution
) -> SubproblemSolution:
    """Steps and multipliers from the QP's vectors, in the order `assemble` gave them."""
    z, bound = solution.z, solution.bound
    nodes, n = layout.states.shape
    q = layout.totals.shape[1]
    free, m = layout.controls.shape
    y = _Reader(solution.y)
    dynamics = y.take((nodes - 1) * n).reshape(nodes - 1, n)
    y.take((nodes - 1) * q)
    states, controls = bound[layout.states], bound[layout.controls]
    time, totals = bound[layout.time], bound[layout.totals[-1]]
    fixed = _Fixed(transcription)
    states = states.at[fixed.states].add(y.take(int(fixed.states.sum())))
    held = np.broadcast_to(fixed.controls, (free, m))
    controls = controls.at[held].add(y.take(int(held.sum())))
    totals = totals.at[fixed.integrals].add(y.take(int(fixed.integrals.sum())))
    time = time + jnp.sum(y.take(int(fixed.time)))
    path = solution.w[: layout.buffers.size].reshape(layout.buffers.shape)
    return SubproblemSolution(
        step=Variables(z[layout.states], z[layout.controls], z[layout.time]),
        multipliers=PerConstraint(dynamics, path, totals),
        state=states,
        control=controls,
        final_time=time,
        report=solution.report,
    )


class _Reader:
    """Takes a vector apart from front to back."""

    def __init__(self, vector: Array):
        self.vector, self.position = vector, 0

    def take(self, count: int) -> Array:
        start = self.position
        self.position += count
        return self.vector[start : self.position]


class _Fixed:
    """Static masks of the entries that are equalities."""

    def __init__(self, transcription: Transcription):
        problem = transcription.problem
        self.states = transcription.fixed_states
        self.controls = problem.control.is_fixed
        integrals = [i.bounds.fixed[0] for i in problem.integrals.values()]
        self.integrals = np.array(integrals, dtype=bool)
        self.time = bool(problem.final_time.fixed[0])


def _equalities(layout, transcription, scaling, reference, model):
    """Linearized dynamics, running totals, fixed entries: A z = b."""
    rows = _Entries()
    residuals, jacobians = model.residuals, model.derivatives.intervals
    right = []
    at = rows.new_rows(*residuals.defects.shape)
    rows.add(at, layout.states[1:], 1.0)
    _add_jacobian(rows, at, layout, jacobians.next_state, slice(None))
    if layout.relaxed:
        rows.add(at, layout.virtual[0], 1.0)
        rows.add(at, layout.virtual[1], -1.0)
    right.append(-residuals.defects)

    growth = residuals.increments[:, :-1]
    at = rows.new_rows(*growth.shape)
    if at.size:
        rows.add(at, layout.totals[1:], 1.0)
        rows.add(at[1:], layout.totals[1:-1], -1.0)
        _add_jacobian(rows, at, layout, jacobians.increments, slice(None, -1))
        rows.add(at[-1], layout.integral_buffers[0], -1.0)
        rows.add(at[-1], layout.integral_buffers[1], 1.0)
    right.append(growth)

    fixed = _Fixed(transcription)
    lower, upper = transcription.state_limits
    targets = (0.5 * (lower + upper) - reference.states) / scaling.state
    held = np.broadcast_to(fixed.controls, layout.controls.shape)
    control = transcription.problem.control.target - reference.controls
    limits = transcription.problem.integrals.values()
    totals = [i.bounds.target for i in limits]
    totals = jnp.array(totals).reshape(len(totals)) / scaling.integral
    for mask, columns, values in (
        (fixed.states, layout.states, targets),
        (held, layout.controls, control / scaling.control),
        (fixed.integrals, layout.totals[-1], totals),
    ):
        rows.add(rows.new_rows(int(mask.sum())), columns[mask], 1.0)
        right.append(values[mask])
    if fixed.time:
        rows.add(rows.new_rows(1), layout.time, 1.0)
        time = transcription.problem.final_time.target - reference.final_time
        right.append((time / scaling.time)[None])
    return rows, jnp.concatenate([jnp.ravel(part) for part in right])


def _add_jacobian(rows, at, layout, jacobian, part):
    """Subtract a Jacobian's columns from the rows `at` (N-1, r)."""
    at = at[:, :, None]
    free = layout.controls.shape[0]
    intervals = at.shape[0]
    rows.add(at, layout.states[:-1, None, :], -jacobian.left_state[:, part])
    rows.add(at, layout.controls[:intervals, None, :], -jacobian.left_control[:, part])
    if jacobian.right_state is not None:
        rows.add(at, layout.states[1:, None, :], -jacobian.right_state[:, part])
    if jacobian.right_control is not None:
        assert free == intervals + 1
        rows.add(at, layout.controls[1:, None, :], -jacobian.right_control[:, part])
    rows.add(at[:, :, 0], layout.time, -jacobian.time[:, part])


def _inequalities(layout, model, prices):
    """Linearized path constraints with buffers, and the hard trust region: G z <= h."""
    rows = _Entries()
    derivatives, path = model.derivatives, model.residuals.path
    right = [-jnp.ravel(path)]
    at = rows.new_rows(*path.shape)
    if at.size:
        free = layout.controls.shape[0]
        rows.add(at[:, :, None], layout.states[:, None, :], derivatives.nodes.path_state)
        rows.add(at, layout.buffers, -1.0)
        rows.add(at, layout.time, derivatives.nodes.path_time)
        rows.add(
            at[:free, :, None], layout.controls[:, None, :], derivatives.nodes.path_control[:free]
        )
        if free < at.shape[0]:
            # The last node's control is the held one.
            held = layout.controls[-1]
            rows.add(at[-1, :, None], held[None, :], derivatives.nodes.path_control[-1])
    if layout.ball:
        free = layout.controls.shape[0]
        for columns, norm in (
            (layout.states, layout.norms[:, :1]),
            (layout.controls, layout.norms[:free, 1:]),
            (layout.time, layout.time_norm),
        ):
            for sign in (1.0, -1.0):
                at = rows.new_rows(*np.shape(columns))
                rows.add(at, columns, sign)
                rows.add(at, norm, -1.0)
                right.append(jnp.zeros(at.size))
        at = rows.new_rows(layout.norms.shape[0])
        rows.add(at[:, None], layout.norms, 1.0)
        rows.add(at, layout.time_norm, 1.0)
        right.append(jnp.broadcast_to(prices.radius, at.shape))
    return rows, jnp.concatenate(right)


def _cost(layout, model, prices):
    """The model's cost, the proximal term and the price of virtual variables."""
    P = _Entries()
    P.new_rows(layout.columns)
    nodes, n = layout.states.shape
    free, m = layout.controls.shape
    proximal = prices.proximal / nodes
    blocks = model.hessian + proximal * jnp.eye(n + m)
    up, across = np.triu_indices(n + m)
    both = np.concatenate([layout.states[:free], layout.controls], axis=1)
    P.add(both[:, up], both[:, across], blocks[:free, up, across])
    up, across = np.triu_indices(n)
    only = layout.states[free:]
    P.add(only[:, up], only[:, across], blocks[free:, up, across])
    # The flight time moves every node: it counts once for each of them.
    P.add(layout.time, layout.time, prices.proximal)

    slope = model.gradient
    c = jnp.zeros(layout.columns)
    c = c.at[layout.states].set(slope.states).at[layout.controls].set(slope.controls)
    c = c.at[layout.time].set(slope.final_time)
    c = c.at[layout.buffers].set(prices.path)
    c = c.at[layout.integral_buffers].set(prices.integral)
    if layout.relaxed:
        c = c.at[layout.virtual].set(prices.virtual_control)
    return P, c


def _limits(layout, transcription, scaling, reference):
    """Limits of every column: of the variables, and zero below virtual ones."""
    problem, fixed = transcription.problem, _Fixed(transcription)
    lower = jnp.full(layout.columns, -jnp.inf)
    upper = jnp.full(layout.columns, jnp.inf)
    totals = integral_limits(transcription, scaling)
    control = (problem.control.lower, problem.control.upper)
    time = (problem.final_time.lower, problem.final_time.upper)
    for columns, limits, mask, origin, scale in (
        (
            layout.states,
            transcription.state_limits,
            fixed.states,
            reference.states,
            scaling.state,
        ),
        (layout.controls, control, fixed.controls, reference.controls, scaling.control),
        (layout.time, time, fixed.time, reference.final_time, scaling.time),
        (layout.totals[-1], totals, fixed.integrals, 0.0, 1.0),
    ):
        # Fixed entries are rows of the equalities: an interior-point method needs room
        # between two limits.
        low = jnp.where(mask, -jnp.inf, (limits[0] - origin) / scale)
        high = jnp.where(mask, jnp.inf, (limits[1] - origin) / scale)
        lower, upper = lower.at[columns].set(low), upper.at[columns].set(high)
    for columns in (layout.buffers, layout.integral_buffers):
        lower = lower.at[columns].set(0.0)
    if layout.relaxed:
        lower = lower.at[layout.virtual].set(0.0)
    return lower, upper
