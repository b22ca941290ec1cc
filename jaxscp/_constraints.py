"""How far constraints are from being met."""

import jax.numpy as jnp

from ._max_norm import max_norm
from ._per_constraint import PerConstraint
from ._scaling import Scaling
from ._transcription import Residuals, Transcription
from ._types import Array, Float, Scalar


def integral_limits(
    transcription: Transcription, scaling: Scaling
) -> tuple[Float[Array, " q"], Float[Array, " q"]]:
    """Scaled lower and upper limits of the integrals."""
    bounds = [i.bounds for i in transcription.problem.integrals.values()]
    lower = jnp.array([bound.lower for bound in bounds]).reshape(len(bounds))
    upper = jnp.array([bound.upper for bound in bounds]).reshape(len(bounds))
    return lower / scaling.integral, upper / scaling.integral


def violations(residuals: Residuals, limits: tuple[Array, Array]) -> PerConstraint:
    """How far each scaled constraint is from being met, never negative."""
    totals = residuals.totals
    return PerConstraint(
        dynamics=jnp.abs(residuals.defects),
        path=jnp.maximum(residuals.path, 0.0),
        between=jnp.maximum(residuals.between, 0.0),
        integral=jnp.maximum(jnp.maximum(limits[0] - totals, totals - limits[1]), 0.0),
    )


def largest_buffer(broken: PerConstraint) -> Scalar:
    """Largest violation of a path or integral constraint, at nodes or between."""
    return max_norm((broken.path, broken.between, broken.integral))


def worst_violation(residuals: Residuals, limits: tuple[Array, Array]) -> Scalar:
    """Largest violation of any constraint."""
    return max_norm(violations(residuals, limits))
