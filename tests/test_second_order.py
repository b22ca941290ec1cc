"""The exact Hessian, what makes it convex, and the conditions it serves."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

import jaxscp
from jaxscp import Bounds, OptimalControlProblem
from jaxscp._convexification import Curvature, convexified
from jaxscp._discretization import Discretization, Jacobian, Quadrature
from jaxscp._hold import FirstOrderHold
from jaxscp._lagrangian import lagrangian_hessian
from jaxscp._layout import Structure
from jaxscp._optimality import optimality
from jaxscp._problem import Integral
from jaxscp._scaling import automatic_scaling
from jaxscp._state import Iterate
from jaxscp._subproblem import SubproblemSolution
from jaxscp._transcription import Transcription, Variables

FRACTIONS = jnp.array([0.0, 0.2, 0.45, 0.7, 1.0])
INTERVALS, SUBSTEPS = 4, 3


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


@functools.cache
def point() -> tuple[Transcription, Variables]:
    draw = np.random.default_rng(0).normal
    transcription = Transcription(problem(), Discretization(), FRACTIONS)
    states, controls = draw(size=(5, 2)), draw(size=(4, 1))
    return transcription, Variables(
        jnp.asarray(states), jnp.asarray(controls), jnp.asarray(2.3)
    )


def test_the_hessian_is_that_of_the_lagrangian():
    """Against forward derivatives of the whole discrete problem, twice."""
    transcription, variables = point()
    draw = np.random.default_rng(1).normal
    costates, rates = draw(size=(INTERVALS, 2)), np.array([0.7, 1.3])
    path = draw(size=(5, 1))
    blocks = lagrangian_hessian(
        transcription,
        variables,
        jnp.asarray(SUBSTEPS),
        *map(jnp.asarray, (costates, rates, path)),
    )

    def lagrangian(flat):
        states, controls = flat[:10].reshape(5, 2), flat[10:14].reshape(4, 1)
        found = transcription.evaluate(
            Variables(states, controls, flat[-1]), jnp.asarray(SUBSTEPS)
        )
        cost = rates[1] * found.objective + rates[0] * found.totals[0]
        return cost + jnp.vdot(costates, found.defects) + jnp.vdot(path, found.path)

    flat = jnp.concatenate(
        [variables.states.ravel(), variables.controls.ravel(), variables.final_time[None]]
    )
    whole = np.asarray(jax.jit(jax.jacfwd(jax.jacfwd(lagrangian)))(flat))
    built = np.zeros((15, 15))
    for k in range(5):
        # The last node has no control of its own: its path constraint borrows one.
        places = [2 * k, 2 * k + 1, 10 + min(k, 3), 14]
        built[np.ix_(places, places)] += blocks[k]
    assert_allclose(built, whole, rtol=1e-9, atol=1e-9)


def flow_of(seed: int, n: int = 3, m: int = 2) -> Jacobian:
    draw = np.random.default_rng(seed).normal
    return Jacobian(
        left_state=jnp.asarray(np.eye(n) + 0.3 * draw(size=(INTERVALS, n, n))),
        left_control=jnp.asarray(draw(size=(INTERVALS, n, m))),
        time=jnp.asarray(draw(size=(INTERVALS, n))),
    )


def along_the_flow(flow, seed):
    """A random step that meets the linearized dynamics, as arrays."""
    n, m = flow.left_control.shape[1:]
    draw = np.random.default_rng(seed).normal
    time, states, controls = draw(), [np.zeros(n)], draw(size=(INTERVALS, m))
    for k in range(INTERVALS):
        ahead = flow.left_state[k] @ states[-1] + flow.left_control[k] @ controls[k]
        states.append(np.asarray(ahead + flow.time[k] * time))
    return np.array(states), controls, time


@pytest.mark.parametrize("seed", range(4))
def test_convexification_keeps_the_form_along_the_dynamics(seed):
    """What is taken from one interval and given to the next cancels."""
    n, m = 3, 2
    flow, draw = flow_of(seed), np.random.default_rng(seed + 50).normal
    hessian = draw(size=(INTERVALS + 1, n + m + 1, n + m + 1))
    hessian = hessian + np.swapaxes(hessian, 1, 2)  # indefinite
    hessian[:, n : n + m, n : n + m] += 900.0 * np.eye(m)  # but not along the controls
    hessian[:-1, -1, -1] += 400.0
    fixed = np.zeros((INTERVALS + 1, n), bool)
    fixed[0] = True
    curvature, _ = convexified(jnp.asarray(hessian), flow, fixed, jnp.asarray(1e-6))
    states, controls, time = along_the_flow(flow, seed + 100)
    padded = np.vstack([controls, np.zeros((1, m))])
    z = np.hstack([states, padded])
    whole = np.hstack([z, np.full((INTERVALS + 1, 1), time)])
    exact = 0.5 * np.einsum("ki,kij,kj->", whole, hessian, whole)
    assert float(curvature.along(jnp.asarray(z), jnp.asarray(time))) == pytest.approx(
        exact, rel=1e-9
    )
    assert np.linalg.eigvalsh(hessian).min() < -1.0


@pytest.mark.parametrize("shift", [0.0, 5.0])
def test_convexified_blocks_are_convex(shift):
    n, m = 3, 2
    flow, draw = flow_of(7), np.random.default_rng(8).normal
    hessian = draw(size=(INTERVALS + 1, n + m + 1, n + m + 1))
    hessian = hessian + np.swapaxes(hessian, 1, 2) + shift * np.eye(n + m + 1)
    fixed = np.zeros((INTERVALS + 1, n), bool)
    curvature, transfers = convexified(
        jnp.asarray(hessian), flow, fixed, jnp.asarray(1e-3)
    )
    assert np.isfinite(transfers).all()
    size = (INTERVALS + 1) * (n + m)
    whole = np.zeros((size + 1, size + 1))
    for k in range(INTERVALS + 1):
        here = slice(k * (n + m), (k + 1) * (n + m))
        whole[here, here] = curvature.blocks[k]
        whole[here, -1] = whole[-1, here] = curvature.border[k]
    whole[-1, -1] = curvature.corner
    assert np.linalg.eigvalsh(whole).min() > -1e-9 * np.abs(whole).max()


def test_half_the_quadratic_form():
    curvature = Curvature(
        jnp.asarray([[[2.0, 1.0], [1.0, 4.0]]]),
        jnp.asarray([[3.0, 0.0]]),
        jnp.asarray(5.0),
    )
    # Half of 2 + 2*2 + 16, then 2 * 3, then half of 5 * 4.
    z = jnp.asarray([[1.0, 2.0]])
    assert float(curvature.along(z, jnp.asarray(2.0))) == pytest.approx(11 + 6 + 10)


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
