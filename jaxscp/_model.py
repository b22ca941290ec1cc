"""The convex model of the discrete problem around a point, and the exact penalty."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp

from ._convexification import Curvature, convex_part, convexified
from ._lagrangian import lagrangian_hessian, nodal_curvature
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

    - `damping`: diagonal curvature in the cost that its prediction leaves out.
    - `holding`: weights of half the squared path constraints in the cost, which its
        prediction leaves out too.
    - `transfers`: by (x, flight time) at each interval's right end: what was taken from
        the curvature of one interval and given to the next, if anything.
    """

    residuals: Residuals
    derivatives: Derivatives
    curvature: Curvature
    damping: Variables
    holding: Float[Array, "N p"]
    transfers: Float[Array, "I s s"]

    @property
    def gradient(self) -> Variables:
        """Gradient of the cost."""
        slope = self._held(cost_gradient(self.derivatives))
        # Where defects are closed the transfers do not cancel to first order.
        flow = self.derivatives.intervals.next_state
        n = self.residuals.defects.shape[1]
        taken = jnp.einsum("kij,kj->ki", self.transfers[:, :, :n], self.residuals.defects)
        by_state = jnp.einsum("krn,kr->kn", flow.left_state, taken[:, :n])
        by_control = jnp.einsum("krm,kr->km", flow.left_control, taken[:, :n])
        return Variables(
            slope.states.at[:-1].add(-by_state),
            # Only held controls know transfers.
            slope.controls.at[: by_control.shape[0]].add(-by_control),
            slope.final_time - jnp.vdot(flow.time, taken[:, :n]) - jnp.sum(taken[:, n]),
        )

    def _held(self, slope: Variables) -> Variables:
        nodes, free = self.derivatives.nodes, slope.controls.shape[0]
        push = self.holding * self.residuals.path
        by_control = jnp.einsum("kpm,kp->km", nodes.path_control, push)
        return Variables(
            slope.states + jnp.einsum("kpn,kp->kn", nodes.path_state, push),
            slope.controls + by_control[:free],
            slope.final_time + jnp.vdot(nodes.path_time, push),
        )

    def predict(self, step: Variables) -> Residuals:
        """Residuals the model expects after a scaled step."""
        controls = held(step.controls, step.states.shape[0])
        after = linear_prediction(self.residuals, self.derivatives, step, controls)
        slope = self.gradient
        z = jnp.concatenate([step.states, controls], axis=1)
        change = jnp.vdot(slope.states, step.states)
        change += jnp.vdot(slope.controls, step.controls)
        change += slope.final_time * step.final_time
        change += self.curvature.along(z, step.final_time)
        squared = jax.tree.map(lambda d, s: jnp.sum(d * s**2), self.damping, step)
        change -= 0.5 * (squared.states + squared.controls + squared.final_time)
        squares = after.path**2 - self.residuals.path**2
        change -= 0.5 * jnp.vdot(self.holding, squares)
        defects, n = self.residuals.defects, self.residuals.defects.shape[1]
        change += 0.5 * jnp.einsum(
            "ki,kij,kj->", defects, self.transfers[:, :n, :n], defects
        )
        return dataclasses.replace(after, objective=self.residuals.objective + change)

    def costates(
        self, multipliers: Float[Array, "I n"], step: Variables
    ) -> Float[Array, "I n"]:
        """Multipliers of the dynamics, from those of the QP with its transfers."""
        n = multipliers.shape[1]
        given = jnp.einsum("kij,kj->ki", self.transfers[:, :n, :n], step.states[1:])
        return multipliers - given - self.transfers[:, :n, n] * step.final_time


def cost_gradient(derivatives: Derivatives) -> Variables:
    """Gradient of the cost alone."""
    cost, nodes = derivatives.intervals.increments, derivatives.nodes
    intervals, _, n = cost.left_state.shape
    free = intervals + (cost.right_control is not None)
    states = jnp.zeros((intervals + 1, n)).at[:-1].add(cost.left_state[:, -1])
    controls = jnp.zeros((free, cost.left_control.shape[2]))
    controls = controls.at[:intervals].add(cost.left_control[:, -1])
    if cost.right_state is not None:
        states = states.at[1:].add(cost.right_state[:, -1])
    if cost.right_control is not None:
        controls = controls.at[1:].add(cost.right_control[:, -1])
    states = states.at[-1].add(nodes.terminal_state)
    return Variables(states, controls, jnp.sum(cost.time[:, -1]) + nodes.terminal_time)


def linear_prediction(
    residuals: Residuals,
    derivatives: Derivatives,
    step: Variables,
    controls: Float[Array, "N m"],
) -> Residuals:
    """Constraints to first order; the objective as it was."""
    jacobians, nodes = derivatives.intervals, derivatives.nodes
    flow = _apply(jacobians.next_state, step.states, controls, step.final_time)
    growth = _apply(jacobians.increments, step.states, controls, step.final_time)
    path = jnp.einsum("kpn,kn->kp", nodes.path_state, step.states)
    path += jnp.einsum("kpm,km->kp", nodes.path_control, controls)
    path += nodes.path_time * step.final_time
    return Residuals(
        objective=residuals.objective,
        defects=residuals.defects + step.states[1:] - flow,
        path=residuals.path + path,
        increments=residuals.increments + growth,
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

    The Hessian is made convex node by node. That of the dynamics would not survive it.

    **Arguments:**

    - `residuals`, `derivatives`: scaled, at `point`.
    - `multipliers`: scaled; those of the dynamics do not count.
    """
    weights = physical_multipliers(scaling, multipliers)
    rates = jnp.append(weights.integral, 1.0)
    blocks = nodal_curvature(transcription, point, rates, weights.path)
    hessian = convex_part(scaling.curvature(blocks))
    flat = Curvature(hessian, jnp.zeros(hessian.shape[:2]), jnp.zeros(()))
    size, intervals = point.states.shape[1] + 1, point.states.shape[0] - 1
    return Model(
        residuals,
        derivatives,
        flat,
        damping=jax.tree.map(jnp.zeros_like, point),
        holding=jnp.zeros_like(residuals.path),
        transfers=jnp.zeros((intervals, size, size)),
    )


def second_order_model(
    transcription: Transcription,
    scaling: Scaling,
    point: Variables,
    substeps: Array,
    residuals: Residuals,
    derivatives: Derivatives,
    multipliers: PerConstraint,
    damping: Variables,
    holding: Float[Array, "N p"],
) -> Model:
    """Linear constraints, and all of the Lagrangian's curvature, made convex.

    **Arguments:**

    - `damping`: of the scaled step. `holding`: of the path constraints. Both are part
        of the curvature.
    """
    weights = physical_multipliers(scaling, multipliers)
    rates = jnp.append(weights.integral, 1.0)
    exact = lagrangian_hessian(
        transcription, point, substeps, weights.dynamics, rates, weights.path
    )
    nodes, at_nodes = exact.shape[0], derivatives.nodes
    slopes = jnp.concatenate(
        [at_nodes.path_state, at_nodes.path_control, at_nodes.path_time[:, :, None]],
        axis=2,
    )
    held_back = jnp.einsum("kp,kpi,kpj->kij", holding, slopes, slopes)
    each = jnp.concatenate(
        [
            damping.states,
            jnp.pad(damping.controls, ((0, nodes - damping.controls.shape[0]), (0, 0))),
            jnp.full((nodes, 1), damping.final_time / nodes),
        ],
        axis=1,
    )
    curvature, transfers = convexified(
        scaling.curvature(exact) + jax.vmap(jnp.diag)(each) + held_back,
        derivatives.intervals.next_state,
        transcription.fixed_states,
        damping.final_time / nodes,
    )
    return Model(residuals, derivatives, curvature, damping, holding, transfers)


def physical_multipliers(scaling: Scaling, scaled: PerConstraint) -> PerConstraint:
    """In units of the objective: a scaled one is objective scale per constraint scale."""
    return PerConstraint(
        dynamics=scaled.dynamics * scaling.objective / scaling.state[None],
        path=scaled.path * scaling.objective / scaling.path[None],
        integral=scaled.integral * scaling.objective / scaling.integral,
    )


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
