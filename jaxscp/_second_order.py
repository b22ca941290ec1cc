"""Second derivatives of the flow, contracted with multipliers.

Exact for the discrete flow: the adjoint of every Runge-Kutta step, from the last to the
first. Its cost is a few times that of the first derivatives, whatever their number.
"""

import jax
import jax.numpy as jnp

from ._discretization import (
    RK4_NODES,
    RK4_WEIGHTS,
    Discretization,
    integrand_rates,
    moment,
)
from ._problem import OptimalControlProblem
from ._types import Array, Float, Scalar


def flow_hessian(
    problem: OptimalControlProblem,
    discretization: Discretization,
    substeps: Array | int,
    span: tuple[Scalar, Scalar],
    x: Float[Array, " n"],
    u: Float[Array, " m"],
    final_time: Scalar,
    weights: Float[Array, " e"],
) -> Float[Array, "v v"]:
    """Hessian of a weighted sum of what one interval of a held control ends with.

    **Arguments:**

    - `weights`: of the state at the end, and of the growth of integrals and cost.

    **Returns:** by v = (x, u, final time).
    """
    n, v = x.size, jnp.concatenate([x, u, final_time[None]])
    by_state, by_growth = weights[:n], weights[n:]

    def end(index, v):
        held = v[n:-1]
        return _one_step(problem, discretization, substeps, index, span, held, v)

    def forward(index, carry):
        x, starts = carry
        return end(index, v.at[:n].set(x))[0], starts.at[index].set(x)

    starts = jnp.zeros((discretization.max_substeps, n))
    _, starts = jax.lax.fori_loop(0, substeps, forward, (x, starts))

    def backward(count, carry):
        costate, hessian = carry
        index = substeps - 1 - count
        here = v.at[:n].set(starts[index])

        def gradient_and_end(v):
            def weighted(v):
                ending, growth = end(index, v)
                return costate @ ending + by_growth @ growth, ending

            return jax.grad(weighted, has_aux=True)(v)

        (gradient, _), (curved, slopes) = jax.vmap(
            lambda tangent: jax.jvp(gradient_and_end, (here,), (tangent,)),
            out_axes=((None, None), -1),
        )(jnp.eye(v.size))
        # Control and flight time pass through every step unchanged.
        through = jnp.concatenate([slopes, jnp.eye(v.size)[n:]])
        return gradient[:n], through.T @ hessian @ through + curved

    nothing = jnp.zeros((v.size, v.size))
    _, hessian = jax.lax.fori_loop(0, substeps, backward, (by_state, nothing))
    return hessian


def _one_step(problem, discretization, substeps, index, span, u, v):
    """State and growth of the integrals after one Runge-Kutta step."""
    x, final_time = v[: problem.state_size], v[-1]
    step = 1.0 / substeps
    seconds = final_time * span[1] * step

    def stage(carry, coefficients):
        slope, change, growth = carry
        node, weight = coefficients
        fraction = (index + node) * step
        t, held = moment(discretization, span, fraction, u, u, final_time)
        place = x + node * seconds * slope
        slope = problem.dynamics(t, place, held)
        rates = integrand_rates(problem, t, place, held)
        return (slope, change + weight * slope, growth + weight * rates), None

    nothing = jnp.zeros_like(x)
    first = (nothing, nothing, jnp.zeros(len(problem.integrals) + 1))
    coefficients = (jnp.asarray(RK4_NODES), jnp.asarray(RK4_WEIGHTS))
    (_, change, growth), _ = jax.lax.scan(stage, first, coefficients)
    return x + seconds * change, seconds * growth
