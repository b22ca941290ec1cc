"""Equality-constrained quadratic programs along linearized dynamics, stage by stage.

    minimize 1/2 z'Hz + g'z  subject to the linearized dynamics, some variables forced

A Riccati recursion from the last node to the first eliminates one stage after the other.
It needs no convexity but along the dynamics, and tells whether there is any. Its cost is
linear in the number of nodes; once it is done, further right-hand sides are cheap.

The state y of the recursion is (x, u, totals, flight time): u only where an interval
depends on the controls at both its ends, the totals of the integrals as far as they have
come, and the flight time, which never changes. The decision v of an interval is its one
control, or the control at its right end.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from ._curvature import Curvature
from ._transcription import Derivatives, Residuals, Variables
from ._types import Array, Float, Scalar


class Program(eqx.Module):
    """Matrices and vectors of the quadratic program.

    - `by_state`, `by_control`, `drift`: y at the right end of an interval, from y at its
        left, the decision v, and nothing.
    - `cost`, `mixed`, `own`: second derivatives of a stage's cost by y, by v and y, by v.
    - `slope`, `pull`: first derivatives by y and v. `last`, `last_slope`: at the end.
    """

    by_state: Float[Array, "I y y"]
    by_control: Float[Array, "I y m"]
    drift: Float[Array, "I y"]
    cost: Float[Array, "I y y"]
    mixed: Float[Array, "I m y"]
    own: Float[Array, "I m m"]
    last: Float[Array, "y y"]
    slope: Float[Array, "I y"]
    pull: Float[Array, "I m"]
    last_slope: Float[Array, " y"]


class Forced(eqx.Module):
    """Variables that are told what to be: which ones, and what.

    - `first`: at the first node, the totals (zero) and the flight time included.
    - `controls`: the decisions.
    """

    first: tuple[Float[Array, " y"], Float[Array, " y"]]
    controls: tuple[Float[Array, "I m"], Float[Array, "I m"]]


class Factors(eqx.Module):
    """What the recursion leaves.

    - `ahead`: second derivatives of the cost still to come by y at each right end.
    - `first`: at the first node.
    - `inverse`: of what is left of each stage's `own`, zero where v is forced; `own`
        that remainder. `cross`: the remainder of `mixed`. `closed`: y at the right end by
        y at the left with the best decision.
    - `convexity`: least curvature that was met along the dynamics.
    """

    ahead: Float[Array, "I y y"]
    first: Float[Array, "y y"]
    inverse: Float[Array, "I m m"]
    own: Float[Array, "I m m"]
    cross: Float[Array, "I m y"]
    closed: Float[Array, "I y y"]
    convexity: Scalar


def factorize(program: Program, forced: Forced) -> Factors:
    """The recursion for the second derivatives."""
    size = program.last.shape[0]

    def back(ahead, stage):
        by_state, by_control, cost, mixed, own, told = stage
        through = jnp.concatenate([by_state, by_control], axis=1)
        whole = through.T @ ahead @ through
        own, cross = own + whole[size:, size:], mixed + whole[size:, :size]
        inverse, least = _inverse(own, told)
        left = cost + whole[:size, :size] - cross.T @ inverse @ cross
        return 0.5 * (left + left.T), (inverse, own, cross, ahead, least)

    first, (inverse, own, cross, ahead, least) = jax.lax.scan(
        back,
        program.last,
        (
            program.by_state,
            program.by_control,
            program.cost,
            program.mixed,
            program.own,
            forced.controls[0],
        ),
        reverse=True,
    )
    gain = -jnp.einsum("kij,kjy->kiy", inverse, cross)
    closed = program.by_state + jnp.einsum("kyi,kiz->kyz", program.by_control, gain)
    _, begun = _inverse(first, forced.first[0])
    convexity = jnp.minimum(jnp.min(least), begun)
    return Factors(ahead, first, inverse, own, cross, closed, convexity)


def _inverse(matrix: Float[Array, "a a"], told: Float[Array, " a"]):
    """Inverse by the entries that are free, and their least eigenvalue."""
    free = 1.0 - told
    kept = matrix * jnp.outer(free, free)
    # What is forced must not pass for a lack of convexity.
    kept += jnp.diag(told)
    # Controls may act more than a thousand times stronger than others.
    size = jnp.abs(jnp.diagonal(kept))
    unit = jnp.where(size > 0.0, 1.0 / jnp.sqrt(jnp.where(size > 0.0, size, 1.0)), 1.0)
    values, vectors = jnp.linalg.eigh(kept * jnp.outer(unit, unit))
    inverse = (vectors / values[None]) @ vectors.T
    return inverse * jnp.outer(unit * free, unit * free), jnp.min(values)


def solve(
    program: Program, forced: Forced, factors: Factors
) -> tuple[Float[Array, "N y"], Float[Array, "I m"], Float[Array, "I y"]]:
    """The y of every node, the decisions, and the costates of the intervals' ends.

    A costate is what the cost still to come changes by with y at the right end.
    """
    drift = jnp.einsum("kyz,kz->ky", factors.ahead, program.drift)
    pushed = program.pull + jnp.einsum("kym,ky->km", program.by_control, drift)
    told, target = forced.controls
    told = told * target
    pushed += jnp.einsum("kij,kj->ki", factors.own, told)
    rest = told - jnp.einsum("kij,kj->ki", factors.inverse, pushed)
    slope = program.slope + jnp.einsum("kyz,ky->kz", program.by_state, drift)
    slope += jnp.einsum("kmy,km->ky", factors.cross, rest)

    def back(ahead, stage):
        closed, slope = stage
        return closed.T @ ahead + slope, ahead

    first, ahead = jax.lax.scan(
        back, program.last_slope, (factors.closed, slope), reverse=True
    )
    fed = jnp.einsum("kym,ky->km", program.by_control, ahead)
    rest -= jnp.einsum("kij,kj->ki", factors.inverse, fed)
    told, target = forced.first
    told = told * target
    inverse, _ = _inverse(factors.first, forced.first[0])
    begin = told - inverse @ (first + factors.first @ told)

    def onward(y, stage):
        by_state, by_control, drift, inverse, cross, rest = stage
        decision = rest - inverse @ (cross @ y)
        # Not by the closed loop's matrix: rounded, that breaks the dynamics a little,
        # and the cost to come is steep in what breaks them.
        after = by_state @ y + by_control @ decision + drift
        return after, (after, decision)

    dynamics = (program.by_state, program.by_control, program.drift)
    feedback = (factors.inverse, factors.cross, rest)
    _, (after, decisions) = jax.lax.scan(onward, begin, (*dynamics, *feedback))
    y = jnp.concatenate([begin[None], after])
    costates = ahead + jnp.einsum("kyz,kz->ky", factors.ahead, after)
    return y, decisions, costates


def arranged(
    residuals: Residuals,
    derivatives: Derivatives,
    curvature: Curvature,
    gradient: Variables,
    totals: tuple[Float[Array, " q"], Float[Array, " q"]],
) -> Program:
    """The quadratic program of a model.

    **Arguments:**

    - `curvature`, `gradient`: of the cost.
    - `totals`: second and first derivatives of the cost by the integrals' totals.
    """
    flow, growth = derivatives.intervals.next_state, derivatives.intervals.increments[:-1]
    intervals, n, m = flow.left_control.shape
    q = growth.time.shape[1]
    two_sided = gradient.controls.shape[0] > intervals
    u = m if two_sided else 0
    x, held, sums, time = np.split(np.arange(n + u + q + 1), [n, n + u, n + u + q])
    y = n + u + q + 1
    by_state = jnp.zeros((intervals, y, y))
    by_state = by_state.at[:, :n, :n].set(flow.left_state)
    by_state = by_state.at[:, :n, -1].set(flow.time)
    by_control = jnp.zeros((intervals, y, m))
    drift = jnp.zeros((intervals, y)).at[:, :n].set(-residuals.defects)
    if two_sided:
        by_state = by_state.at[:, :n, n : n + m].set(flow.left_control)
        if flow.right_control is not None:
            by_control = by_control.at[:, :n].set(flow.right_control)
        by_control = by_control.at[:, held, np.arange(m)].set(1.0)
    else:
        by_control = by_control.at[:, :n].set(flow.left_control)
    grown = jnp.zeros((intervals, q, y))
    grown = grown.at[:, :, :n].set(growth.left_state).at[:, :, -1].set(growth.time)
    chosen = jnp.zeros((intervals, q, m))
    if two_sided:
        grown = grown.at[:, :, n : n + m].set(growth.left_control)
        if growth.right_control is not None:
            chosen = growth.right_control
    else:
        chosen = growth.left_control
    gained = residuals.increments[:, :-1]
    if growth.right_state is not None:
        grown += growth.right_state @ by_state[:, :n]
        chosen += growth.right_state @ by_control[:, :n]
        gained += jnp.einsum("kqn,kn->kq", growth.right_state, drift[:, :n])
    by_state = by_state.at[:, sums].set(grown).at[:, sums, sums].add(1.0)
    by_state = by_state.at[:, -1, -1].set(1.0)
    by_control = by_control.at[:, sums].set(chosen)
    drift = drift.at[:, sums].set(gained)
    return Program(
        by_state,
        by_control,
        drift,
        *_costs(curvature, gradient, totals, flow, residuals, (n, u, q)),
    )


def _costs(curvature, gradient, totals, flow, residuals, sizes):
    n, u, q = sizes
    m, intervals = gradient.controls.shape[1], residuals.defects.shape[0]
    y, inner = n + u + q + 1, n + u
    blocks, border, controls = curvature.blocks, curvature.border, gradient.controls
    if curvature.tail is not None:
        # The last node's state, seen from the node whose control it borrows.
        tail = curvature.tail
        by_x, by_u = tail @ flow.left_state[-1], tail @ flow.left_control[-1]
        blocks = blocks.at[-2, n:, :n].add(by_x).at[-2, :n, n:].add(by_x.T)
        blocks = blocks.at[-2, n:, n:].add(by_u + by_u.T)
        border = border.at[-2, n:].add(tail @ flow.time[-1])
        controls = controls.at[-1].add(-tail @ residuals.defects[-1])
    cost = jnp.zeros((intervals + 1, y, y))
    cost = cost.at[:, :inner, :inner].set(blocks[:, :inner, :inner])
    cost = cost.at[:, :inner, -1].set(border[:, :inner])
    cost = cost.at[:, -1, :inner].set(border[:, :inner])
    cost = cost.at[0, -1, -1].add(curvature.corner)
    sums = np.arange(inner, inner + q)
    cost = cost.at[-1, sums, sums].add(totals[0])
    slope = jnp.zeros((intervals + 1, y)).at[:, :n].set(gradient.states)
    slope = slope.at[0, -1].set(gradient.final_time).at[-1, sums].set(totals[1])
    mixed, own = jnp.zeros((intervals, m, y)), jnp.zeros((intervals, m, m))
    if u:
        slope, pull = slope.at[:, n:inner].set(controls), jnp.zeros((intervals, m))
        if curvature.ahead is not None:
            mixed = mixed.at[:, :, :inner].set(curvature.ahead.mT)
    else:
        pull, own = controls, blocks[:-1, n:, n:]
        mixed = mixed.at[:, :, :n].set(blocks[:-1, n:, :n])
        mixed = mixed.at[:, :, -1].set(border[:-1, n:])
    return cost[:-1], mixed, own, cost[-1], slope[:-1], pull, slope[-1]
