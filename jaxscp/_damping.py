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

    @classmethod
    def of(cls, residuals: Residuals, step: Variables) -> "Damping":
        """Of the step alone, counted from no step."""
        none = jnp.zeros_like(residuals.totals)
        return cls(
            step,
            path=jnp.zeros_like(residuals.path),
            between=jnp.zeros_like(residuals.between),
            integral=none,
            centre=jax.tree.map(jnp.zeros_like, step),
            target=none,
        )

    def value(self, model: Model, step: Variables) -> Array:
        """What a step costs, but for the integrals."""
        after = model.linear(step)
        squares = jax.tree.map(
            lambda weight, at, centre: jnp.sum(weight * (at - centre) ** 2),
            self.step,
            step,
            self.centre,
        )
        # Peaks of what has no limit are infinitely low.
        peaks = jnp.where(self.between > 0.0, after.between, 0.0)
        return 0.5 * (
            squares.states
            + squares.controls
            + squares.final_time
            + jnp.sum(self.path * after.path**2)
            + jnp.sum(self.between * peaks**2)
        )

    @property
    def of_totals(self) -> tuple[Float[Array, " q"], Float[Array, " q"]]:
        """Second and, at zero, first derivatives by the integrals' totals."""
        return self.integral, -self.integral * self.target

    def curvature(self, model: Model) -> Curvature:
        """Second derivatives of `value`."""
        nodes, n = self.step.states.shape
        free, jacobian = self.step.controls.shape[0], model.derivatives.intervals.between
        controls = jnp.pad(self.step.controls, ((0, nodes - free), (0, 0)))
        weights = [self.step.states, controls, jnp.zeros((nodes, 1))]
        at = model.derivatives.nodes
        slopes = [at.path_state, at.path_control, at.path_time[:, :, None]]
        at_nodes = jax.vmap(jnp.diag)(jnp.concatenate(weights, axis=1))
        at_nodes += _squares(slopes, self.path)
        rows = [jacobian.left_state, jacobian.left_control, jacobian.time[:, :, None]]
        if jacobian.right_control is not None:
            rows.insert(2, jacobian.right_control)
        peaks = _squares(rows, self.between)
        whole = Curvature.assembled(at_nodes, peaks, n, borrows=free < nodes)
        corner = whole.corner + self.step.final_time
        return eqx.tree_at(lambda c: c.corner, whole, corner)


def _squares(rows: list[Array], weights: Float[Array, "K b"]) -> Float[Array, "K s s"]:
    whole = jnp.concatenate(rows, axis=2)
    return jnp.einsum("kb,kbi,kbj->kij", weights, whole, whole)
