"""An example with something of everything, and its models by dense matrices.

A point in a plane goes from rest past a disc.
"""

import dataclasses
import functools
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree

from jaxscp import Bounds, FirstOrderHold, OptimalControlProblem, ZeroOrderHold
from jaxscp._damping import Damping
from jaxscp._discretization import Discretization, Quadrature
from jaxscp._layout import Structure
from jaxscp._model import Model, cost_gradient, nodewise_curvature
from jaxscp._per_constraint import PerConstraint
from jaxscp._problem import Integral
from jaxscp._qp import PIQP
from jaxscp._scaling import Scaling, automatic_scaling
from jaxscp._subproblem import SubproblemSolution, solve_subproblem, step_limits
from jaxscp._subproblem_data import Limits, Outline, Prices, SubproblemData
from jaxscp._subproblem_solver import subproblem_solver
from jaxscp._transcription import Transcription, Variables

INF = np.inf
NODES, INTERVALS = 6, 5
FRACTIONS = np.array([0.0, 0.15, 0.35, 0.5, 0.8, 1.0])
SUBSTEPS = 4
# Limits of the state and path constraints that are watched between the nodes.
LIMITS, PATH = 6, 2
DISCRETIZATIONS = {
    "zero-order": Discretization(ZeroOrderHold()),
    "first-order": Discretization(FirstOrderHold()),
    "trapezoid": Discretization(ZeroOrderHold(), Quadrature.TRAPEZOID),
    "first-order-trapezoid": Discretization(FirstOrderHold(), Quadrature.TRAPEZOID),
    "zero-order-between": Discretization(ZeroOrderHold(), between=2),
    "first-order-between": Discretization(FirstOrderHold(), between=1),
}
every_discretization = pytest.mark.parametrize("name", DISCRETIZATIONS)


# What runs a few times takes longer to optimize than to run.
quick_jit = functools.partial(
    eqx.filter_jit, compiler_options={"xla_backend_optimization_level": 0}
)


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
    return 0.33 - (x[0] - 2.0) ** 2 - (x[1] - 0.2) ** 2


def in_the_arena(t, x, u):
    return 0.1 * (x[0] ** 2 + x[1] ** 2) - 4.0 + 0.01 * t * u[0]


def signal(t, x, u):
    return 1.0 / (1.0 + (x[0] - 1.0) ** 2 + (x[1] - 2.0) ** 2)


def drift(t, x, u):
    return x[1]


class TwiceTheTime(eqx.Module):
    factor: jax.Array

    def __call__(self, t, x):
        return self.factor * 2.0 * t


def problem_of(
    longest=8.0, drifted=2.8, unit=(1.0,) * 4, cost=1.0, wide=1.0, ceiling=9.0
) -> OptimalControlProblem:
    """From rest past a disc, with as much signal and drift as asked for.

    - `longest`: flight time allowed [s]. `drifted`: drift asked for [m s].
    - `unit`: what a state's numbers are times.
    - `cost`: what the cost is times. `wide`: what the limits are times.
    - `ceiling`: highest second coordinate [m].
    """
    unit = jnp.asarray(unit)

    def bounds(lower, upper):
        return Bounds(unit * jnp.array(lower), unit * jnp.array(upper))

    def function(of_state, factor=1.0):
        return Scaled(of_state, unit, jnp.asarray(factor))

    limit, wind = wide * jnp.array([0.33, 0.8, 0.0]), jnp.array([0.0, 0.0, 0.2])
    return OptimalControlProblem(
        function(pushed, unit),
        state=bounds([-9.0, -9.0, -INF, -2.0], [9.0, ceiling, INF, 2.0]),
        control=Bounds(wind - limit, wind + limit, fixed=(False, False, True)),
        initial_state=bounds([0.0, 0.0, 0.0, -1.0], [0.0, 0.0, 0.0, 1.0]),
        final_state=bounds([4.0, 0.2, -INF, -INF], [4.0, 0.45, INF, INF]),
        final_time=Bounds(2.0, longest),
        running_cost=function(acceleration_squared, jnp.asarray(cost)),
        terminal_cost=TwiceTheTime(jnp.asarray(cost)),
        path_constraints={
            "arena": function(in_the_arena),
            "disc": function(around_the_disc),
        },
        integrals={
            "drift": Integral(function(drift), Bounds.exactly(drifted)),
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
        jnp.asarray(4.0, float),
    )


class Parts(NamedTuple):
    scaling: Scaling
    model: Model
    limits: Limits


@quick_jit
def prepare(transcription, variables, multipliers) -> Parts:
    """The model around a point, convex at each node."""
    residuals, derivatives = transcription.linearize(variables, jnp.asarray(SUBSTEPS))
    scaling = automatic_scaling(transcription, variables)
    curvature = nodewise_curvature(transcription, scaling, variables, multipliers)
    scaled = (scaling.residuals(residuals), scaling.derivatives(derivatives))
    limits = step_limits(transcription, scaling, variables)
    return Parts(scaling, Model(*scaled, curvature), limits)


def multipliers_of(
    transcription, arena=0.3, disc=0.3, drift=-0.2, signal=-0.2
) -> PerConstraint:
    return dataclasses.replace(
        transcription.no_multipliers,
        path=jnp.asarray(np.tile([arena, disc], (NODES, 1))),
        integral=jnp.asarray([drift, signal]),
    )


@functools.cache
def parts_of(name="zero-order", **changes) -> Parts:
    transcription = transcribed(problem_of(**changes), name)
    return prepare(transcription, flown(transcription), multipliers_of(transcription))


@functools.cache
def structure_of(name="zero-order", **options) -> Structure:
    return Structure.of(transcribed(problem_of(), name), **options)


def prices_for(
    structure: Structure,
    virtual=1e3,
    path=1e3,
    limit=1e3,
    integral=1e3,
    radius=0.0,
    relax=1.0,
) -> Prices:
    """The same price for all of a kind."""
    intervals, watch = structure.nodes - 1, structure.watch

    def each(price, *shape):
        return jnp.asarray(np.full(shape, price))

    return Prices(
        virtual_control=each(virtual, intervals, structure.state_size),
        path=each(path, structure.nodes, watch.path),
        limit=each(limit, intervals, structure.limits),
        integral=each(integral, structure.integrals),
        radius=jnp.asarray(radius),
        precision=jnp.asarray(0.0),
        relax=jnp.asarray(relax),
    )


def prices_of(name="zero-order", **prices) -> Prices:
    return prices_for(structure_of(name), **prices)


def still(model: Model) -> Variables:
    """No step."""
    # The gradient has the step's shapes.
    shapes = jax.eval_shape(cost_gradient, model.derivatives)
    return jax.tree.map(lambda leaf: jnp.asarray(np.zeros(leaf.shape)), shapes)


def damping_of(model: Model, proximal=2.0) -> Damping:
    """The squared step, averaged over the nodes; the flight time is at each of them."""
    weight, nothing = jnp.asarray(proximal, float), still(model)
    step = jax.tree.map(lambda leaf: jnp.full_like(leaf, weight / NODES), nothing)
    step = dataclasses.replace(step, final_time=weight)
    return Damping.of(model.residuals, step)


def held_damping_of(model: Model, seed=0) -> Damping:
    """With weights, centres and targets of everything, each another number."""
    draw, blank = np.random.default_rng(seed), damping_of(model)
    weights = (blank.step, blank.path, blank.between, blank.integral)
    centres = drawn(draw.normal, (blank.centre, blank.target))
    roots = draw.normal(size=blank.measure.shape)
    # The last node may have no control of its own.
    roots[len(blank.step.controls) :, blank.step.states.shape[1] :] = 0.0
    measure = jnp.asarray(roots @ roots.swapaxes(1, 2))
    return Damping(*drawn(draw.exponential, weights), *centres, measure)


# Wrapped once for all tests: wrapped again they would be compiled again.
to_the_host = quick_jit(SubproblemData.of)
solve = quick_jit(solve_subproblem)
predict = quick_jit(Model.predict)


def solver_and_numbers(structure: Structure, settings: PIQP, data: SubproblemData):
    """The host's solver, and the vector it is given."""
    leaves = [np.ravel(leaf) for leaf in jax.tree.leaves(data)]
    solver = subproblem_solver(structure, settings, Outline.of(data))
    return solver, np.concatenate(leaves)


def drawn(draw, tree):
    """Random numbers in the place of a tree's."""
    return jax.tree.map(lambda leaf: jnp.asarray(draw(size=leaf.shape)), tree)


class Dense(NamedTuple):
    """The model over the flattened step, states first and time last.

    Each constraint is a pair: rows and what they add to, as `predict` has it.
    """

    H: np.ndarray
    g: np.ndarray
    defects: tuple[np.ndarray, np.ndarray]
    path: tuple[np.ndarray, np.ndarray]
    between: tuple[np.ndarray, np.ndarray]
    totals: tuple[np.ndarray, np.ndarray]


@quick_jit
def _predictions(model, nothing, steps):
    _, unravel = ravel_pytree(nothing)

    def values(s):
        after = model.predict(unravel(s))
        constraints = (after.defects, after.path, after.between, after.totals)
        return after.objective, *map(jnp.ravel, constraints)

    return jax.vmap(values)(steps)


def dense(model: Model) -> Dense:
    """From what the model predicts for steps along one and two axes."""
    nothing = still(model)
    size = ravel_pytree(nothing)[0].size
    axes = np.eye(size)
    pairs = (axes[:, None] + axes).reshape(-1, size)
    steps = np.concatenate([np.zeros((1, size)), axes, pairs])
    costs, *constraints = jax.tree.map(
        np.asarray, _predictions(model, nothing, jnp.asarray(steps))
    )
    single, double = costs[1 : size + 1] - costs[0], costs[size + 1 :] - costs[0]
    H = double.reshape(size, size) - single[:, None] - single
    rows = [((after[1 : size + 1] - after[0]).T, after[0]) for after in constraints]
    return Dense(H, single - 0.5 * np.diag(H), *rows)


def damped(told: Dense, damping: Damping) -> Dense:
    """The model with what its step is damped by, from the squares written out."""
    weights, centre = flat(damping.step), flat(damping.centre)
    squares = np.diag(weights)
    nodes, n = damping.step.states.shape
    free, m = damping.step.controls.shape
    for node, block in enumerate(np.asarray(damping.measure)):
        own = np.arange(node * n, (node + 1) * n)
        if node < free:
            first = nodes * n + node * m
            own = np.append(own, np.arange(first, first + m))
        squares[np.ix_(own, own)] += block[: own.size, : own.size]
    H, g = told.H + squares, told.g - squares @ centre
    for (rows, known), weight, target in (
        (told.path, damping.path, 0.0),
        (told.between, damping.between, 0.0),
        (told.totals, damping.integral, damping.target),
    ):
        weight = np.ravel(weight)
        H = H + rows.T @ (weight[:, None] * rows)
        g = g + rows.T @ (weight * (known - target))
    return told._replace(H=H, g=g)


def ends_of(limits: Limits) -> tuple[np.ndarray, np.ndarray]:
    """Lower and upper limits of the flattened step."""
    kinds = (limits.state, limits.control, limits.time)
    lower, upper = (
        np.concatenate([np.ravel(kind[side]) for kind in kinds]) for side in (0, 1)
    )
    return lower, upper


def flat(step: Variables) -> np.ndarray:
    parts = (step.states, step.controls, step.final_time)
    return np.concatenate([np.ravel(part) for part in parts])


def of_limits(solution: SubproblemSolution) -> np.ndarray:
    """Multipliers of the flattened step's limits."""
    return flat(Variables(solution.state, solution.control, solution.final_time))


def all_equal(left, right, **tolerance):
    for one, other in zip(jax.tree.leaves(left), jax.tree.leaves(right), strict=True):
        np.testing.assert_allclose(one, other, **tolerance)
