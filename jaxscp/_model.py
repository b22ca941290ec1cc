"""The convex model of the discrete problem around a point, and the exact penalty."""

import equinox as eqx
import jax.numpy as jnp

from ._scaling import Scaling
from ._transcription import Derivatives, Residuals, Transcription, Variables, held
from ._types import Array, Float, Scalar


class PerConstraint(eqx.Module):
    """One number for each entry of each constraint: multipliers, weights, violations.

    Multipliers belong to the Lagrangian J + sum(multiplier x constraint), with the
    constraints defects = 0, g <= 0, and integral minus its active bound.
    """

    dynamics: Float[Array, "I n"]
    path: Float[Array, "N p"]
    integral: Float[Array, " q"]


class Model(eqx.Module):
    """Linear constraints and a convex quadratic cost around a point, all scaled.

    `hessian` holds one block by (x, u) a node.
    """

    residuals: Residuals
    derivatives: Derivatives
    hessian: Float[Array, "N w w"]

    @property
    def gradient(self) -> Variables:
        """Gradient of the cost."""
        derivatives = self.derivatives
        cost = derivatives.intervals.increments
        free = cost.left_control.shape[0] + (cost.right_control is not None)
        states = jnp.zeros((self.hessian.shape[0], cost.left_state.shape[2]))
        controls = jnp.zeros((free, cost.left_control.shape[2]))
        states = states.at[:-1].add(cost.left_state[:, -1])
        controls = controls.at[: cost.left_control.shape[0]].add(cost.left_control[:, -1])
        if cost.right_state is not None:
            states = states.at[1:].add(cost.right_state[:, -1])
        if cost.right_control is not None:
            controls = controls.at[1:].add(cost.right_control[:, -1])
        states = states.at[-1].add(derivatives.nodes.terminal_state)
        time = jnp.sum(cost.time[:, -1]) + derivatives.nodes.terminal_time
        return Variables(states, controls, time)

    def predict(self, step: Variables) -> Residuals:
        """Residuals the model expects after a scaled step."""
        jacobians = self.derivatives.intervals
        controls = held(step.controls, self.hessian.shape[0])
        flow = _apply(jacobians.next_state, step.states, controls, step.final_time)
        growth = _apply(jacobians.increments, step.states, controls, step.final_time)
        slope = self.gradient
        path = jnp.einsum("kpn,kn->kp", self.derivatives.nodes.path_state, step.states)
        path += jnp.einsum("kpm,km->kp", self.derivatives.nodes.path_control, controls)
        path += self.derivatives.nodes.path_time * step.final_time
        z = jnp.concatenate([step.states, controls], axis=1)
        linear = jnp.vdot(slope.states, step.states)
        linear += jnp.vdot(slope.controls, step.controls)
        linear += slope.final_time * step.final_time
        curved = 0.5 * jnp.einsum("ki,kij,kj->", z, self.hessian, z)
        return Residuals(
            objective=self.residuals.objective + linear + curved,
            defects=self.residuals.defects + step.states[1:] - flow,
            path=self.residuals.path + path,
            increments=self.residuals.increments + growth,
        )


def convex_model(
    transcription: Transcription,
    scaling: Scaling,
    point: Variables,
    residuals: Residuals,
    derivatives: Derivatives,
    multipliers: PerConstraint,
) -> Model:
    """Linear constraints, and the Lagrangian's curvature without the dynamics'.

    The Hessian is made convex node by node. That of the dynamics costs a hundred times
    as much and did not help when made convex in this way.

    **Arguments:**

    - `residuals`, `derivatives`: scaled, at `point`.
    - `multipliers`: scaled; those of the dynamics do not count.
    """
    rates = multipliers.integral * scaling.objective / scaling.integral
    blocks = transcription.curvature(
        point,
        jnp.append(rates, 1.0),
        multipliers.path * scaling.objective / scaling.path[None],
    )
    values, vectors = jnp.linalg.eigh(scaling.curvature(blocks) / scaling.objective)
    kept = jnp.maximum(values, 0.0)
    hessian = jnp.einsum("kij,kj,klj->kil", vectors, kept, vectors)
    return Model(residuals, derivatives, hessian)


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
        integral=jnp.maximum(jnp.maximum(limits[0] - totals, totals - limits[1]), 0.0),
    )


def largest_buffer(broken: PerConstraint) -> Scalar:
    """Largest violation of a path or integral constraint."""
    path = jnp.max(broken.path, initial=0.0)
    return jnp.maximum(path, jnp.max(broken.integral, initial=0.0))


def worst_violation(residuals: Residuals, limits: tuple[Array, Array]) -> Scalar:
    """Largest violation of any constraint."""
    broken = violations(residuals, limits)
    return jnp.maximum(jnp.max(broken.dynamics), largest_buffer(broken))


def penalized_cost(
    residuals: Residuals, limits: tuple[Array, Array], weights: PerConstraint
) -> Scalar:
    """Cost plus the weighted L1 norm of all violations: the exact penalty."""
    broken = violations(residuals, limits)
    return (
        residuals.objective
        + jnp.vdot(weights.dynamics, broken.dynamics)
        + jnp.vdot(weights.path, broken.path)
        + jnp.vdot(weights.integral, broken.integral)
    )


def _apply(jacobian, states, controls, time):
    """Change of each interval's quantities by a change of the variables."""
    change = jnp.einsum("krn,kn->kr", jacobian.left_state, states[:-1])
    change += jnp.einsum("krm,km->kr", jacobian.left_control, controls[:-1])
    change += jacobian.time * time
    if jacobian.right_state is not None:
        change += jnp.einsum("krn,kn->kr", jacobian.right_state, states[1:])
    if jacobian.right_control is not None:
        change += jnp.einsum("krm,km->kr", jacobian.right_control, controls[1:])
    return change
