"""The flow over every interval by jaxscp, and by diffrax."""

import time

import diffrax
import jax
import jax.numpy as jnp
import numpy as np

from jaxscp import Discretization, Quadrature
from jaxscp._compiler import compiler_options
from jaxscp._flow import Flow
from jaxscp._intervals import linearize

from .discretizer_case import Case, Prepared


def jaxscp(case: Case, substeps: int, batch: int | None = None) -> Prepared:
    """Of one trajectory, or of a batch of such, all alike: that is only to be timed."""
    rule = Quadrature.FLOW if case.gathers else Quadrature.TRAPEZOID
    fractions = jnp.linspace(0.0, 1.0, len(case.states))
    grid = (fractions[:-1], jnp.diff(fractions))

    def discretized(states, controls, time, steps):
        flow = Flow(case.problem, Discretization(quadrature=rule), steps)
        values, jacobians = linearize(flow, grid, states, controls, time)
        if not case.gathers:
            return [(values.next_state, jacobians.next_state)]
        return [
            (values.next_state, jacobians.next_state),
            (values.increments, jacobians.increments),
        ]

    def arranged(found):
        if case.gathers and case.mission["data_required"] is not None:
            found[1] = jax.tree.map(of_required, found[1])
        blocks = [(j.left_state, j.left_control, j.time[:, :, None]) for _, j in found]
        rows = [np.concatenate(block, axis=2) for block in blocks]
        values = np.concatenate([value for value, _ in found], axis=1)
        return values, np.concatenate(rows, axis=1)

    def of_required(block):
        # The others count the data in shares of those required.
        return block.at[:, 0].divide(case.mission["data_required"])

    if batch is None:
        return _compiled(
            discretized, case, arranged, jnp.asarray(substeps), options=compiler_options()
        )

    together = jax.vmap(discretized, in_axes=(0, None, None, None))
    many = case._replace(states=np.tile(case.states, (batch, 1, 1)))
    return _compiled(together, many, arranged, jnp.asarray(substeps))


def with_diffrax(case: Case, substeps: int) -> Prepared:
    """Tsit5 with fixed steps, `jacfwd` through them, intervals by `vmap`."""

    def interval(y, u, time):
        width = time / case.intervals
        term = diffrax.ODETerm(lambda t, y, u: jnp.stack(case.rates(jnp, y, u)))
        found = diffrax.diffeqsolve(
            term,
            diffrax.Tsit5(),
            0.0,
            width,
            width / substeps,
            y,
            u,
            adjoint=diffrax.ForwardMode(),
            max_steps=substeps + 2,
        )
        return found.ys[0]

    def discretized(states, controls, time):
        y = jnp.pad(states[:-1], ((0, 0), (0, case.size - 12)))

        def columns(y, u):
            def ends(v):
                own = jnp.concatenate([v[:12], y[12:]])
                return interval(own, v[12:-1], v[-1])

            v = jnp.concatenate([y[:12], u, time[None]])
            return ends(v), jax.jacfwd(ends)(v)

        return jax.vmap(columns)(y, controls[:-1])

    return _compiled(discretized, case, lambda found: tuple(map(np.asarray, found)))


def _compiled(function, case: Case, arranged, *others, options=None) -> Prepared:
    arguments = (
        jnp.asarray(case.states),
        jnp.asarray(case.controls),
        jnp.asarray(case.final_time),
        *others,
    )
    begun = time.perf_counter()
    program = jax.jit(function, compiler_options=options).lower(*arguments).compile()
    return Prepared(lambda: program(*arguments), arranged, time.perf_counter() - begun)
