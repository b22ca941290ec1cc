"""From the blocks of a convex subproblem to the matrices and vectors of its QP."""

import jax
import numpy as np

from ._intervals import Jacobian
from ._layout import Entries, Layout, Structure
from ._qp import QP
from ._subproblem_data import Limits, Prices, SubproblemData


def assembled(layout: Layout, structure: Structure, data: SubproblemData) -> QP:
    """The QP of a subproblem's blocks."""
    P, A, G = (Entries() for _ in range(3))
    P.new_rows(layout.columns)
    b = np.concatenate(
        [
            *_dynamics(A, layout, data, relaxed=structure.relaxed),
            *_totals(A, layout, data),
            *_fixed(A, layout, data.limits),
        ]
    )
    h = [*_path(G, layout, data), *_between(G, layout, structure, data)]
    if structure.ball:
        h += _ball(G, layout, data.prices)
    c = _cost(P, layout, data, relaxed=structure.relaxed)
    lower, upper = _box(layout, data.limits, relaxed=structure.relaxed)
    matrices = [part.matrix(layout.columns) for part in (P, A, G)]
    return QP(
        matrices[0], c, matrices[1], b, matrices[2], np.concatenate(h), lower, upper
    )


def _dynamics(A: Entries, layout: Layout, data: SubproblemData, *, relaxed: bool):
    """Linearized dynamics."""
    defects = data.residuals.defects
    rows = A.new_rows(*defects.shape)
    A.add(rows, layout.states[1:], 1.0)
    _subtract(A, rows, layout, data.derivatives.intervals.next_state)
    if relaxed:
        A.add(rows, layout.virtual[0], 1.0)
        A.add(rows, layout.virtual[1], -1.0)
    yield -defects.ravel()


def _totals(A: Entries, layout: Layout, data: SubproblemData):
    """Integrals up to each node; the last one may lean on its buffers."""
    growth = data.residuals.increments[:, :-1]
    rows = A.new_rows(*growth.shape)
    if rows.size:
        A.add(rows, layout.totals[1:], 1.0)
        A.add(rows[1:], layout.totals[1:-1], -1.0)
        _subtract(A, rows, layout, data.derivatives.intervals.increments[:-1])
        A.add(rows[-1], layout.integral_buffers[0], -1.0)
        A.add(rows[-1], layout.integral_buffers[1], 1.0)
    yield growth.ravel()


def _subtract(A: Entries, rows, layout: Layout, jacobian: Jacobian):
    """What an interval's quantities, one row each, owe to its ends."""
    _add(A, rows, layout, jax.tree.map(np.negative, jacobian))


def _add(A: Entries, rows, layout: Layout, jacobian: Jacobian):
    """An interval's quantities, one row each."""
    rows = rows[:, :, None]
    intervals = rows.shape[0]
    states, controls = layout.states[:, None, :], layout.controls[:, None, :]
    A.add(rows, states[:-1], jacobian.left_state)
    A.add(rows, controls[:intervals], jacobian.left_control)
    if jacobian.right_state is not None:
        A.add(rows, states[1:], jacobian.right_state)
    if jacobian.right_control is not None:
        A.add(rows, controls[1:], jacobian.right_control)
    A.add(rows[:, :, 0], layout.time, jacobian.time)


def _fixed(A: Entries, layout: Layout, limits: Limits):
    """Fixed entries: an interior-point method needs room between two limits."""
    for mask, columns, (target, _) in _limited(layout, limits):
        A.add(A.new_rows(int(mask.sum())), columns[mask], 1.0)
        yield target[mask]


def _limited(layout: Layout, limits: Limits):
    """Mask of the fixed entries, columns and limits of each kind of variable."""
    return (
        (layout.fixed_states, layout.states, limits.state),
        (layout.fixed_controls, layout.controls, limits.control),
        (layout.fixed_integrals, layout.totals[-1], limits.integral),
        (layout.fixed_time, np.array([layout.time]), limits.time),
    )


def _path(G: Entries, layout: Layout, data: SubproblemData):
    """Linearized path constraints, less their buffers."""
    nodes, path = data.derivatives.nodes, data.residuals.path
    rows = G.new_rows(*path.shape)
    if rows.size:
        # Where a node has no control of its own, the last one is held to it.
        G.add(rows[:, :, None], layout.states[:, None, :], nodes.path_state)
        G.add(rows[:, :, None], _held(layout)[:, None, :], nodes.path_control)
        G.add(rows, layout.time, nodes.path_time)
        G.add(rows, layout.buffers, -1.0)
    yield -path.ravel()


def _held(layout: Layout) -> np.ndarray:
    """The control of each node; one that has none of its own borrows the last."""
    nodes, free = layout.states.shape[0], layout.controls.shape[0]
    return layout.controls[np.minimum(np.arange(nodes), free - 1)]


def _between(G: Entries, layout: Layout, structure: Structure, data: SubproblemData):
    """Linearized peaks between the nodes, less their buffers."""
    peaks, watch = data.residuals.between, structure.watch
    rows = G.new_rows(*peaks.shape)
    if rows.size:
        _add(G, rows, layout, data.derivatives.intervals.between)
        by_part = rows.reshape(rows.shape[0], structure.parts, watch.size)
        limits, path = np.split(by_part, [watch.limits], axis=2)
        G.add(path, layout.buffers[:-1, None, :], -1.0)
        if structure.relaxed:
            G.add(limits, layout.limit_buffers[:, None, :], -1.0)
    yield -peaks.ravel()


def _ball(G: Entries, layout: Layout, prices: Prices):
    """The hard trust region: two auxiliary variables a node bound the step's norms."""
    free = layout.controls.shape[0]
    for columns, norm in (
        (layout.states, layout.norms[:, :1]),
        (layout.controls, layout.norms[:free, 1:]),
        (np.array([layout.time]), layout.time_norm),
    ):
        for sign in (1.0, -1.0):
            rows = G.new_rows(*columns.shape)
            G.add(rows, columns, sign)
            G.add(rows, norm, -1.0)
            yield np.zeros(rows.size)
    rows = G.new_rows(layout.norms.shape[0])
    G.add(rows[:, None], layout.norms, 1.0)
    G.add(rows, layout.time_norm, 1.0)
    yield np.full(rows.size, prices.radius)


def _cost(P: Entries, layout: Layout, data: SubproblemData, *, relaxed: bool):
    """The model's cost, the damping and the prices of virtual variables."""
    n, (free, m) = layout.states.shape[1], layout.controls.shape
    prices, gradient, curvature = data.prices, data.gradient, data.curvature
    blocks, border = curvature.blocks, curvature.border
    up, across = np.triu_indices(n + m)
    both = np.concatenate([layout.states[:free], layout.controls], axis=1)
    P.add(both[:, up], both[:, across], blocks[:free, up, across])
    up, across = np.triu_indices(n)
    only = layout.states[free:]
    P.add(only[:, up], only[:, across], blocks[free:, up, across])
    P.add(both, layout.time, border[:free])
    P.add(only, layout.time, border[free:, :n])
    P.add(layout.time, layout.time, curvature.corner)
    P.add(layout.totals[-1], layout.totals[-1], data.of_totals[0])
    if curvature.ahead is not None:
        ahead = layout.controls[1:, None, :]
        P.add(both[:-1, :, None], ahead, curvature.ahead)
    if curvature.tail is not None:
        P.add(layout.controls[-1][:, None], layout.states[-1], curvature.tail)

    c = np.zeros(layout.columns)
    c[layout.states], c[layout.controls] = gradient.states, gradient.controls
    c[layout.time] = gradient.final_time
    c[layout.totals[-1]] = data.of_totals[1]
    c[layout.buffers], c[layout.integral_buffers] = prices.path, prices.integral
    if relaxed:
        c[layout.virtual] = prices.virtual_control
        c[layout.limit_buffers] = prices.limit
    return c


def _box(layout: Layout, limits: Limits, *, relaxed: bool):
    """Limits of every column: of variables not fixed, and zero below virtual ones."""
    lower = np.full(layout.columns, -np.inf)
    upper = np.full(layout.columns, np.inf)
    for mask, columns, (low, high) in _limited(layout, limits):
        lower[columns] = np.where(mask, -np.inf, low)
        upper[columns] = np.where(mask, np.inf, high)
    for columns in (layout.buffers, layout.integral_buffers):
        lower[columns] = 0.0
    if relaxed:
        lower[layout.virtual] = lower[layout.limit_buffers] = 0.0
    if layout.time_norm >= 0:
        # Also where there is nothing to bound: a node without a control of its own.
        lower[layout.norms] = lower[layout.time_norm] = 0.0
    return lower, upper
