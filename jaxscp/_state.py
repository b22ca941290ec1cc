"""The state an SCP method carries from one iteration to the next."""

import dataclasses
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp

from ._merit import AbstractMerit
from ._scaling import Scaling
from ._subproblem import SubproblemSolution
from ._transcription import Derivatives, Residuals, Variables
from ._types import Array, Float, Scalar


class Iterate(eqx.Module):
    """A point, with the scaled values and derivatives of all functions there.

    - `fresh`: whether the derivatives belong to the point, not to the one before.
    - `substeps`: Runge-Kutta steps an interval, as many as the tolerance asked for.
        `raised`: how often it asked for more than there had been.
    - `integration_error`: estimated local error with that many, relative to the scales.
    """

    variables: Variables
    residuals: Residuals
    derivatives: Derivatives
    fresh: Array
    substeps: Array
    raised: Array
    integration_error: Scalar


class History(eqx.Module):
    """One number for each subproblem solved, in order; NaN beyond the last.

    - `objective`: of the step tried, in its own unit.
    - `penalized_cost`: of the reference, scaled, as the merit then in force has it.
    - `predicted_reduction`, `actual_reduction`, `ratio`: of the penalized cost.
    - `radius`: of the trust region; the inverse weight where it is a proximal term.
    - `defect`: largest dynamics defect of the step tried, relative to the state scales.
    - `buffer`: largest violation of a path or integral constraint, relative likewise.
    - `accepted`: 1 if the step was taken.
    """

    objective: Float[Array, " records"]
    penalized_cost: Float[Array, " records"]
    predicted_reduction: Float[Array, " records"]
    actual_reduction: Float[Array, " records"]
    ratio: Float[Array, " records"]
    radius: Float[Array, " records"]
    defect: Float[Array, " records"]
    buffer: Float[Array, " records"]
    accepted: Float[Array, " records"]

    @classmethod
    def empty(cls, records: int) -> "History":
        """Room for so many records, none written yet."""
        return cls(*(jnp.full(records, jnp.nan) for _ in range(9)))

    def write(self, index: Array, **values: Array) -> "History":
        """The history with one more record."""
        return History(
            **{
                name: getattr(self, name).at[index].set(value)
                for name, value in values.items()
            }
        )


class Reach(eqx.Module):
    """How far Newton's steps may go.

    - `length`: the longest, infinite until there was one.
    - `weight`: of the proximal term, tried first; heavier ones where it is too light.
    """

    length: Scalar
    weight: Scalar


class SCPState(eqx.Module):
    """Everything an SCP method carries from one iteration to the next.

    - `merit`: which judges steps. `ceiling`: price of virtual variables.
    - `radius`: as in [`History`][]. `reach`: of Newton's steps.
    - `own`: whether the multipliers belong to the reference, not to a step refused.
    - `records`: entries in the history. `iterations`: those the method's limit counts,
        subproblems of a convex model. `polish`: steps of Newton's method.
    - `subproblems`, `qp_iterations`, `qp_seconds`: QPs solved, and what they took.
    - `stationary`: no step within the model improves the penalized cost.
    - `failures`: subproblems left unsolved in a row.
    - `optimality`: residual of the optimality conditions, infinite until it is known.
    - `near`: whether steps are taken without asking the penalized cost.
    - `finite`: whether the reference has finite values and derivatives.
    """

    iterate: Iterate
    scaling: Scaling
    solution: SubproblemSolution
    merit: AbstractMerit
    ceiling: Scalar
    radius: Scalar
    reach: Reach
    own: Array
    history: History
    records: Array
    iterations: Array
    polish: Array
    subproblems: Array
    qp_iterations: Array
    qp_seconds: Scalar
    stationary: Array
    failures: Array
    optimality: Scalar
    near: Array
    finite: Array

    @classmethod
    def blank(
        cls, init: Callable[[Variables], "SCPState"], guess: Variables
    ) -> "SCPState":
        """The room for one, with a guess and no records yet."""
        shapes = eqx.filter_eval_shape(init, guess)
        blank = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shapes)
        history = History.empty(blank.history.accepted.size)
        return eqx.tree_at(
            lambda state: (state.iterate.variables, state.history),
            blank,
            (guess, history),
        )

    def counted_on(self, before: "SCPState") -> "SCPState":
        """This one, with what had been counted and written down before."""
        return dataclasses.replace(
            self,
            history=before.history,
            records=before.records,
            iterations=before.iterations,
            polish=before.polish,
            subproblems=before.subproblems,
            qp_iterations=before.qp_iterations,
            qp_seconds=before.qp_seconds,
        )

    @property
    def last_accepted(self) -> Scalar:
        """Of the latest record: 1 if its step was taken, else 0; NaN before the first."""
        return self.history.accepted[self.records - 1]


class Trial(eqx.Module):
    """A step tried: where it leads, the scaled residuals and the penalized cost there.

    `integration_error` is that of the flow there, as in [`Iterate`][].
    """

    solution: SubproblemSolution
    variables: Variables
    residuals: Residuals
    cost: Scalar
    integration_error: Scalar


class Judgement(eqx.Module):
    """The ratio test of a step (paper, eq. 21): all of the penalized cost."""

    reference: Scalar
    predicted: Scalar
    actual: Scalar
    ratio: Scalar
    accepted: Array
