"""The exact Hessian, what makes it convex, and the conditions it serves."""

import itertools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

import jaxscp
from jaxscp import Bounds, OptimalControlProblem
from jaxscp._curvature import Curvature, convex_part
from jaxscp._discretization import Discretization, Quadrature
from jaxscp._hold import FirstOrderHold, ZeroOrderHold
from jaxscp._lagrangian import lagrangian_hessian
from jaxscp._layout import Structure
from jaxscp._optimality import optimality
from jaxscp._per_constraint import PerConstraint
from jaxscp._problem import Integral
from jaxscp._scaling import automatic_scaling
from jaxscp._state import Iterate
from jaxscp._subproblem import SubproblemSolution
from jaxscp._transcription import Transcription, Variables

FRACTIONS = jnp.array([0.0, 0.2, 0.45, 0.7, 1.0])
NODES, SUBSTEPS = 5, 4


def swing(t, x, u):
    """A pendulum with a wind that changes with time."""
    return jnp.stack([x[1], u[0] * jnp.cos(x[0]) - jnp.sin(x[0]) - 0.1 * t * x[1] ** 2])


def problem() -> OptimalControlProblem:
    return OptimalControlProblem(
        swing,
        state=Bounds([-4.0, -9.0], [4.0, 9.0]),
        control=Bounds([-3.0], [3.0]),
        initial_state=Bounds.exactly([0.0, 0.0]),
        final_state=Bounds.exactly([2.0, 0.0]),
        final_time=Bounds(1.0, 4.0),
        running_cost=lambda t, x, u: u[0] ** 2 + 0.1 * x[0] ** 2 * u[0] * t,
        terminal_cost=lambda t, x: t * x[0] ** 2 + t**2,
        path_constraints={"speed": lambda t, x, u: x[1] ** 2 * t + x[0] * u[0] - 9.0},
        integrals={"way": Integral(lambda t, x, u: x[1] ** 2 * u[0], Bounds(-9.0, 9.0))},
    )


def transcribed(hold, quadrature, between) -> Transcription:
    discretization = Discretization(hold, quadrature, between)
    return Transcription(problem(), discretization, FRACTIONS)


def drawn(transcription) -> tuple[Variables, PerConstraint]:
    """A random point, and random multipliers."""
    draw, free = np.random.default_rng(0).normal, transcription.control_nodes
    states, controls = draw(size=(NODES, 2)), draw(size=(free, 1))
    variables = Variables(jnp.asarray(states), jnp.asarray(controls), jnp.array(2.3))
    multipliers = jax.tree.map(
        lambda leaf: jnp.asarray(draw(size=leaf.shape)), transcription.no_multipliers
    )
    return variables, multipliers


def flat(variables: Variables) -> jax.Array:
    """Node by node, then the flight time; where there is no control, zero."""
    missing = variables.states.shape[0] - variables.controls.shape[0]
    controls = jnp.pad(variables.controls, ((0, missing), (0, 0)))
    nodes = jnp.concatenate([variables.states, controls], axis=1)
    return jnp.append(nodes.ravel(), variables.final_time)


def unflat(transcription, vector) -> Variables:
    nodes, free = vector[:-1].reshape(NODES, 3), transcription.control_nodes
    return Variables(nodes[:, :2], nodes[:free, 2:], vector[-1])


def whole(curvature: Curvature) -> np.ndarray:
    """All of a Hessian in the order of `flat`, from the meaning of each block."""
    nodes, w, _ = curvature.blocks.shape
    last = nodes * w
    matrix = np.zeros((last + 1, last + 1))

    def place(rows, columns, block):
        matrix[rows, columns] += block
        matrix[columns, rows] += np.asarray(block).T

    for k in range(nodes):
        here = slice(k * w, (k + 1) * w)
        matrix[here, here] += curvature.blocks[k]
        place(here, slice(last, None), curvature.border[k][:, None])
        if curvature.ahead is not None and k + 1 < nodes:
            end = (k + 2) * w
            size = curvature.ahead.shape[2]
            place(here, slice(end - size, end), curvature.ahead[k])
    if curvature.tail is not None:
        m, n = curvature.tail.shape
        control, state = slice(last - w - m, last - w), slice(last - w, last - w + n)
        place(control, state, curvature.tail)
    matrix[-1, -1] = curvature.corner
    return matrix


@eqx.filter_jit
def exact(transcription, variables, multipliers) -> Curvature:
    return lagrangian_hessian(
        transcription, variables, jnp.asarray(SUBSTEPS), multipliers
    )


def lagrangian(transcription, multipliers, vector):
    found = transcription.evaluate(unflat(transcription, vector), jnp.asarray(SUBSTEPS))
    return (
        found.objective
        + jnp.vdot(multipliers.integral, found.totals)
        + jnp.vdot(multipliers.dynamics, found.defects)
        + jnp.vdot(multipliers.path, found.path)
        + jnp.vdot(multipliers.between, found.between)
    )


every_discretization = pytest.mark.parametrize(
    ("hold", "quadrature"),
    list(itertools.product([ZeroOrderHold(), FirstOrderHold()], Quadrature)),
    ids=lambda part: part.value if isinstance(part, Quadrature) else type(part).__name__,
)


@every_discretization
def test_the_hessian_is_that_of_the_lagrangian(hold, quadrature):
    """Against forward derivatives of the whole discrete problem, twice."""
    transcription = transcribed(hold, quadrature, between=0)
    variables, multipliers = drawn(transcription)
    twice = jax.jacfwd(jax.jacfwd(lagrangian, argnums=2), argnums=2)
    expected = eqx.filter_jit(twice)(transcription, multipliers, flat(variables))
    found = whole(exact(transcription, variables, multipliers))
    assert_allclose(found, expected, rtol=1e-9, atol=1e-9)
    assert (quadrature is Quadrature.FLOW) == bool(np.any(found[:2, 2]))


def double_integrator() -> OptimalControlProblem:
    return OptimalControlProblem(
        lambda t, x, u: jnp.stack([x[1], u[0]]),
        state=Bounds([-9.0, -9.0], [9.0, 9.0]),
        control=Bounds([-9.0], [9.0]),
        initial_state=Bounds.exactly([0.0, 0.0]),
        final_state=Bounds.exactly([3.0, 0.0]),
        final_time=Bounds.exactly(2.0),
        running_cost=lambda t, x, u: u[0] ** 2,
    )


def test_a_polished_solution_meets_the_conditions():
    solution = jaxscp.solve(double_integrator(), nodes=11)
    assert bool(solution.polished)
    assert bool(solution.converged)
    assert float(solution.optimality) <= 1e-6
    assert "optimality conditions" in solution.message
    # The control that minimizes energy is linear in time: its differences are equal.
    change = np.diff(np.asarray(solution.trajectory.controls[:-1, 0]))
    assert_allclose(change, change[0], atol=1e-5)


def test_conditions_see_what_is_wrong():
    """Each residual, by hand, of the problem whose step is all there is to it."""
    transcription = Transcription(
        double_integrator(), Discretization(), jnp.linspace(0.0, 1.0, 3)
    )
    states = jnp.asarray([[0.0, 0.0], [1.5, 1.5], [3.0, 0.0]])
    variables = Variables(states, jnp.asarray([[3.0], [-3.0]]), jnp.asarray(2.0))
    scaling = automatic_scaling(transcription, variables)
    residuals, derivatives = transcription.linearize(variables, jnp.asarray(2))
    iterate = Iterate(
        variables,
        scaling.residuals(residuals),
        scaling.derivatives(derivatives),
        fresh=jnp.array(True),
        substeps=jnp.asarray(2),
        integration_error=jnp.zeros(()),
    )
    nothing = SubproblemSolution.none(Structure.of(transcription))
    gap = optimality(transcription, scaling, iterate, nothing)
    # With u = 3 the first interval ends at (1.5, 3), not at (1.5, 1.5).
    expected = 1.5 / float(scaling.state[1])
    assert float(gap.feasibility) == pytest.approx(expected)
    # No multiplier opposes the cost: 2 u over one second, scaled.
    slope = 6.0 * float(scaling.control[0] / scaling.objective)
    by_time = 18.0 / 2.0 * float(scaling.time / scaling.objective)
    assert float(gap.stationarity) == pytest.approx(max(slope, by_time))
    assert float(gap.complementarity) == 0.0
    pushed = eqx.tree_at(lambda s: s.control, nothing, jnp.asarray([[0.0], [-2.0]]))
    gap = optimality(transcription, scaling, iterate, pushed)
    # A lower limit's multiplier, 6 from its limit.
    assert float(gap.complementarity) == pytest.approx(
        2.0 * 6.0 / float(scaling.control[0])
    )


@pytest.mark.parametrize(
    "discretization",
    [Discretization(FirstOrderHold()), Discretization(quadrature=Quadrature.TRAPEZOID)],
    ids=["first-order", "trapezoid"],
)
def test_other_discretizations_have_no_exact_hessian(discretization):
    transcription = Transcription(problem(), discretization, FRACTIONS)
    assert not transcription.has_exact_hessian
    solution = jaxscp.solve(double_integrator(), nodes=11, discretization=discretization)
    assert bool(solution.converged)


def test_a_wrong_curvature_is_refused():
    with pytest.raises(ValueError, match="curvature='some': choose 'all', 'nodes' or"):
        jaxscp.ProximalSCP(curvature="some")
