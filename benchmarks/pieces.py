"""The pieces of one iteration of the default method, each as a program of its own.

They take a discrete problem and a state, as the whole iteration does.
"""

import jax
import jax.numpy as jnp

import jaxscp
from jaxscp._compiler import compiled
from jaxscp._iteration import linearized, try_step
from jaxscp._layout import Structure
from jaxscp._model import Model, model_curvatures
from jaxscp._optimality import optimality
from jaxscp._subproblem import step_limits
from jaxscp._subproblem_data import SubproblemData
from jaxscp._trust_region import metric

METHOD = jaxscp.ProximalSCP()


class _Counting(jaxscp.ProximalSCP):
    """Tells how many passes the search for a step took, too."""

    def _advance(self, transcription, state, found, judgement):
        return super()._advance(transcription, state, found, judgement), found.passes


@compiled
def first(transcription, variables):
    return METHOD.init(transcription, variables)


@compiled
def look(transcription, state):
    """The part of an iteration before its step: nothing is left to do at any residual."""
    return jaxscp.ProximalSCP(tolerance=jnp.inf).step(transcription, state)


@compiled
def move(transcription, state):
    """The part after it; whether it ends the solve, whether Newton's step was tried."""
    after, passes = _Counting()._iterate(transcription, state)
    done = METHOD.terminate(transcription, after)[0]
    return after, passes, METHOD.trusts_newton(state), done


@compiled
def dispatch(transcription, state):
    """What calling any program costs."""
    return state.radius + 0.0


@compiled
def linearization(transcription, state):
    return linearized(transcription, state.scaling, state.iterate)


@compiled
def conditions(transcription, state):
    return optimality(transcription, state.scaling, state.iterate, state.solution)


def _parts(transcription, state):
    sound, iterate = METHOD.is_sound(state), state.iterate
    at = (transcription, state.scaling, iterate.variables, iterate.substeps)
    multipliers = state.solution.multipliers
    curvatures = model_curvatures(*at, multipliers, sound, METHOD.curvature)
    return curvatures, metric(transcription, state, curvatures, sound)


curvature = compiled(_parts)


def _convex(transcription, state, parts):
    (convex, _), measure = parts
    model = Model(state.iterate.residuals, state.iterate.derivatives, convex)
    limits = step_limits(transcription, state.scaling, state.iterate.variables)
    return model, measure, limits


@compiled
def subproblem(transcription, state, parts):
    """A whole subproblem, with the call to the host."""
    return METHOD._by_qp(transcription, state, *_convex(transcription, state, parts))


@compiled
def data(transcription, state, parts) -> tuple[SubproblemData, jax.Array]:
    """What goes to the host, as blocks and as the vector it travels in."""
    model, measure, limits = _convex(transcription, state, parts)
    prices = METHOD._prices(Structure.of(transcription), state)
    damping = measure.times(1.0 / state.radius)
    blocks = SubproblemData.of(model, damping, prices, limits)
    leaves = jax.tree.leaves(blocks)
    return blocks, jnp.concatenate([jnp.ravel(leaf) for leaf in leaves])


@compiled
def trial(transcription, state):
    """The discrete problem where a step leads."""
    at = (state.scaling, state.iterate, state.solution, state.merit)
    return try_step(transcription, *at)
