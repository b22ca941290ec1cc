"""The default method with one of its parts exchanged, for `methods.py`."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp

import jaxscp
from jaxscp._layout import Structure
from jaxscp._merit import AbstractMerit
from jaxscp._per_constraint import PerConstraint
from jaxscp._subproblem import solve_subproblem


class HardBall(jaxscp.ProximalSCP):
    """With the paper's hard trust region: an infinity-norm ball at each node, of scaled
    variables, instead of a proximal term. Its radius follows the same ratios."""

    initial_weight: float = eqx.field(static=True, default=1.0)

    def _by_qp(self, transcription, state, model, measure, limits):
        structure = Structure.of(transcription, ball=True)
        prices = self._prices(structure, state)
        prices = dataclasses.replace(prices, radius=state.radius)
        damping = measure.times(0.0)
        return solve_subproblem(structure, self.qp, model, damping, prices, limits)


class AugmentedLagrangian(AbstractMerit):
    """Cost, multipliers times constraints, and squares of those: smooth, unlike the L1
    norm. Oguri, "Successive convexification with feasibility guarantee via augmented
    Lagrangian" (SCvx*), 2023, whose weight grows likewise."""

    multipliers: PerConstraint
    weight: jax.Array
    growth: float = eqx.field(static=True, default=2.0)
    most: float = eqx.field(static=True, default=1e8)

    def cost(self, residuals, limits):
        own, weight = self.multipliers, self.weight

        def charged(multiplier, value, low, high):
            # The least over what the constraint may be: between its limits nothing.
            pushed = value + multiplier / weight
            gap = pushed - jnp.clip(pushed, low, high)
            return jnp.sum(0.5 * weight * gap**2 - 0.5 * multiplier**2 / weight)

        none = -jnp.inf
        return (
            residuals.objective
            + charged(own.dynamics, residuals.defects, 0.0, 0.0)
            + charged(own.path, residuals.path, none, 0.0)
            + charged(own.between, residuals.between, none, 0.0)
            + charged(own.integral, residuals.totals, *limits)
        )

    def following(self, multipliers, ceiling):
        weight = jnp.minimum(self.growth * self.weight, self.most)
        return dataclasses.replace(self, multipliers=multipliers, weight=weight)


class SmoothMerit(jaxscp.ProximalSCP):
    """With the augmented Lagrangian of SCvx* as its merit function."""

    first_weight: float = eqx.field(static=True, default=10.0)

    def init(self, transcription, guess, again=False):
        state = super().init(transcription, guess, again)
        merit = AugmentedLagrangian(
            state.solution.multipliers, jnp.asarray(self.first_weight)
        )
        return dataclasses.replace(state, merit=merit)
