"""`Damping`: what keeps a subproblem's step short, and on the active constraints."""

import equinox as eqx
import jax
import jax.numpy as jnp

from ._curvature import Curvature
from ._model import Model
from ._transcription import Residuals, Variables
from ._types import Array, Float


class Damping(eqx.Module):
    """Half squares that a subproblem minimizes beside the model's cost, weighted.

    - `step`: weights of the scaled step, counted from `centre`: the soft trust region.
        `measure`: the same by blocks of each node's (x, u), zero where it has no u.
    - `path`, `between`, `integral`: of the linearized constraints, the integrals counted
        from `target`. The Lagrangian need only be convex along the active constraints:
        holding the step to them costs nothing once it is right which ones are active.
    """

    step: Variables
    path: Float[Array, "N p"]
    between: Float[Array, "I b"]
    integral: Float[Array, " q"]
    centre: Variables
    target: Float[Array, " q"]
    measure: Float[Array, "N w w"]

    @classmethod
    def of(cls, residuals: Residuals, step: Variables) -> "Damping":
        """Of the step alone, counted from no step."""
        none = jnp.zeros_like(residuals.totals)
        nodes, n = step.states.shape
        size = n + step.controls.shape[1]
        return cls(
            step,
            path=jnp.zeros_like(residuals.path),
            between=jnp.zeros_like(residuals.between),
            integral=none,
            centre=jax.tree.map(jnp.zeros_like, step),
            target=none,
            measure=jnp.zeros((nodes, size, size)),
        )

    def times(self, factor: Array) -> "Damping":
        """With every weight multiplied."""
        parts = (self.step, self.path, self.between, self.integral, self.measure)
        scaled = jax.tree.map(lambda weight: factor * weight, parts)
        step, path, between, integral, measure = scaled
        return Damping(step, path, between, integral, self.centre, self.target, measure)

    def length(self, step: Variables) -> Array:
        """Of a step, in the norm of the trust region."""
        return jnp.sqrt(self._squared(step))

    def _squared(self, step: Variables) -> Array:
        way = jax.tree.map(jnp.subtract, step, self.centre)
        squares = jax.tree.map(lambda w, way: jnp.sum(w * way**2), self.step, way)
        z = jnp.concatenate([way.states, self._at_nodes(way.controls)], axis=1)
        blocks = jnp.einsum("ki,kij,kj->", z, self.measure, z)
        return squares.states + squares.controls + squares.final_time + blocks

    def value(self, model: Model, step: Variables) -> Array:
        """What a step costs, but for the integrals."""
        after = model.linear(step)
        # Peaks of what has no limit are infinitely low.
        peaks = jnp.where(self.between > 0.0, after.between, 0.0)
        return 0.5 * (
            self._squared(step)
            + jnp.sum(self.path * after.path**2)
            + jnp.sum(self.between * peaks**2)
        )

    def cost(self, model: Model, step: Variables) -> Array:
        """What a step costs."""
        totals = model.linear(step).totals
        squares = self.integral * (totals - self.target) ** 2
        return self.value(model, step) + 0.5 * jnp.sum(squares)

    @property
    def of_totals(self) -> tuple[Float[Array, " q"], Float[Array, " q"]]:
        """Second and, at zero, first derivatives by the integrals' totals."""
        return self.integral, -self.integral * self.target

    def curvature(self, model: Model) -> Curvature:
        """Second derivatives of `value`."""
        nodes, n = self.step.states.shape
        free, jacobian = self.step.controls.shape[0], model.derivatives.intervals.between
        controls = self._at_nodes(self.step.controls)
        weights = [self.step.states, controls, jnp.zeros((nodes, 1))]
        at = model.derivatives.nodes
        slopes = [at.path_state, at.path_control, at.path_time[:, :, None]]
        at_nodes = jax.vmap(jnp.diag)(jnp.concatenate(weights, axis=1))
        at_nodes = at_nodes.at[:, :-1, :-1].add(self.measure)
        at_nodes += _squares(slopes, self.path)
        rows = [jacobian.left_state, jacobian.left_control, jacobian.time[:, :, None]]
        if jacobian.right_control is not None:
            rows.insert(2, jacobian.right_control)
        peaks = _squares(rows, self.between)
        whole = Curvature.assembled(at_nodes, peaks, n, borrows=free < nodes)
        corner = whole.corner + self.step.final_time
        return eqx.tree_at(lambda c: c.corner, whole, corner)

    def _at_nodes(self, controls: Float[Array, "M m"]) -> Float[Array, "N m"]:
        """With zeros where a node has no control of its own."""
        missing = self.step.states.shape[0] - controls.shape[0]
        return jnp.pad(controls, ((0, missing), (0, 0)))


def _squares(rows: list[Array], weights: Float[Array, "K b"]) -> Float[Array, "K s s"]:
    whole = jnp.concatenate(rows, axis=2)
    return jnp.einsum("kb,kbi,kbj->kij", weights, whole, whole)
