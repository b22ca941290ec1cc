"""Models and scales of random numbers, with the blocks of each discretization."""

import jax
import jax.numpy as jnp
import numpy as np
from past_a_disc import DISCRETIZATIONS, INTERVALS, LIMITS, NODES, PATH, quick_jit

from jaxscp._curvature import Curvature
from jaxscp._discretization import Quadrature
from jaxscp._intervals import IntervalJacobians, Jacobian
from jaxscp._layout import Layout, Structure
from jaxscp._model import Model
from jaxscp._scaling import Scaling
from jaxscp._subproblem_data import Limits
from jaxscp._transcription import (
    Derivatives,
    NodeDerivatives,
    Residuals,
    Transcription,
)

# Of the same sizes as the example of `past_a_disc`: x, u, and integrals.
N, M, Q = 4, 3, 2


def random_model(name: str, seed: int, convexity: float = 12.0) -> Model:
    """**Arguments:** `convexity`: added to the curvature's diagonal, block by block."""
    settings, draw = DISCRETIZATIONS[name], np.random.default_rng(seed).normal
    trapezoid = settings.quadrature is Quadrature.TRAPEZOID
    both, peaks = settings.holds_right, settings.between * (LIMITS + PATH)

    def normal(*shape):
        return jnp.asarray(draw(size=shape))

    def jacobian(rows, right_state, right_control):
        return Jacobian(
            left_state=normal(INTERVALS, rows, N),
            left_control=normal(INTERVALS, rows, M),
            time=normal(INTERVALS, rows),
            right_state=normal(INTERVALS, rows, N) if right_state else None,
            right_control=normal(INTERVALS, rows, M) if right_control else None,
        )

    def curved(count, size):
        half = draw(size=(count, size, size))
        return jnp.asarray(half + half.mT + convexity * np.eye(size))

    residuals = Residuals(
        normal(),
        normal(INTERVALS, N),
        normal(NODES, PATH),
        normal(INTERVALS, peaks) - 3.0,  # limits without buffers can be met
        normal(INTERVALS, Q + 1),
    )
    intervals = IntervalJacobians(
        jacobian(N, False, both),
        jacobian(Q + 1, trapezoid, both or trapezoid),
        jacobian(peaks, False, both),
    )
    nodes = NodeDerivatives(
        normal(NODES, PATH, N),
        normal(NODES, PATH, M),
        normal(NODES, PATH),
        normal(N),
        normal(),
    )
    curvature = quick_jit(Curvature.assembled)(
        curved(NODES, N + M + 1),
        curved(INTERVALS, N + M * (1 + both) + 1),
        N,
        borrows=settings.control_nodes(NODES) < NODES,
    )
    return Model(residuals, Derivatives(intervals, nodes), curvature)


def random_scaling(transcription: Transcription) -> Scaling:
    parts, watch = transcription.discretization.between, transcription.watch
    draw = np.random.default_rng(0)
    sizes = {
        "state": N,
        "control": M,
        "time": (),
        "integral": Q,
        "path": watch.path,
        "between": parts * watch.size,
        "objective": (),
    }
    draws = {name: draw.uniform(0.5, 2.0, size) for name, size in sizes.items()}
    return Scaling(**jax.tree.map(jnp.asarray, draws))


def random_limits(structure: Structure, seed: int, wide: float = 5.0) -> Limits:
    """About as wide as told, but for what is fixed."""
    draw, layout = np.random.default_rng(seed), Layout(structure)

    def between(fixed):
        lower = -wide * draw.uniform(0.5, 1.5, fixed.shape)
        upper = wide * draw.uniform(0.5, 1.5, fixed.shape)
        target = draw.normal(size=fixed.shape)
        ends = (np.where(fixed, target, lower), np.where(fixed, target, upper))
        return tuple(map(jnp.asarray, ends))

    masks = (layout.fixed_states, layout.fixed_controls, layout.fixed_time)
    fixed = layout.fixed_integrals
    lower, upper = between(fixed)
    # As in the example, there is no upper limit but of what is fixed.
    return Limits(*map(between, masks), (lower, jnp.where(fixed, upper, jnp.inf)))
