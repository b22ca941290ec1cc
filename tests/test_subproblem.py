"""Convex models and subproblems against dense references assembled another way."""

import dataclasses
import functools
import itertools
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import piqp
import pytest
from hypothesis import given, strategies as st
from jax.flatten_util import ravel_pytree
from numpy.testing import assert_allclose
from scipy.linalg import block_diag
from scipy.optimize import minimize

from jaxscp import Bounds, FirstOrderHold, OptimalControlProblem, ZeroOrderHold
from jaxscp._assembly import Limits, Prices, SubproblemData, subproblem_solver
from jaxscp._discretization import Discretization, Quadrature
from jaxscp._layout import Layout, Structure
from jaxscp._model import (
    Model,
    PerConstraint,
    convex_model,
    largest_buffer,
    penalized_cost,
    violations,
    worst_violation,
)
from jaxscp._problem import Integral
from jaxscp._qp import PIQP
from jaxscp._scaling import Scaling, automatic_scaling
from jaxscp._subproblem import SubproblemSolution, solve_subproblem, step_limits
from jaxscp._transcription import Residuals, Transcription, Variables

INF = np.inf
NODES, INTERVALS = 6, 5
FRACTIONS = np.array([0.0, 0.15, 0.35, 0.5, 0.8, 1.0])
# Between them they have every block of the Jacobians.
DISCRETIZATIONS = {
    "zero-order": Discretization(ZeroOrderHold()),
    "first-order": Discretization(FirstOrderHold()),
    "trapezoid": Discretization(ZeroOrderHold(), Quadrature.TRAPEZOID),
    "first-order-trapezoid": Discretization(FirstOrderHold(), Quadrature.TRAPEZOID),
}
every_discretization = pytest.mark.parametrize("name", DISCRETIZATIONS)


class Scaled(eqx.Module):
    """A function of the states in other units, times a factor an entry."""

    function: object = eqx.field(static=True)
    units: jax.Array
    factor: jax.Array

    def __call__(self, t, x, u):
        return self.factor * self.function(t, x / self.units, u)


def pushed(t, x, u):
    """A point in a plane, in a wind that is a control nobody may choose."""
    return jnp.stack([x[2], x[3], u[0], u[1] + u[2]])


def acceleration_squared(t, x, u):
    return u[0] ** 2 + u[1] ** 2


def around_the_disc(t, x, u):
    return 0.34 - (x[0] - 2.0) ** 2 - (x[1] - 0.2) ** 2


def in_the_arena(t, x, u):
    return 0.1 * (x[0] ** 2 + x[1] ** 2) - 4.0 + 0.01 * t * u[0]


def signal(t, x, u):
    return 1.0 / (1.0 + (x[0] - 1.0) ** 2 + (x[1] - 2.0) ** 2)


def drift(t, x, u):
    return x[1]


def twice_the_time(t, x):
    return 2.0 * t


def problem_of(longest=8.0, unit=(1.0,) * 4, cost=1.0, wide=1.0) -> OptimalControlProblem:
    """From rest past a disc, with as much signal and drift as asked for.

    - `longest`: flight time allowed [s]. `unit`: what a state's numbers are times.
    - `cost`: what the running cost is times. `wide`: what the limits are times.
    """
    unit = jnp.asarray(unit)

    def bounds(lower, upper):
        return Bounds(unit * jnp.array(lower), unit * jnp.array(upper))

    def function(of_state, factor=jnp.ones(())):
        return Scaled(of_state, unit, factor)

    limit, wind = wide * jnp.array([0.35, 0.8, 0.0]), jnp.array([0.0, 0.0, 0.2])
    return OptimalControlProblem(
        function(pushed, unit),
        state=bounds([-9.0, -9.0, -INF, -2.0], [9.0, 9.0, INF, 2.0]),
        control=Bounds(wind - limit, wind + limit, fixed=(False, False, True)),
        initial_state=bounds([0.0, 0.0, 0.0, -1.0], [0.0, 0.0, 0.0, 1.0]),
        final_state=bounds([4.0, 0.2, -INF, -INF], [4.0, 0.45, INF, INF]),
        final_time=Bounds(2.0, longest),
        running_cost=function(acceleration_squared, jnp.asarray(cost)),
        terminal_cost=twice_the_time if cost == 1.0 else lambda t, x: 2.0 * cost * t,
        path_constraints={
            "arena": function(in_the_arena),
            "disc": function(around_the_disc),
        },
        integrals={
            "drift": Integral(function(drift), Bounds.exactly(2.8)),
            "signal": Integral(function(signal), Bounds.at_least(1.2)),
        },
    )


def transcribed(problem, name="zero-order") -> Transcription:
    return Transcription(problem, DISCRETIZATIONS[name], jnp.asarray(FRACTIONS))


def flown(transcription, unit=(1.0,) * 4) -> Variables:
    """A curved line within the limits, so that no derivative vanishes by chance."""
    s = FRACTIONS
    states = np.stack([4 * s, 0.4 * s + 0.3 * np.sin(3 * s), 1 + s, 0.5 - s], axis=1)
    states[0, :3], states[-1, 1] = 0.0, 0.4
    controls = np.stack([0.3 - 0.2 * s, 0.2 * np.cos(s), 0.2 + 0 * s], axis=1)
    return Variables(
        jnp.asarray(states * unit),
        jnp.asarray(controls[: transcription.control_nodes]),
        jnp.asarray(4.0),
    )


class Parts(NamedTuple):
    scaling: Scaling
    model: Model
    limits: Limits


@eqx.filter_jit
def prepare(transcription, variables, multipliers) -> Parts:
    """The convex model around a point."""
    residuals, derivatives = transcription.linearize(variables, jnp.asarray(4))
    scaling = automatic_scaling(transcription, variables)
    model = convex_model(
        transcription,
        scaling,
        variables,
        scaling.residuals(residuals),
        scaling.derivatives(derivatives),
        multipliers,
    )
    return Parts(scaling, model, step_limits(transcription, scaling, variables))


def multipliers_of(arena=0.3, disc=0.3, drift=-0.2, signal=-0.2) -> PerConstraint:
    return PerConstraint(
        jnp.zeros((INTERVALS, 4)),
        jnp.asarray(np.tile([arena, disc], (NODES, 1))),
        jnp.asarray([drift, signal]),
    )


@functools.cache
def parts_of(name="zero-order", **changes) -> Parts:
    transcription = transcribed(problem_of(**changes), name)
    return prepare(transcription, flown(transcription), multipliers_of())


@functools.cache
def structure_of(name="zero-order", **options) -> Structure:
    return Structure.of(transcribed(problem_of(), name), **options)


def prices_of(proximal=2.0, virtual=1e3, path=1e3, integral=1e3, radius=0.0) -> Prices:
    return Prices(
        proximal=jnp.asarray(proximal),
        virtual_control=jnp.asarray(np.full((INTERVALS, 4), virtual)),
        path=jnp.asarray(np.full((NODES, 2), path)),
        integral=jnp.asarray(np.full(2, integral)),
        radius=jnp.asarray(radius),
    )


solve = eqx.filter_jit(solve_subproblem)
predict = eqx.filter_jit(Model.predict)


class Dense(NamedTuple):
    """The model as matrices over the flattened step, states first and time last."""

    H: np.ndarray
    g: np.ndarray
    defects: tuple[np.ndarray, np.ndarray]
    path: tuple[np.ndarray, np.ndarray]
    totals: tuple[np.ndarray, np.ndarray]
    lower: np.ndarray
    upper: np.ndarray


@eqx.filter_jit
def _expanded(model, nothing):
    flat, unravel = ravel_pytree(nothing)

    def values(s):
        expected = model.predict(unravel(s))
        return (
            expected.objective,
            expected.defects.ravel(),
            expected.path.ravel(),
            expected.totals,
        )

    slopes = jax.jacfwd(values)(flat)
    hessian = jax.hessian(lambda s: values(s)[0])(flat)
    return values(flat), slopes, hessian


def dense(parts: Parts) -> Dense:
    states, controls = parts.limits.state[0], parts.limits.control[0]
    nothing = Variables(jnp.zeros_like(states), jnp.zeros_like(controls), jnp.zeros(()))
    values, slopes, hessian = jax.tree.map(np.asarray, _expanded(parts.model, nothing))
    pairs = [(slopes[i], values[i]) for i in (1, 2, 3)]
    limits = parts.limits
    lower, upper = (
        np.concatenate([np.ravel(limits.state[i]), np.ravel(limits.control[i])])
        for i in (0, 1)
    )
    return Dense(
        hessian,
        slopes[0],
        *pairs,
        np.append(lower, limits.time[0]),
        np.append(upper, limits.time[1]),
    )


def flat(variables) -> np.ndarray:
    """Of a step, or of a solution's multipliers of the same shapes."""
    if isinstance(variables, SubproblemSolution):
        parts = (variables.state, variables.control, variables.final_time)
    else:
        parts = (variables.states, variables.controls, variables.final_time)
    return np.concatenate([np.ravel(part) for part in parts])


def proximal_term(parts: Parts, weight: float) -> np.ndarray:
    """A squared step averages over the nodes, at each of which the time counts."""
    nodal = dense(parts).g.size - 1
    return np.append(np.full(nodal, weight / NODES), weight)


def projected(parts: Parts, weight: float) -> np.ndarray:
    """The optimal step by SLSQP, if no virtual variable is needed.

    In coordinates where the cost is half a squared distance, the first of its steps is
    nearly the last.
    """
    told = dense(parts)
    factor = np.linalg.cholesky(told.H + np.diag(proximal_term(parts, weight)))
    back = np.linalg.inv(factor).T
    fixed = told.lower == told.upper
    drift_row, signal_row = told.totals[0]
    low = np.isfinite(told.lower) & ~fixed
    high = np.isfinite(told.upper) & ~fixed
    eye = np.eye(told.g.size)
    equal = np.concatenate([told.defects[0], eye[fixed], [drift_row]])
    equal_to = np.concatenate(
        [
            -told.defects[1],
            told.lower[fixed],
            [parts.limits.integral[0][0] - told.totals[1][0]],
        ]
    )
    above = np.concatenate([-told.path[0], eye[low], -eye[high], [signal_row]])
    above_this = np.concatenate(
        [
            told.path[1],
            told.lower[low],
            -told.upper[high],
            [parts.limits.integral[0][1] - told.totals[1][1]],
        ]
    )

    def constraint(kind, rows, level):
        rows = rows @ back
        return {"type": kind, "fun": lambda q: rows @ q - level, "jac": lambda q: rows}

    found = minimize(
        lambda q: 0.5 * q @ q + told.g @ back @ q,
        np.zeros(told.g.size),
        jac=lambda q: q + back.T @ told.g,
        method="SLSQP",
        constraints=[
            constraint("eq", equal, equal_to),
            constraint("ineq", above, above_this),
        ],
        options={"ftol": 1e-14, "maxiter": 100},
    )
    assert found.success, found.message
    return back @ found.x


def relaxed_optimum(parts: Parts, prices: Prices, ball: bool = False) -> np.ndarray:
    """The optimal step of the QP with every virtual variable, as a dense one.

    A sum of infinity norms is within a radius if every sum of one signed entry from
    each of them is.
    """
    told, limits = dense(parts), parts.limits.integral
    size, rows, path = told.g.size, INTERVALS * 4, NODES * 2
    # Step, both signs of the virtual control, buffers of the path and of the integrals.
    P = block_diag(
        told.H + np.diag(proximal_term(parts, float(prices.proximal))),
        np.zeros((2 * rows + path + 2, 2 * rows + path + 2)),
    )
    virtual, buffer = np.ravel(prices.virtual_control), np.ravel(prices.path)
    # Only the fixed drift may miss its target on both sides: as one more defect.
    c = np.concatenate([told.g, virtual, virtual, buffer, prices.integral[:1], [0.0]])
    c[-1], missing = prices.integral[1], np.zeros((rows, path + 2))
    del missing
    raise NotImplementedError
