"""The exact Hessian, its blocks, and the conditions it serves."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from by_hand import motion
from numpy.testing import assert_allclose

import jaxscp
from jaxscp import Bounds, OptimalControlProblem
from jaxscp._curvature import Curvature, convex_part
from jaxscp._discretization import Discretization, Quadrature
from jaxscp._hold import FirstOrderHold, ZeroOrderHold
from jaxscp._lagrangian import lagrangian_hessian
from jaxscp._layout import Structure
from jaxscp._optimality import optimality
from jaxscp._peaks import PEAK_TOLERANCE
from jaxscp._per_constraint import PerConstraint
from jaxscp._problem import Integral
from jaxscp._scaling import Scaling, automatic_scaling
from jaxscp._state import Iterate
from jaxscp._subproblem import SubproblemSolution
from jaxscp._transcription import Transcription, Variables

FRACTIONS = jnp.array([0.0, 0.2, 0.45, 0.7, 1.0])
NODES, SUBSTEPS = 5, 6


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
    draw, free = np.random.default_rng(1).normal, transcription.control_nodes
    states, controls = draw(size=(NODES, 2)), draw(size=(NODES, 1))[:free]
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


SLOPE = jax.jacfwd(lagrangian, argnums=2)


@eqx.filter_jit
def slope_twice(transcription, multipliers, vector):
    return jax.jacfwd(SLOPE, argnums=2)(transcription, multipliers, vector)


@eqx.filter_jit
def slope_by_differences(transcription, multipliers, vector):
    """Central differences, a column for each variable."""

    def at(shift):
        return SLOPE(transcription, multipliers, vector + shift)

    shifts = 1e-5 * jnp.eye(vector.size)
    ahead, behind = jnp.split(jax.vmap(at)(jnp.concatenate([shifts, -shifts])), 2)
    return 0.5e5 * (ahead - behind)


DISCRETIZATIONS = {
    "zero-order-flow": (ZeroOrderHold(), Quadrature.FLOW),
    "zero-order-trapezoid": (ZeroOrderHold(), Quadrature.TRAPEZOID),
    "first-order-flow": (FirstOrderHold(), Quadrature.FLOW),
    "first-order-trapezoid": (FirstOrderHold(), Quadrature.TRAPEZOID),
}


def discretizations(*names):
    cases = [pytest.param(*DISCRETIZATIONS[name], id=name) for name in names]
    return pytest.mark.parametrize(("hold", "quadrature"), cases)


@discretizations(*DISCRETIZATIONS)
def test_the_hessian_is_that_of_the_lagrangian(hold, quadrature):
    """Against forward derivatives of the whole discrete problem, twice."""
    transcription = transcribed(hold, quadrature, between=0)
    variables, multipliers = drawn(transcription)
    expected = slope_twice(transcription, multipliers, flat(variables))
    found = whole(exact(transcription, variables, multipliers))
    assert_allclose(found, expected, rtol=1e-9, atol=1e-9)


# Two of them have every hold and every quadrature.
@discretizations("zero-order-flow", "first-order-trapezoid")
def test_the_hessian_moves_the_peaks_along(hold, quadrature):
    """Against differences of the slope, which holds the moment of each peak still.

    That is right, as nothing changes along it there, but its derivative must not. At
    this point four peaks are inside of their parts, of both states and of the speed.
    """
    transcription = transcribed(hold, quadrature, between=2)
    variables, multipliers = drawn(transcription)
    expected = slope_by_differences(transcription, multipliers, flat(variables))
    found = whole(exact(transcription, variables, multipliers))
    assert_allclose(found, expected, rtol=1e-7, atol=1e-7)


def test_the_hessian_of_a_throw():
    """Its height x + v^2 / 2a, thrown up at v under -a, where only that counts."""
    x, v, a = 0.3, 1.9, 1.1
    limits = Bounds([-np.inf, -np.inf], [1.0, np.inf])
    transcription = Transcription(
        motion(state=limits), Discretization(between=1), jnp.array([0.0, 1.0])
    )
    states, controls = jnp.array([[x, v], [0.0, 0.0]]), jnp.array([[-a]])
    pushed = eqx.tree_at(
        lambda m: m.between, transcription.no_multipliers, jnp.ones((1, 1))
    )
    found = exact(transcription, Variables(states, controls, jnp.array(4.0)), pushed)
    block = [[0, 0, 0], [0, 1 / a, v / a**2], [0, v / a**2, v**2 / a**3]]
    expected = np.zeros((7, 7))
    expected[:3, :3] = block
    assert_allclose(whole(found), expected, atol=1e-12)


def random_curvature(seed, *, two_sided=False, borrows=False) -> Curvature:
    """Of four nodes with three states and two controls."""
    draw = np.random.default_rng(seed).normal
    shape = jax.eval_shape(
        lambda: Curvature.of_nodes(
            jnp.zeros((4, 5, 5)), 3, two_sided=two_sided, borrows=borrows
        )
    )
    random = jax.tree.map(lambda leaf: jnp.asarray(draw(size=leaf.shape)), shape)
    return eqx.tree_at(lambda c: c.blocks, random, random.blocks + random.blocks.mT)


def test_sums_and_scales_of_curvature():
    sizes, time = np.array([2.0, 3.0, 0.5, 7.0, 1.1]), 0.3
    scales = np.append(np.tile(sizes, 4), time)
    plain = random_curvature(0)
    for others in ({"two_sided": True}, {"borrows": True}):
        other = random_curvature(1, **others)
        for total in (plain.plus(other), other.plus(plain)):
            assert_allclose(whole(total), whole(plain) + whole(other), rtol=1e-14)
        scaled = whole(other.scaled(jnp.asarray(sizes), jnp.array(time)))
        expected = whole(other) * np.outer(scales, scales)
        assert_allclose(scaled, expected, rtol=1e-14)
    twice = whole(other.plus(other))
    assert_allclose(twice, 2.0 * whole(other), rtol=1e-14)


@pytest.mark.parametrize("others", [{}, {"two_sided": True}, {"borrows": True}], ids=str)
def test_the_quadratic_form_is_that_of_the_whole(others):
    curvature = random_curvature(2, **others)
    draw = np.random.default_rng(3).normal
    z, time = draw(size=(4, 5)), draw()
    if "borrows" in others:
        # Nothing but the borrowed control stands for that of the last node.
        blocks = curvature.blocks.at[-1, 3:].set(0.0).at[-1, :, 3:].set(0.0)
        border = curvature.border.at[-1, 3:].set(0.0)
        curvature = eqx.tree_at(
            lambda c: (c.blocks, c.border), curvature, (blocks, border)
        )
        z[-1, 3:] = z[-2, 3:]
    v = np.append(z, time)
    expected = 0.5 * v @ whole(curvature) @ v
    assert_allclose(
        curvature.along(jnp.asarray(z), jnp.array(time)), expected, rtol=1e-12
    )


def test_half_the_quadratic_form():
    curvature = Curvature(
        jnp.asarray([[[2.0, 1.0], [1.0, 4.0]]]),
        jnp.asarray([[3.0, 0.0]]),
        jnp.asarray(5.0),
    )
    # Half of 2 + 2*2 + 16, then 2 * 3, then half of 5 * 4.
    z = jnp.asarray([[1.0, 2.0]])
    assert float(curvature.along(z, jnp.asarray(2.0))) == pytest.approx(11 + 6 + 10)


@pytest.mark.parametrize(
    "values", [[3.0, 1.0, 0.0], [3.0, -2.0, 0.5], [-1.0, -2.0, 0.0]], ids=str
)
def test_the_convex_part_has_the_eigenvalues_that_are_not_negative(values):
    turns, _ = np.linalg.qr(np.random.default_rng(5).normal(size=(2, 3, 3)))
    given, kept = (
        turns @ np.diag(diagonal) @ np.swapaxes(turns, 1, 2)
        for diagonal in (np.array(values), np.maximum(values, 0.0))
    )
    assert_allclose(convex_part(jnp.asarray(given), np.arange(3)), kept, atol=1e-14)
    # Among zeros, which are not looked at.
    entries = np.array([1, 2, 4])
    wide, expected = np.zeros((2, 2, 5, 5))
    wide[:, entries[:, None], entries] = given
    expected[:, entries[:, None], entries] = kept
    assert_allclose(convex_part(jnp.asarray(wide), entries), expected, atol=1e-14)
    nothing = convex_part(jnp.asarray(wide), np.array([], int))
    assert_allclose(nothing, np.zeros((2, 5, 5)))


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


@pytest.mark.parametrize(
    "discretization",
    # With a first-order hold: `test_closed_forms.py`.
    [Discretization(), Discretization(quadrature=Quadrature.TRAPEZOID)],
    ids=["zero-order", "trapezoid"],
)
def test_a_polished_solution_meets_the_conditions(discretization):
    solution = jaxscp.solve(double_integrator(), nodes=11, discretization=discretization)
    assert bool(solution.polished)
    assert bool(solution.converged)
    assert float(solution.optimality) <= 1e-8
    assert "optimality conditions" in solution.message
    # The control that minimizes energy is linear in time: its differences are equal.
    # But by the trapezoidal rule the first counts half.
    first = int(discretization.quadrature is Quadrature.TRAPEZOID)
    change = np.diff(np.asarray(solution.trajectory.controls[first:-1, 0]))
    assert_allclose(change, change[0], atol=1e-5)


@eqx.filter_jit
def fresh(transcription, variables) -> tuple[Scaling, Iterate]:
    """A point with everything that is known there, scaled."""
    scaling, substeps = automatic_scaling(transcription, variables), jnp.asarray(2)
    residuals, derivatives = transcription.linearize(variables, substeps)
    return scaling, Iterate(
        variables,
        scaling.residuals(residuals),
        scaling.derivatives(derivatives),
        fresh=jnp.array(True),
        substeps=substeps,
        raised=jnp.zeros((), int),
        integration_error=jnp.zeros(()),
    )


def test_conditions_see_what_is_wrong():
    """Each residual, by hand, of the problem whose step is all there is to it."""
    transcription = Transcription(
        double_integrator(), Discretization(between=1), jnp.linspace(0.0, 1.0, 3)
    )
    states = jnp.asarray([[0.0, 0.0], [1.5, 1.5], [3.0, 0.0]])
    variables = Variables(states, jnp.asarray([[3.0], [-3.0]]), jnp.asarray(2.0))
    scaling, iterate = fresh(transcription, variables)
    nothing = SubproblemSolution.none(Structure.of(transcription))
    gap_of = eqx.filter_jit(optimality)
    gap = gap_of(transcription, scaling, iterate, nothing)
    # With u = 3 the first interval ends at (1.5, 3), not at (1.5, 1.5).
    expected = 1.5 / float(scaling.state[1])
    assert float(gap.feasibility) == pytest.approx(expected)
    # No multiplier opposes the cost: 2 u over one second, scaled.
    slope = 6.0 * float(scaling.control[0] / scaling.objective)
    by_time = 18.0 / 2.0 * float(scaling.time / scaling.objective)
    assert float(gap.stationarity) == pytest.approx(max(slope, by_time))
    assert float(gap.complementarity) == 0.0
    pushed = eqx.tree_at(lambda s: s.control, nothing, jnp.asarray([[0.0], [-2.0]]))
    gap = gap_of(transcription, scaling, iterate, pushed)
    # A lower limit's multiplier, 6 from its limit.
    assert float(gap.complementarity) == pytest.approx(
        2.0 * 6.0 / float(scaling.control[0])
    )
    # The first interval comes nearest to the upper limit of the velocity where its last
    # fiftieth, which is not looked at, begins: 3 * 0.98 is 6.06 from it.
    pushes = jnp.zeros((2, 4)).at[0, 3].set(2.0)
    pushed = eqx.tree_at(lambda s: s.multipliers.between, nothing, pushes)
    gap = gap_of(transcription, scaling, iterate, pushed)
    assert float(gap.complementarity) == pytest.approx(
        2.0 * (6.06 / float(scaling.state[1]) + PEAK_TOLERANCE)
    )


def test_a_wrong_curvature_is_refused():
    with pytest.raises(ValueError, match="curvature='some': choose 'all', 'nodes' or"):
        jaxscp.ProximalSCP(curvature="some")
