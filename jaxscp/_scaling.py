"""Scales of variables, constraints and cost.

Every quantity is divided by its typical size, so that one trust region and one
tolerance fit all of them. Metres and radians do not meet again until the solution.
"""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp

from ._bounds import Bounds
from ._curvature import Curvature
from ._intervals import IntervalJacobians, Jacobian
from ._lagrangian import nodal_curvature
from ._peaks import PEAK_TOLERANCE
from ._per_constraint import PerConstraint
from ._transcription import (
    Derivatives,
    NodeDerivatives,
    Residuals,
    Transcription,
    Variables,
)
from ._types import Array, Float, Scalar

# A slope this small beside how a constraint bends is none, as that of a squared norm
# whose argument is next to zero.
_FLAT = 1e-3
# Values this small beside a scale tell a better one, unless they are smaller still: those
# are rounding errors.
_SMALL, _NOTHING = 1e-2, 1e-8


class Scaling(eqx.Module):
    """Typical size of each quantity, in its own unit."""

    state: Float[Array, " n"]
    control: Float[Array, " m"]
    time: Scalar
    integral: Float[Array, " q"]
    path: Float[Array, " p"]
    between: Float[Array, " b"]
    objective: Scalar

    def move(self, variables: Variables, step: Variables) -> Variables:
        """Variables after a scaled step."""
        return Variables(
            variables.states + self.state[None] * step.states,
            variables.controls + self.control[None] * step.controls,
            variables.final_time + self.time * step.final_time,
        )

    def residuals(self, residuals: Residuals) -> Residuals:
        rates = jnp.append(self.integral, self.objective)
        return Residuals(
            objective=residuals.objective / self.objective,
            defects=residuals.defects / self.state[None],
            path=residuals.path / self.path[None],
            between=residuals.between / self.between[None] - PEAK_TOLERANCE,
            increments=residuals.increments / rates[None],
        )

    def derivatives(self, derivatives: Derivatives) -> Derivatives:
        rates = jnp.append(self.integral, self.objective)
        intervals = derivatives.intervals
        return Derivatives(
            IntervalJacobians(
                self._jacobian(intervals.next_state, self.state),
                self._jacobian(intervals.increments, rates),
                self._jacobian(intervals.between, self.between),
            ),
            self.node_derivatives(derivatives.nodes),
        )

    def node_derivatives(self, nodes: NodeDerivatives) -> NodeDerivatives:
        path = self.path[None, :, None]
        return NodeDerivatives(
            path_state=nodes.path_state * self.state[None, None] / path,
            path_control=nodes.path_control * self.control[None, None] / path,
            path_time=nodes.path_time * self.time / self.path[None],
            terminal_state=nodes.terminal_state * self.state / self.objective,
            terminal_time=nodes.terminal_time * self.time / self.objective,
        )

    def curvature(self, curvature: Curvature) -> Curvature:
        """The cost's second derivatives, all scaled."""
        sizes = jnp.concatenate([self.state, self.control])
        scaled = curvature.scaled(sizes, self.time)
        return jax.tree.map(lambda block: block / self.objective, scaled)

    def physical(self, multipliers: PerConstraint) -> PerConstraint:
        """Multipliers in units of the objective per unit of their constraint."""
        return PerConstraint(
            dynamics=multipliers.dynamics * self.objective / self.state[None],
            path=multipliers.path * self.objective / self.path[None],
            between=multipliers.between * self.objective / self.between[None],
            integral=multipliers.integral * self.objective / self.integral,
        )

    def _jacobian(self, jacobian: Jacobian, rows: Float[Array, " r"]) -> Jacobian:
        def scaled(block, columns):
            if block is None:
                return None
            return block * columns[None, None] / rows[None, :, None]

        return Jacobian(
            left_state=scaled(jacobian.left_state, self.state),
            left_control=scaled(jacobian.left_control, self.control),
            time=jacobian.time * self.time / rows[None],
            right_state=scaled(jacobian.right_state, self.state),
            right_control=scaled(jacobian.right_control, self.control),
        )


def automatic_scaling(
    transcription: Transcription, guess: Variables, again: bool | Array = False
) -> Scaling:
    """Scales from ranges: of the limits, else of the boundary values and the guess.

    **Arguments:**

    - `again`: whether the guess is what a solve has led to. Where its variables are
        smaller than their scales it tells these, limits and users notwithstanding.
    """
    problem = transcription.problem
    ends = jnp.stack([problem.initial_state.target, problem.final_state.target])
    near = jnp.concatenate([guess.states, ends])
    *totals, cost = transcription.rough_totals(guess)
    integral = [
        _scale(integral.bounds, total[None], absolute=True)
        for integral, total in zip(problem.integrals.values(), totals, strict=True)
    ]
    watch, parts = transcription.watch, transcription.discretization.between
    sizes = Scaling(
        state=_unless_small(_scale(problem.state, near), guess.states, again),
        control=_unless_small(
            _scale(problem.control, guess.controls), guess.controls, again
        ),
        time=_first_positive(_given(problem.final_time), jnp.abs(guess.final_time)),
        integral=jnp.array(integral).reshape(len(totals)),
        path=jnp.ones(watch.path),
        between=jnp.ones(parts * watch.size),
        objective=jnp.ones(()),
    )
    nodes = sizes.node_derivatives(transcription.linearize_nodes(guess))
    slopes = jnp.sum(jnp.abs(nodes.path_state), axis=2)
    slopes += jnp.sum(jnp.abs(nodes.path_control), axis=2) + jnp.abs(nodes.path_time)
    path = _first_positive(
        _unless_flat(jnp.max(slopes, axis=0), _path_bends(transcription, sizes, guess))
    )
    objective = _objective_scale(transcription, sizes, guess, cost, nodes)
    watched = jnp.concatenate([sizes.state[watch.entries], path])
    return dataclasses.replace(
        sizes, path=path, between=jnp.tile(watched, parts), objective=objective
    )


def _path_bends(
    transcription: Transcription, sizes: Scaling, guess: Variables
) -> Float[Array, " p"]:
    """How far each path constraint bends away from its tangent over the ranges of the
    variables, one after the other.

    By differences: the second derivative of a norm that is smoothed tells nothing of
    where it goes. Where a constraint is not defined so far out it counts as straight.
    """
    if not transcription.watch.path:
        return jnp.zeros(0)
    problem, n = transcription.problem, transcription.problem.state_size
    ranges = jnp.diag(jnp.concatenate([sizes.state, sizes.control]))

    def at_node(t, x, u):
        def path(z):
            return problem.path(t, z[:n], z[n:])

        here = jnp.concatenate([x, u])
        ahead = jax.vmap(path)(here[None] + ranges)
        behind = jax.vmap(path)(here[None] - ranges)
        bends = jnp.abs(0.5 * (ahead + behind) - path(here)[None])
        return jnp.sum(jnp.where(jnp.isfinite(bends), bends, 0.0), axis=0)

    times = guess.final_time * transcription.fractions
    controls = transcription.nodal_controls(guess)
    return jnp.max(jax.vmap(at_node)(times, guess.states, controls), axis=0)


def _unless_small(
    scales: Float[Array, " n"], values: Float[Array, "N n"], again: bool | Array
) -> Float[Array, " n"]:
    """Scales, or the largest values where these are smaller."""
    largest = jnp.max(jnp.abs(values), axis=0)
    small = (largest < scales) & (largest > _NOTHING * scales)
    return jnp.where(small & again, largest, scales)


def _unless_flat(slopes: Array, bends: Array) -> Array:
    """Slopes, but for those that all but vanish where the guess happens to lie."""
    return jnp.where(slopes > _FLAT * bends, slopes, bends)


def _scale(
    bounds: Bounds, values: Float[Array, "values *shape"], absolute: bool = False
) -> Float[Array, "*shape"]:
    given = _given(bounds)
    limits = 0.5 * (bounds.upper - bounds.lower)
    if absolute:
        largest = jnp.maximum(_finite(bounds.lower), _finite(bounds.upper))
        limits = jnp.maximum(limits, largest)
    seen = jnp.where(jnp.isfinite(values), values, jnp.nan)
    extent = 0.5 * (jnp.nanmax(seen, axis=0) - jnp.nanmin(seen, axis=0))
    # Limits so far out only say that there are none.
    remote = (extent < _SMALL * limits) & (extent > _NOTHING * limits)
    limits = jnp.where(remote, extent / _SMALL, limits)
    if absolute:
        limits = jnp.where(jnp.isfinite(limits), limits, largest)
    return _first_positive(given, limits, extent, jnp.nanmax(jnp.abs(seen), axis=0))


def _given(bounds: Bounds) -> Array:
    """The scale the bounds state; NaN where it is to be found."""
    return jnp.full(bounds.shape, jnp.nan) if bounds.scale is None else bounds.scale


def _finite(values: Array) -> Array:
    return jnp.where(jnp.isfinite(values), jnp.abs(values), 0.0)


def _first_positive(*candidates: Array) -> Array:
    """The first usable candidate, entry by entry; 1 if there is none."""
    scale = jnp.ones_like(candidates[-1])
    for candidate in reversed(candidates):
        usable = jnp.isfinite(candidate) & (candidate > 0)
        scale = jnp.where(usable, candidate, scale)
    return scale


def _objective_scale(
    transcription: Transcription,
    sizes: Scaling,
    guess: Variables,
    cost: Scalar,
    nodes: NodeDerivatives,
) -> Scalar:
    """Size of the cost over the scaled variables' ranges.

    The guess alone may cost nothing (no control), so the cost's slope and curvature over
    one range count too. All of them are homogeneous in the cost: a cost in other units
    leaves the scaled problem as it was.
    """
    none = transcription.no_multipliers
    curved = sizes.curvature(nodal_curvature(transcription, guess, none))
    traces = jnp.trace(curved.blocks, axis1=1, axis2=2)
    by_state, by_control = jax.vmap(
        jax.grad(transcription.problem.running_cost, argnums=(1, 2))
    )(
        guess.final_time * transcription.fractions,
        guess.states,
        transcription.nodal_controls(guess),
    )
    slopes = jnp.abs(by_state) @ sizes.state + jnp.abs(by_control) @ sizes.control
    seen = jnp.stack(
        [
            jnp.abs(cost),
            0.5 * jnp.sum(jnp.abs(traces)),
            guess.final_time * jnp.mean(slopes),
            jnp.max(jnp.abs(nodes.terminal_state), initial=0.0),
            jnp.abs(nodes.terminal_time),
        ]
    )
    return _first_positive(jnp.max(seen))
