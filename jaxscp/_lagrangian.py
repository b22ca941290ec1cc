"""Second derivatives of the discrete problem's Lagrangian."""

import jax
import jax.numpy as jnp

from ._discretization import integrand_rates
from ._second_order import flow_hessian
from ._transcription import Transcription, Variables
from ._types import Array, Float


def nodal_curvature(
    transcription: Transcription,
    variables: Variables,
    rate_weights: Float[Array, " r"],
    path_weights: Float[Array, "N p"],
) -> Float[Array, "N w w"]:
    """Hessian of the weighted integrands and path constraints, node by node.

    The second derivative of the Lagrangian but for the dynamics' part: integrands
    count with the time their node stands for, path constraints once.
    """
    _, widths = transcription.grid
    none = jnp.zeros(1)
    state_share = 0.5 * (jnp.append(widths, none) + jnp.append(none, widths))
    # A held control acts on the interval behind its node only.
    held_control = transcription.control_nodes < transcription.nodes
    control_share = jnp.append(widths, none) if held_control else state_share
    final_time = variables.final_time
    size = transcription.problem.state_size

    def block(fraction, x, u, of_state, of_control, weights):
        t = final_time * fraction

        def rates(z):
            values = integrand_rates(transcription.problem, t, z[:size], z[size:])
            return rate_weights @ values

        def path(z):
            return weights @ transcription.path(t, z[:size], z[size:])

        z = jnp.concatenate([x, u])
        share = jnp.concatenate(
            [
                jnp.broadcast_to(of_state, x.shape),
                jnp.broadcast_to(of_control, u.shape),
            ]
        )
        root = jnp.sqrt(final_time * share)
        hessian = jax.hessian(rates)(z) * jnp.outer(root, root)
        return hessian + jax.hessian(path)(z) if weights.size else hessian

    blocks = jax.vmap(block)(
        transcription.fractions,
        variables.states,
        transcription.nodal_controls(variables),
        state_share,
        control_share,
        path_weights,
    )
    terminal = jax.hessian(transcription.problem.terminal_cost, argnums=1)(
        final_time, variables.states[-1]
    )
    blocks = blocks.at[-1, :size, :size].add(rate_weights[-1] * terminal)
    if not held_control:
        return blocks
    # The last node has no control of its own.
    return blocks.at[-1, size:].set(0.0).at[-1, :, size:].set(0.0)


def lagrangian_hessian(
    transcription: Transcription,
    variables: Variables,
    substeps: Array | int,
    costates: Float[Array, "I n"],
    rate_weights: Float[Array, " r"],
    path_weights: Float[Array, "N p"],
) -> Float[Array, "N v v"]:
    """Hessian of the Lagrangian, exact, by (x, u, flight time) of each node.

    **Arguments:**

    - `costates`: multipliers of the defects.
    - `rate_weights`: of the integrals and the cost. `path_weights`: of the path
        constraints.
    """
    size, final_time = transcription.problem.state_size, variables.final_time
    # A defect is the next node minus the flow's end.
    weights = jnp.concatenate(
        [
            -costates,
            jnp.broadcast_to(
                rate_weights, (transcription.nodes - 1, *rate_weights.shape)
            ),
        ],
        axis=1,
    )
    flow = jax.vmap(
        lambda span, x, u, weights: flow_hessian(
            transcription.problem,
            transcription.discretization,
            substeps,
            span,
            x,
            u,
            final_time,
            weights,
        )
    )(transcription.grid, variables.states[:-1], variables.controls, weights)

    def at_node(fraction, x, u, weights):
        def path(v):
            return weights @ transcription.path(v[-1] * fraction, v[:size], v[size:-1])

        return jax.hessian(path)(jnp.concatenate([x, u, final_time[None]]))

    def terminal(v):
        return rate_weights[-1] * transcription.problem.terminal_cost(v[-1], v[:size])

    last = jnp.concatenate(
        [variables.states[-1], variables.controls[-1], final_time[None]]
    )
    blocks = jnp.zeros((transcription.nodes, last.size, last.size)).at[:-1].add(flow)
    blocks = blocks.at[-1].add(jax.hessian(terminal)(last))
    if not path_weights.size:
        return blocks
    controls = transcription.nodal_controls(variables)
    path = jax.vmap(at_node)(
        transcription.fractions, variables.states, controls, path_weights
    )
    return blocks + path
