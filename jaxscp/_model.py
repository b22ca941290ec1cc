"""The quadratic model of the discrete problem around a point."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp

from ._compiler import traced_once
from ._curvature import Curvature, convex_part
from ._lagrangian import curved_entries, lagrangian_hessian, nodal_curvature
from ._per_constraint import PerConstraint
from ._scaling import Scaling
from ._transcription import Derivatives, Residuals, Transcription, Variables, held
from ._types import Array


class Model(eqx.Module):
    """Linear constraints and a quadratic cost around a point, all scaled."""

    residuals: Residuals
    derivatives: Derivatives
    curvature: Curvature

    def linear(self, step: Variables) -> Residuals:
        """The constraints after a scaled step; the objective as it was."""
        return linear_prediction(self.residuals, self.derivatives, step)

    def predict(self, step: Variables) -> Residuals:
        """Residuals the model expects after a scaled step."""
        after = self.linear(step)
        slope = cost_gradient(self.derivatives)
        change = jnp.vdot(slope.states, step.states)
        change += jnp.vdot(slope.controls, step.controls)
        change += slope.final_time * step.final_time
        controls = held(step.controls, step.states.shape[0])
        z = jnp.concatenate([step.states, controls], axis=1)
        change += self.curvature.along(z, step.final_time)
        return dataclasses.replace(after, objective=self.residuals.objective + change)


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


@traced_once
def linear_prediction(
    residuals: Residuals, derivatives: Derivatives, step: Variables
) -> Residuals:
    """Constraints to first order; the objective as it was."""
    jacobians, nodes = derivatives.intervals, derivatives.nodes
    controls = held(step.controls, step.states.shape[0])
    moved = (step.states, controls, step.final_time)
    path = jnp.einsum("kpn,kn->kp", nodes.path_state, step.states)
    path += jnp.einsum("kpm,km->kp", nodes.path_control, controls)
    path += nodes.path_time * step.final_time
    flow = jacobians.next_state.apply(*moved)
    return Residuals(
        objective=residuals.objective,
        defects=residuals.defects + step.states[1:] - flow,
        path=residuals.path + path,
        between=residuals.between + jacobians.between.apply(*moved),
        increments=residuals.increments + jacobians.increments.apply(*moved),
    )


def nodewise_curvature(
    transcription: Transcription,
    scaling: Scaling,
    point: Variables,
    multipliers: PerConstraint,
) -> Curvature:
    """The Lagrangian's scaled curvature without the dynamics', convex at each node.

    **Arguments:**

    - `multipliers`: scaled; those of the dynamics do not count.
    """
    physical = scaling.physical(multipliers)
    scaled = scaling.curvature(nodal_curvature(transcription, point, physical))
    convex = convex_part(scaled.blocks, curved_entries(transcription))
    return dataclasses.replace(scaled, blocks=convex)


@traced_once
def exact_curvature(
    transcription: Transcription,
    scaling: Scaling,
    point: Variables,
    substeps: Array | int,
    multipliers: PerConstraint,
) -> Curvature:
    """All of the Lagrangian's scaled curvature, convex or not."""
    physical = scaling.physical(multipliers)
    return scaling.curvature(lagrangian_hessian(transcription, point, substeps, physical))


def model_curvatures(
    transcription: Transcription,
    scaling: Scaling,
    point: Variables,
    substeps: Array,
    multipliers: PerConstraint,
    sound: Array,
    kind: str,
) -> tuple[Curvature, Curvature]:
    """A convex curvature, and one with all of the Lagrangian's where that is sound.

    **Arguments:**

    - `sound`: whether the multipliers are good for the dynamics' curvature.
    - `kind`: "all", "nodes" (without the dynamics') or "cost".
    """
    at = (transcription, scaling, point)
    share = 0.0 if kind == "cost" else 1.0
    weighed = jax.tree.map(lambda leaf: share * leaf, multipliers)
    convex = nodewise_curvature(*at, weighed)
    if kind != "all":
        return convex, convex

    def with_dynamics():
        settings, steps = transcription.discretization, substeps
        # Half the steps tell the curvature well enough to converge fast, but would
        # have peaks elsewhere.
        if not settings.between:
            steps = jnp.maximum((steps + 1) // 2, settings.least_substeps)
        return exact_curvature(*at, steps, multipliers)

    return convex, jax.lax.cond(sound, with_dynamics, lambda: convex)
