"""Second derivatives of the discrete problem's Lagrangian."""

import jax
import jax.numpy as jnp
import numpy as np

from ._curvature import Curvature
from ._loop import over_all
from ._nonlinear import Nonlinearity, hessian
from ._per_constraint import PerConstraint
from ._second_order import interval_hessian
from ._step import Span
from ._transcription import Transcription, Variables
from ._types import Array, Float


def node_shares(
    transcription: Transcription,
) -> tuple[Float[Array, " N"], Float[Array, " N"]]:
    """The share of the flight each node's state stands for, and each node's control."""
    _, widths = transcription.grid
    none = jnp.zeros(1)
    of_state = 0.5 * (jnp.append(widths, none) + jnp.append(none, widths))
    # A held control acts on the interval behind its node only.
    held = jnp.append(widths, none)
    return of_state, held if transcription.borrows_control else of_state


def rate_weights(multipliers: PerConstraint) -> Float[Array, " r"]:
    """What the Lagrangian weighs the integrals and the running cost with."""
    return jnp.append(multipliers.integral, 1.0)


def nodal_curvature(
    transcription: Transcription, variables: Variables, multipliers: PerConstraint
) -> Curvature:
    """Hessian of the weighted integrands and path constraints, node by node.

    The second derivative of the Lagrangian but for the dynamics' part: integrands
    count with the time their node stands for, path constraints once, those between the
    nodes at the node before.
    """
    problem, final_time = transcription.problem, variables.final_time
    size = problem.state_size
    weights_of_rates = rate_weights(multipliers)
    weights = multipliers.path.at[:-1].add(_of_path(transcription, multipliers.between))

    def block(fraction, x, u, of_state, of_control, weights):
        t = final_time * fraction

        def rates(z):
            return weights_of_rates @ problem.rates(t, z[:size], z[size:])

        def path(z):
            return weights @ problem.path(t, z[:size], z[size:])

        z = jnp.concatenate([x, u])
        share = jnp.concatenate(
            [
                jnp.broadcast_to(of_state, x.shape),
                jnp.broadcast_to(of_control, u.shape),
            ]
        )
        root = jnp.sqrt(final_time * share)
        curved = hessian(rates, z) * jnp.outer(root, root)
        return curved + hessian(path, z) if weights.size else curved

    blocks = jax.vmap(block)(
        transcription.fractions,
        variables.states,
        transcription.nodal_controls(variables),
        *node_shares(transcription),
        weights,
    )
    terminal = hessian(
        lambda x: problem.terminal_cost(final_time, x), variables.states[-1]
    )
    blocks = blocks.at[-1, :size, :size].add(terminal)
    borrows = transcription.borrows_control
    if borrows:
        blocks = blocks.at[-1, size:].set(0.0).at[-1, :, size:].set(0.0)
    two_sided = transcription.discretization.holds_right
    return Curvature.of_nodes(blocks, size, two_sided=two_sided, borrows=borrows)


def curved_entries(transcription: Transcription) -> np.ndarray:
    """The entries of a node's (x, u) by which `nodal_curvature` may not be zero."""
    problem = transcription.problem
    n = problem.state_size

    def values(z):
        at = (jnp.zeros(()), z[:n], z[n:])
        end = problem.terminal_cost(*at[:2])
        return jnp.concatenate([problem.rates(*at), problem.path(*at), end[None]])

    return Nonlinearity.of(values, n + problem.control_size).entries


def _of_path(
    transcription: Transcription, between: Float[Array, "I b"]
) -> Float[Array, "I p"]:
    """Multipliers of each path constraint, all parts of an interval together."""
    watch, parts = transcription.watch, transcription.discretization.between
    by_part = between.reshape(between.shape[0], parts, watch.size)
    return jnp.sum(by_part[:, :, watch.limits :], axis=1)


def lagrangian_hessian(
    transcription: Transcription,
    variables: Variables,
    substeps: Array | int,
    multipliers: PerConstraint,
) -> Curvature:
    """Hessian of the Lagrangian, exact."""
    return Curvature.assembled(
        _node_blocks(transcription, variables, multipliers),
        _interval_blocks(transcription, variables, substeps, multipliers),
        transcription.problem.state_size,
        borrows=transcription.borrows_control,
    )


def _interval_blocks(transcription, variables, substeps, multipliers) -> Array:
    flow = transcription.flow(substeps)
    controls = transcription.nodal_controls(variables)
    intervals = transcription.nodes - 1
    # A defect is the next node minus the flow's end.
    weights = -multipliers.dynamics
    if flow.gathers:
        rates = rate_weights(multipliers)
        rates = jnp.broadcast_to(rates, (intervals, rates.size))
        weights = jnp.concatenate([weights, rates], axis=1)
    parts = transcription.discretization.between
    pushes = multipliers.between.reshape(intervals, parts, flow.watch.size)

    def block(start, width, x, left, right, weights, pushes):
        span = Span(start, width, left, right, variables.final_time)
        return interval_hessian(flow, span, x, weights, pushes)

    starts, widths = transcription.grid
    left, right = controls[:-1], controls[1:]
    return over_all(
        block, starts, widths, variables.states[:-1], left, right, weights, pushes
    )


def _node_blocks(transcription, variables, multipliers) -> Array:
    """By (x, u, flight time) of each node: path constraints, costs and, by the trapezoid
    rule, integrals."""
    problem, final_time = transcription.problem, variables.final_time
    n = problem.state_size
    gathers = transcription.flow(1).gathers
    shares, _ = node_shares(transcription)
    rates = rate_weights(multipliers)

    def of_node(fraction, share, x, u, weights):
        def total(v):
            t, x, u = v[-1] * fraction, v[:n], v[n:-1]
            value = weights @ problem.path(t, x, u) if weights.size else jnp.zeros(())
            if gathers:
                return value
            return value + v[-1] * share * (rates @ problem.rates(t, x, u))

        return hessian(total, jnp.concatenate([x, u, final_time[None]]))

    controls = transcription.nodal_controls(variables)
    blocks = jax.vmap(of_node)(
        transcription.fractions, shares, variables.states, controls, multipliers.path
    )

    def terminal(v):
        return problem.terminal_cost(v[-1], v[:n])

    last = jnp.concatenate([variables.states[-1], controls[-1], final_time[None]])
    return blocks.at[-1].add(hessian(terminal, last))
