"""Flows, their Jacobians and the discrete problem, against SciPy and differences."""

import functools
import itertools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, strategies as st
from jax.flatten_util import ravel_pytree
from numpy.testing import assert_allclose
from scipy.integrate import quad, solve_ivp
from scipy.linalg import expm

from jaxscp import Bounds, FirstOrderHold, OptimalControlProblem, ZeroOrderHold, missions
from jaxscp._discretization import Discretization, Quadrature
from jaxscp._flow import Flow
from jaxscp._lagrangian import curved_entries, nodal_curvature
from jaxscp._per_constraint import PerConstraint
from jaxscp._problem import Integral
from jaxscp._step import Span
from jaxscp._transcription import Residuals, Transcription, Variables
from jaxscp.textbook import minimum_energy_double_integrator

ZERO_ORDER, FIRST_ORDER = ZeroOrderHold(), FirstOrderHold()
every_hold = pytest.mark.parametrize(
    "hold", [ZERO_ORDER, FIRST_ORDER], ids=("zero-order", "first-order")
)
every_quadrature = pytest.mark.parametrize(
    "quadrature", list(Quadrature), ids=lambda rule: rule.value
)
EVEN, UNEVEN = np.linspace(0.0, 1.0, 6), np.array([0.0, 0.05, 0.3, 0.35, 0.8, 1.0])
every_grid = pytest.mark.parametrize("fractions", [EVEN, UNEVEN], ids=("even", "uneven"))

A = np.array([[0.1, 1.0, 0.0], [-2.0, -0.3, 0.5], [0.4, 0.0, -1.2]])
B = np.array([[0.0, 1.0], [2.0, 0.3], [-0.7, 0.0]])


def linear(t, x, u):
    return jnp.asarray(A) @ x + jnp.asarray(B) @ u


def pendulum(t, x, u, xp=jnp):
    """Driven by the clock too: a stage at a wrong moment would cost an order."""
    return xp.stack([x[1], -xp.sin(x[0]) + xp.cos(3.0 * t) + u[0] * x[1]])


def problem_of(dynamics, n: int, m: int, **others) -> OptimalControlProblem:
    settings = {"state": Bounds.free(n), "control": Bounds.free(m)}
    return OptimalControlProblem(
        dynamics, **settings, final_time=Bounds(0.5, 9.0), **others
    )


@functools.cache
def costly_pendulum() -> OptimalControlProblem:
    """A function of everything in every place that takes one."""
    return problem_of(
        pendulum,
        2,
        1,
        running_cost=lambda t, x, u: jnp.exp(0.2 * t) * u[0] ** 2 + x[0] * x[1] * u[0],
        terminal_cost=lambda t, x: t**2 * x[0] + x[1] ** 2 * x[0],
        path_constraints={
            "disc": lambda t, x, u: 1.0 - x @ x + 0.1 * t * u[0] ** 2,
            "pair": lambda t, x, u: jnp.stack([x[0] * u[0], jnp.sin(x[1]) * (1 + t)]),
        },
        integrals={
            "a": Integral(lambda t, x, u: jnp.sin(t) * x[0] ** 2, Bounds.at_least(1.0)),
            "b": Integral(lambda t, x, u: x[1] * u[0] ** 2, Bounds.at_most(1.0)),
        },
    )


def transcribed(
    problem, fractions, hold=ZERO_ORDER, quadrature=Quadrature.FLOW, between=0
):
    discretization = Discretization(hold, quadrature, between)
    return Transcription(problem, discretization, jnp.asarray(fractions))


def point(transcription, final_time=2.5, seed=0) -> Variables:
    draw = np.random.default_rng(seed).normal
    n, m = transcription.problem.state_size, transcription.problem.control_size
    return Variables(
        jnp.asarray(draw(size=(transcription.nodes, n))),
        jnp.asarray(draw(size=(transcription.control_nodes, m))),
        jnp.asarray(final_time),
    )


@eqx.filter_jit
def evaluate(transcription, variables, substeps):
    return transcription.evaluate(variables, substeps)


@eqx.filter_jit
def linearize(transcription, variables, substeps):
    return transcription.linearize(variables, substeps)


def exponential(dt):
    """Transition matrix, response to a constant control and to one rising by 1 per s."""
    n, m = B.shape
    augmented = np.zeros((n + 2 * m, n + 2 * m))
    augmented[:n, :n], augmented[:n, n : n + m] = A, B
    augmented[n : n + m, n + m :] = np.eye(m)
    return np.split(expm(augmented * dt)[:n], [n, n + m], axis=1)


@every_grid
@every_hold
def test_linear_systems(hold, fractions):
    transcription = transcribed(problem_of(linear, 3, 2), fractions, hold)
    variables = point(transcription)
    # Steps of 3 ms at most, of a method of order four: an error of about 1e-11.
    residuals, derivatives = linearize(transcription, variables, jnp.asarray(400))
    jacobian = derivatives.intervals.next_state
    x, u = np.asarray(variables.states), np.asarray(variables.controls)
    near = {"rtol": 0.0, "atol": 1e-9}
    for k, width in enumerate(np.diff(fractions)):
        dt = 2.5 * width
        transition, constant, ramp = exponential(dt)
        rise = (u[k + 1] - u[k]) / dt if hold is FIRST_ORDER else np.zeros(2)
        end = transition @ x[k] + constant @ u[k] + ramp @ rise
        assert_allclose(residuals.defects[k], x[k + 1] - end, **near)
        assert_allclose(jacobian.left_state[k], transition, **near)
        # A longer interval goes on as it ends, but the control rises more slowly.
        by_dt = A @ end + B @ (u[k] + rise * dt) - ramp @ rise / dt
        assert_allclose(jacobian.time[k], width * by_dt, **near)
        if hold is FIRST_ORDER:
            constant = constant - ramp / dt
            assert_allclose(jacobian.right_control[k], ramp / dt, **near)
        assert_allclose(jacobian.left_control[k], constant, **near)
    assert jacobian.right_state is None
    assert (jacobian.right_control is None) == (hold is ZERO_ORDER)


@every_hold
def test_order_four_and_time_in_seconds(hold):
    transcription = transcribed(problem_of(pendulum, 2, 1), [0.0, 0.4, 1.0], hold)
    variables = point(transcription, final_time=4.0)
    x, u = np.asarray(variables.states), np.asarray(variables.controls)
    exact = np.zeros((2, 2))
    for k, (begin, end) in enumerate([(0.0, 1.6), (1.6, 4.0)]):
        rise = (u[k + 1] - u[k]) / (end - begin) if hold is FIRST_ORDER else np.zeros(1)

        def rate(t, x, begin=begin, start=u[k], rise=rise):
            return pendulum(t, x, start + rise * (t - begin), np)

        precise = {"method": "DOP853", "rtol": 1e-13, "atol": 1e-13}
        exact[k] = x[k + 1] - solve_ivp(rate, (begin, end), x[k], **precise).y[:, -1]
    counts = [16, 32, 64, 128]
    errors = [
        np.linalg.norm(
            evaluate(transcription, variables, jnp.asarray(count)).defects - exact, axis=1
        )
        for count in counts
    ]
    order = -np.polyfit(np.log(counts), np.log(errors), 1)[0]
    assert np.all((order > 3.8) & (order < 4.3)), order
    assert np.max(errors[-1]) < 1e-7


def test_the_state_within_an_interval():
    flow = Flow(problem_of(linear, 3, 2), Discretization(FIRST_ORDER), 200)
    start, left, right = (
        jnp.array([1.0, -0.5, 2.0]),
        jnp.array([0.5, -1.0]),
        jnp.array([2.0, 0.0]),
    )
    # A share of 0.4 of an interval of 0.75 s.
    span = Span(jnp.array(0.2), jnp.array(0.3), left, right, jnp.array(2.5))
    transition, constant, ramp = exponential(0.3)
    middle = flow.along(span, start, jnp.array(0.4))
    rise = (right - left) / 0.75
    assert_allclose(middle, transition @ start + constant @ left + ramp @ rise, atol=1e-9)


@every_hold
def test_the_state_within_a_step(hold):
    """Of third order, locally four, between the ends; those are the step's own."""
    flow = Flow(problem_of(pendulum, 2, 1), Discretization(hold), 1)
    x, u = jnp.array([0.5, -1.0]), jnp.array([0.5])
    rise = 1.5 if hold is FIRST_ORDER else 0.0
    shares, lengths, errors = np.array([0.2, 0.5, 0.8]), [0.08, 0.04, 0.02, 0.01], []
    for length in lengths:
        right = u + 1.5 * length
        span = Span(jnp.array(0.3), jnp.array(length), u, right, jnp.array(1.0))
        step = flow.step(span, 0, x)

        def rate(t, x):
            return pendulum(t, x, np.asarray(u) + rise * (t - 0.3), np)

        times = 0.3 + np.append(shares, 1.0) * length
        precise = {"method": "DOP853", "rtol": 1e-13, "atol": 1e-13, "t_eval": times}
        exact = solve_ivp(rate, (0.3, times[-1]), x, **precise).y[:, :-1]
        found = jnp.stack([step.within(share) for share in jnp.asarray(shares)], axis=1)
        errors.append(np.linalg.norm(found - exact, axis=0))
        assert_allclose(step.within(jnp.array(0.0)), x, rtol=1e-14)
        assert_allclose(step.within(jnp.array(1.0)), step.ending, rtol=1e-14)
    order = np.polyfit(np.log(lengths), np.log(errors), 1)[0]
    assert np.all((order > 3.8) & (order < 4.3)), order


@eqx.filter_jit
def shifted(transcription, variables, substeps, shifts) -> Residuals:
    """All residuals after each shift of the variables, along a last axis."""
    flat, unravel = ravel_pytree(variables)

    def at(shift):
        return transcription.evaluate(unravel(flat + shift), substeps)

    return jax.vmap(at, out_axes=-1)(shifts)


def dense(transcription, derivatives) -> dict[str, np.ndarray]:
    """All derivatives, one column a variable, from the meaning of each block."""
    problem, nodes = transcription.problem, transcription.nodes
    n, m, first = problem.state_size, problem.control_size, nodes * problem.state_size
    free, of_nodes = transcription.control_nodes, derivatives.nodes
    columns = first + free * m + 1

    def state(k):
        return slice(k * n, (k + 1) * n)

    def control(k):
        k = min(k, free - 1)
        return slice(first + k * m, first + (k + 1) * m)

    def along(jacobian):
        rows = np.zeros((nodes - 1, jacobian.time.shape[1], columns))
        for k in range(nodes - 1):
            rows[k, :, state(k)] = jacobian.left_state[k]
            rows[k, :, control(k)] = jacobian.left_control[k]
            if jacobian.right_state is not None:
                rows[k, :, state(k + 1)] = jacobian.right_state[k]
            if jacobian.right_control is not None:
                rows[k, :, control(k + 1)] = jacobian.right_control[k]
        rows[:, :, -1] = jacobian.time
        return rows

    defects = -along(derivatives.intervals.next_state)
    increments = along(derivatives.intervals.increments)
    path = np.zeros((nodes, of_nodes.path_time.shape[1], columns))
    for k in range(nodes):
        path[k, :, state(k)] = of_nodes.path_state[k]
        path[k, :, control(k)] = of_nodes.path_control[k]
    for k in range(nodes - 1):
        defects[k, :, state(k + 1)] += np.eye(n)
    path[:, :, -1] = of_nodes.path_time
    objective = increments[:, -1].sum(axis=0)
    objective[state(nodes - 1)] += of_nodes.terminal_state
    objective[-1] += of_nodes.terminal_time
    return {
        "objective": objective,
        "defects": defects,
        "path": path,
        "increments": increments,
    }


def check_every_column(transcription, variables, steps):
    """By central differences, relative to the largest entry of each row.

    The step of each variable serves as its unit.
    """
    substeps = jnp.asarray(3)
    steps = np.concatenate([np.ravel(leaf) for leaf in jax.tree.leaves(steps)])
    residuals, derivatives = linearize(transcription, variables, substeps)
    shifts = np.concatenate([np.zeros((1, steps.size)), np.diag(steps), -np.diag(steps)])
    around = shifted(transcription, variables, substeps, jnp.asarray(shifts))
    exact = dense(transcription, derivatives)
    for name in ("objective", "defects", "path", "increments"):
        here, ahead, behind = np.split(
            np.asarray(getattr(around, name)), [1, 1 + steps.size], axis=-1
        )
        assert_allclose(getattr(residuals, name), here[..., 0], rtol=1e-9, err_msg=name)
        told = exact[name] * steps
        row = np.abs(told).max(axis=-1, keepdims=True)
        assert np.all(row > 0), name
        seen = 0.5 * (ahead - behind)
        assert_allclose(seen / row, told / row, rtol=1e-6, atol=1e-6, err_msg=name)


@every_quadrature
@every_hold
def test_jacobians(hold, quadrature):
    transcription = transcribed(costly_pendulum(), UNEVEN, hold, quadrature)
    variables = point(transcription)
    steps = jax.tree.map(lambda leaf: np.full(leaf.shape, 1e-5), variables)
    check_every_column(transcription, variables, steps)


def test_jacobians_of_the_quadrotor():
    mission = missions.get("urban-30MB-60dB")
    problem, guess = mission.problem(), mission.guess(4)
    transcription = transcribed(problem, guess.fractions)
    # Off the guess, where symmetry and rest hide many derivatives.
    offset = point(transcription, final_time=3.0)
    variables = Variables(
        np.asarray(guess.states) + 0.2 * offset.states,
        np.asarray(guess.controls)[:3] * (1.0 + 0.1 * offset.controls)
        + 0.01 * offset.controls,
        offset.final_time,
    )
    steps = jax.tree.map(lambda leaf: np.full(leaf.shape, 1e-4), variables)
    check_every_column(transcription, variables, steps)


def test_integrals_along_the_flow():
    # x = x_k exp(-(t - t_k)) in each interval, whatever the next node says.
    problem = problem_of(
        lambda t, x, u: -x,
        1,
        1,
        running_cost=lambda t, x, u: u[0] * x[0],
        integrals={
            "z": Integral(lambda t, x, u: jnp.cos(t) * x[0] ** 2, Bounds.at_least(0.0)),
            "a": Integral(lambda t, x, u: jnp.sqrt(1 + t), Bounds.at_least(0.0)),
        },
        terminal_cost=lambda t, x: t + 10 * x[0],
    )
    transcription = transcribed(problem, UNEVEN)
    variables = point(transcription)
    x, u = np.asarray(variables.states)[:, 0], np.asarray(variables.controls)[:, 0]
    residuals = evaluate(transcription, variables, jnp.asarray(100))
    times = 2.5 * UNEVEN
    for k, (begin, end) in enumerate(itertools.pairwise(times)):

        def squared(t, k=k, begin=begin):
            return np.cos(t) * (x[k] * np.exp(begin - t)) ** 2

        # In the order of their names, the running cost last.
        root = 2 / 3 * ((1 + end) ** 1.5 - (1 + begin) ** 1.5)
        cost = u[k] * x[k] * (1 - np.exp(begin - end))
        expected = [root, quad(squared, begin, end, epsabs=1e-13)[0], cost]
        assert_allclose(residuals.increments[k], expected, atol=1e-10)
    increments = np.asarray(residuals.increments)
    assert_allclose(residuals.totals, increments[:, :2].sum(axis=0))
    assert_allclose(residuals.objective, increments[:, 2].sum() + 2.5 + 10 * x[-1])


def test_the_trapezoidal_rule():
    problem = costly_pendulum()
    transcription = transcribed(problem, UNEVEN, FIRST_ORDER, Quadrature.TRAPEZOID)
    variables = point(transcription)
    residuals = evaluate(transcription, variables, jnp.asarray(3))
    times = 2.5 * UNEVEN
    x, u = np.asarray(variables.states).T, np.asarray(variables.controls).T
    rates = [
        np.sin(times) * x[0] ** 2,
        x[1] * u[0] ** 2,
        np.exp(0.2 * times) * u[0] ** 2 + x[0] * x[1] * u[0],
    ]
    totals = np.trapezoid(rates, times)
    assert_allclose(jnp.sum(residuals.increments, axis=0), totals, rtol=1e-12)
    assert_allclose(residuals.totals, totals[:2], rtol=1e-12)
    # Only the bookkeeping of the integrals differs: the flow stays.
    along = transcribed(problem, UNEVEN, FIRST_ORDER)
    flow = evaluate(along, variables, jnp.asarray(3))
    assert_allclose(residuals.defects, flow.defects, rtol=1e-13)
    assert not np.allclose(residuals.increments, flow.increments, rtol=1e-3)
    # Scales are taken from the rule whatever the quadrature, the terminal cost included.
    terminal = 2.5**2 * x[0, -1] + x[1, -1] ** 2 * x[0, -1]
    rough = eqx.filter_jit(Transcription.rough_totals)(along, variables)
    assert_allclose(rough, totals + np.array([0.0, 0.0, terminal]), rtol=1e-12)


@pytest.mark.parametrize(
    ("hold", "quadrature", "free"),
    [
        (ZERO_ORDER, Quadrature.FLOW, 5),
        (FIRST_ORDER, Quadrature.FLOW, 6),
        (ZERO_ORDER, Quadrature.TRAPEZOID, 6),
        (FIRST_ORDER, Quadrature.TRAPEZOID, 6),
    ],
)
def test_free_controls(hold, quadrature, free):
    transcription = transcribed(costly_pendulum(), EVEN, hold, quadrature)
    assert transcription.control_nodes == free
    variables = point(transcription)
    nodal = transcription.nodal_controls(variables)
    assert nodal.shape == (6, 1)
    assert_allclose(nodal[:free], variables.controls)
    # The last free one is held to the end.
    assert_allclose(nodal[-1], variables.controls[-1])
    assert transcription.problem.path_sizes == {"disc": 1, "pair": 2}


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"tolerance": 0.0}, "tolerance=0.0: give a positive number"),
        ({"tolerance": float("nan")}, "tolerance=nan"),
        ({"min_substeps": 0}, "need 1 <= min_substeps <= max_substeps"),
        ({"min_substeps": 9, "max_substeps": 8}, "min_substeps=9, max_substeps=8"),
        ({"between": -1}, "between=-1: give the parts of an interval to watch, or 0"),
        (
            {"between": 5, "max_substeps": 8},
            "between=5: needs two substeps a part, and max_substeps is 8; raise it",
        ),
        ({"interval_ratio": 1.0}, r"interval_ratio=1\.0: give a number above 1, or None"),
        (
            {"interval_ratio": 2.0, "longest_interval": 0.9},
            r"longest_interval=0\.9: give a number of mean intervals above 1",
        ),
        (
            {"interval_ratio": 2.0, "hold": FIRST_ORDER},
            r"interval_ratio=2\.0: needs hold=ZeroOrderHold\(\), not FirstOrderHold",
        ),
        (
            {"interval_ratio": 2.0, "quadrature": Quadrature.TRAPEZOID},
            r"interval_ratio=2\.0: needs quadrature=Quadrature\.FLOW",
        ),
    ],
)
def test_bad_settings(settings, message):
    with pytest.raises(ValueError, match=message):
        Discretization(**settings)


def test_each_part_that_is_watched_has_two_substeps():
    assert Discretization().least_substeps == 2
    assert Discretization(between=4, max_substeps=8).least_substeps == 8
    assert Discretization(between=4, min_substeps=9).least_substeps == 9


def test_limits_of_the_nodes():
    inf = jnp.inf
    problem = OptimalControlProblem(
        linear,
        state=Bounds(jnp.array([-3.0, -inf, 2.0]), jnp.array([3.0, 5.0, 2.0])),
        control=Bounds(jnp.array([-1.0, 0.5]), jnp.array([1.0, 0.5])),
        initial_state=Bounds.exactly(jnp.array([0.5, 1.0, 2.0])),
        final_state=Bounds(jnp.array([-9.0, -2.0, -inf]), jnp.array([1.0, 9.0, inf])),
        final_time=Bounds(1.0, 3.0),
    )
    transcription = transcribed(problem, EVEN)
    lower, upper = transcription.state_limits
    assert_allclose(lower, [[0.5, 1, 2], *[[-3, -inf, 2]] * 4, [-3, -2, 2]])
    assert_allclose(upper, [[0.5, 1, 2], *[[3, 5, 2]] * 4, [1, 5, 2]])
    fixed = [[True] * 3, *[[False, False, True]] * 5]
    np.testing.assert_array_equal(transcription.fixed_states, fixed)
    wild = transcription.trajectory(
        Variables(jnp.full((6, 3), 7.0), jnp.full((5, 2), -7.0), jnp.array(7.0))
    )
    variables = transcription.variables(wild)
    assert_allclose(variables.states, [[0.5, 1, 2], *[[3, 5, 2]] * 4, [1, 5, 2]])
    assert_allclose(variables.controls, [[-1, 0.5]] * 5)
    assert variables.final_time == 3.0


@eqx.filter_jit
def curvature(transcription, variables, multipliers):
    return nodal_curvature(transcription, variables, multipliers)


def multipliers_of(transcription, seed=1) -> PerConstraint:
    draw = np.random.default_rng(seed).normal
    return jax.tree.map(
        lambda leaf: jnp.asarray(draw(size=leaf.shape)), transcription.no_multipliers
    )


def nodal_sum(transcription, variables, rate_weights, path_weights, shares):
    """Weighted integrands times the seconds of their node, path constraints, and end."""
    problem, total = transcription.problem, 0.0
    for k, fraction in enumerate(np.asarray(transcription.fractions)):
        t = variables.final_time * fraction
        here = (t, variables.states[k], variables.controls[k])
        rates = [i.integrand(*here) for i in problem.integrals.values()]
        rates = jnp.stack([*rates, problem.running_cost(*here)])
        total += variables.final_time * shares[k] * (rate_weights @ rates)
        path = [jnp.ravel(g(*here)) for g in problem.path_constraints.values()]
        total += path_weights[k] @ jnp.concatenate(path)
    last = problem.terminal_cost(variables.final_time, variables.states[-1])
    return total + rate_weights[-1] * last


def test_curvature_is_zero_but_for_what_is_told():
    problem = costly_pendulum()
    transcription = transcribed(problem, UNEVEN, FIRST_ORDER)
    found = curvature(transcription, point(transcription), multipliers_of(transcription))
    entries = curved_entries(transcription)
    seen = np.any(np.asarray(found.blocks) != 0.0, axis=(0, 1))
    assert set(np.flatnonzero(seen)) <= set(entries)
    # Linear in its state, quadratic in its control.
    integrator = minimum_energy_double_integrator()
    assert curved_entries(transcribed(integrator, EVEN)).tolist() == [2]


def test_curvature_is_the_hessian_of_the_nodal_sum():
    inf = np.inf
    limits = Bounds([-inf, -9.0], [5.0, 9.0])
    problem = eqx.tree_at(lambda p: p.state, costly_pendulum(), limits)
    transcription = transcribed(problem, UNEVEN, FIRST_ORDER, between=2)
    variables = point(transcription)
    multipliers = multipliers_of(transcription)
    rate_weights = jnp.append(multipliers.integral, 1.0)
    # Two parts of three limits, then three path constraints, that count where the
    # interval begins.
    between = multipliers.between[:, 3:6] + multipliers.between[:, 9:12]
    path_weights = multipliers.path.at[:-1].add(between)
    # Seconds of each node: half of the intervals at its sides.
    shares = np.array([0.025, 0.15, 0.15, 0.25, 0.325, 0.1])

    @jax.jit
    def hessian(states, controls):
        def total(states, controls):
            there = Variables(states, controls, variables.final_time)
            return nodal_sum(transcription, there, rate_weights, path_weights, shares)

        return jax.hessian(total, argnums=(0, 1))(states, controls)

    (xx, xu), (_, uu) = hessian(variables.states, variables.controls)
    found = curvature(transcription, variables, multipliers)
    for k, block in enumerate(found.blocks):
        assert_allclose(block[:2, :2], xx[k, :, k], atol=1e-12)
        assert_allclose(block[:2, 2:], xu[k, :, k], atol=1e-12)
        assert_allclose(block[2:, 2:], uu[k, :, k], atol=1e-12)
    # It knows neither the flight time nor the next node.
    assert not np.any(found.border)
    assert not np.any(found.corner)
    assert not np.any(found.ahead)
    assert found.tail is None


def test_curvature_under_a_zero_order_hold():
    # A held control stands for the whole interval behind its node, a state for half of
    # both beside it, and the mixed terms for the geometric mean.
    Q, R = np.array([[2.0, 0.5], [0.5, 1.0]]), np.array([[3.0]])
    S = np.array([[0.7], [-0.4]])

    def cost(t, x, u):
        return 0.5 * x @ jnp.asarray(Q) @ x + x @ jnp.asarray(S) @ u + 1.5 * u @ u

    problem = problem_of(
        pendulum, 2, 1, running_cost=cost, terminal_cost=lambda t, x: 4.0 * x[1] ** 2
    )
    transcription = transcribed(problem, UNEVEN)
    multipliers = transcription.no_multipliers
    found = curvature(transcription, point(transcription, 3.0), multipliers)
    of_state = 3.0 * np.array([0.025, 0.15, 0.15, 0.25, 0.325, 0.1])
    of_control = 3.0 * np.array([0.05, 0.25, 0.05, 0.45, 0.2, 0.0])
    for k in range(6):
        mixed = np.sqrt(of_state[k] * of_control[k]) * S
        expected = np.block([[of_state[k] * Q, mixed], [mixed.T, of_control[k] * R]])
        if k == 5:
            expected[1, 1] += 8.0
        assert_allclose(found.blocks[k], expected, atol=1e-12)
    assert found.ahead is None
    assert not np.any(found.tail)


@given(st.integers(0, 2**32 - 1), st.floats(0.1, 50.0), st.sampled_from(list(Quadrature)))
def test_curvature_is_symmetric(seed, final_time, quadrature):
    transcription = transcribed(costly_pendulum(), UNEVEN, ZERO_ORDER, quadrature)
    variables = point(transcription, final_time, seed)
    multipliers = multipliers_of(transcription, seed)
    blocks = np.asarray(curvature(transcription, variables, multipliers).blocks)
    assert_allclose(blocks, np.swapaxes(blocks, 1, 2), rtol=1e-12, atol=1e-12)
    held = transcription.control_nodes < transcription.nodes
    assert np.all(blocks[-1, 2] == 0.0) == held


def test_substeps_may_be_traced():
    traces = []

    def dynamics(t, x, u):
        traces.append(t)
        return pendulum(t, x, u)

    transcription = transcribed(problem_of(dynamics, 2, 1), EVEN)
    variables = point(transcription)
    few, many = linearize(transcription, variables, jnp.asarray(2)), len(traces)
    assert many > 0
    fine = linearize(transcription, variables, jnp.asarray(20))
    assert len(traces) == many
    assert not np.allclose(few[0].defects, fine[0].defects, rtol=1e-9)
    # A Python number is compiled in, and must mean the same.
    static = linearize(transcription, variables, 20)
    for left, right in zip(jax.tree.leaves(static), jax.tree.leaves(fine), strict=True):
        assert_allclose(left, right, rtol=1e-12, atol=1e-13)


def test_substeps_may_be_a_batch():
    transcription = transcribed(costly_pendulum(), EVEN)
    variables, counts = point(transcription), jnp.array([1, 3, 8])
    vectorized = eqx.filter_vmap(evaluate, in_axes=(None, None, 0))
    batch = vectorized(transcription, variables, counts)
    for index, count in enumerate(counts):
        alone = evaluate(transcription, variables, count)
        for left, right in zip(
            jax.tree.leaves(batch), jax.tree.leaves(alone), strict=True
        ):
            assert_allclose(left[index], right, rtol=1e-12, atol=1e-13)
