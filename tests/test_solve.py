"""Solves of one small family: how they end, what they say, and what they return.

Compiling a solve takes seconds, so nearly all tests share the same functions and shapes
and differ in numbers alone.
"""

import dataclasses
import functools
import re
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from bank import steps
from numpy.testing import assert_allclose
from scipy.integrate import solve_ivp
from test_validation import compilations

import jaxscp
from jaxscp import Bounds, Integral, OptimalControlProblem, _qp, missions
from jaxscp._choice import best
from jaxscp._diagnosis import Violations, explain
from jaxscp._progress import listener

NODES = 6
GOAL = 3.0


class Cart(eqx.Module):
    """A cart on a track, with air drag.

    - `drag` [1/m].
    - `deceit`: what share of the derivative is kept from JAX; with 2 it has the wrong
        sign.
    """

    drag: jax.Array
    deceit: jax.Array

    def __call__(self, t, x, u):
        rate = jnp.stack([x[1], u[0] - self.drag * x[1] * jnp.abs(x[1])])
        return rate + self.deceit * (jax.lax.stop_gradient(rate) - rate)


class Singular(eqx.Module):
    """A function that is what it was, but NaN where the position is below `edge`.

    At the edge itself only the derivative is.
    """

    function: Callable
    edge: jax.Array

    def __call__(self, *point):
        position = point[1][0]
        return self.function(*point) + 0.0 * jnp.sqrt(position - self.edge)


class Fence(eqx.Module):
    """Stay on the near side of both ends of a track [m]."""

    ends: jax.Array

    def __call__(self, t, x, u):
        return jnp.stack([self.ends[0] - x[0], x[0] - self.ends[1]])


def effort(t, x, u):
    return u[0] ** 2


def lateness(t_f, x_f):
    return 0.1 * t_f


def speed(t, x, u):
    return x[1]


# What messages call each function, to the keyword of `cart` that makes it singular.
FUNCTIONS = {
    "dynamics": "dynamics",
    "running_cost": "running_cost",
    "terminal_cost": "terminal_cost",
    "path_constraints['fence']": "fence",
    "integrals['travel'].integrand": "travel",
}


def cart(
    force=4.0,
    drag=0.2,
    *,
    goal=GOAL,
    deceit=0.0,
    fence=(-50.0, 50.0),
    travel=(0.0, 50.0),
    final_time=(1.0, 4.0),
    edges=(),
) -> OptimalControlProblem:
    """From rest to rest over `goal` [m], with the least effort and a price on time."""
    edges = dict(edges)

    def parameter(value):
        return jnp.asarray(value, float)

    def singular(name, function):
        return Singular(function, parameter(edges.get(name, -1e3)))

    limit = parameter(force)[None]
    return OptimalControlProblem(
        singular("dynamics", Cart(parameter(drag), parameter(deceit))),
        state=Bounds(np.full(2, -100.0), np.full(2, 100.0), scale=np.array([3.0, 2.0])),
        control=Bounds(-limit, limit),
        initial_state=Bounds.exactly(np.zeros(2)),
        final_state=Bounds.exactly(jnp.stack([parameter(goal), jnp.zeros(())])),
        final_time=Bounds(*final_time),
        running_cost=singular("running_cost", effort),
        terminal_cost=singular("terminal_cost", lateness),
        path_constraints={"fence": singular("fence", Fence(parameter(fence)))},
        integrals={"travel": Integral(singular("travel", speed), Bounds(*travel))},
        state_names=("position", "velocity"),
        control_names=("force",),
        units={"position": "m", "velocity": "m/s", "fence": "m", "travel": "m"},
    )


def solve(problem, guess=None, **options):
    return jaxscp.solve(problem, guess, nodes=NODES, **{"throw": False} | options)


@functools.cache
def converged() -> jaxscp.Solution:
    return solve(cart(), throw=True)


RECORDS: list[dict] = []
TWO_STEPS = jaxscp.ProximalSCP(max_iterations=2, max_polish=0)
UNEVEN = (0.0, 0.1, 0.25, 0.5, 0.6, 1.0)


@functools.cache
def interrupted() -> tuple[jaxscp.Solution, tuple[dict, ...]]:
    """Stopped after two steps, under a first-order hold, and what it reported."""
    return recorded(jaxscp.straight_line(cart(), UNEVEN))


def recorded(guess, told=RECORDS.append) -> tuple[jaxscp.Solution, tuple[dict, ...]]:
    RECORDS.clear()
    solution = jaxscp.solve(
        cart(),
        guess,
        TWO_STEPS,
        discretization=jaxscp.Discretization(jaxscp.FirstOrderHold(), tolerance=1e-9),
        progress=told,
        throw=False,
    )
    jax.effects_barrier()
    return solution, tuple(RECORDS)


def number(pattern: str, message: str) -> float:
    found = re.search(pattern, message)
    assert found, message
    return float(found.group(1))


def flown(problem, hold, left, right, x, start, end, times):
    """SciPy's flow from `start` [s] to each of `times`, before `end`."""

    def rate(t, x):
        u = hold.interpolate(left, right, (t - start) / (end - start))
        return np.asarray(problem.dynamics(jnp.asarray(t), jnp.asarray(x), u))

    span = (start, times[-1])
    return solve_ivp(rate, span, x, t_eval=times, rtol=1e-9, atol=1e-9).y.T


# How a solve ends.


def test_a_solve_that_converges():
    solution = converged()
    assert bool(solution.converged)
    assert solution.message == str(jaxscp.Status[jaxscp.Status.converged])
    trajectory = solution.trajectory
    assert trajectory.states.shape == (NODES, 2)
    assert trajectory.controls.shape == (NODES, 1)
    np.testing.assert_allclose(trajectory.states[0], [0, 0], atol=1e-12)
    np.testing.assert_allclose(trajectory.states[-1], [GOAL, 0], atol=1e-12)
    # Slower is cheaper all along, and the way is as long as it is.
    assert float(trajectory.final_time) == pytest.approx(4.0, abs=1e-3)
    assert float(solution.integrals["travel"]) == pytest.approx(GOAL, abs=1e-4)
    lateness_paid = 0.1 * float(trajectory.final_time)
    held = np.diff(trajectory.times) @ np.asarray(trajectory.controls[:-1, 0]) ** 2
    assert float(solution.objective) == pytest.approx(held + lateness_paid, rel=1e-9)
    # Held over no interval: the last control repeats.
    np.testing.assert_array_equal(trajectory.controls[-1], trajectory.controls[-2])


def test_multipliers_bear_the_names_of_their_constraints():
    multipliers = converged().multipliers
    assert multipliers.dynamics.shape == (NODES - 1, 2)
    assert multipliers.path_constraints["fence"].shape == (NODES, 2)
    assert set(multipliers.integrals) == {"travel"}
    # No limit but the flight time's and the ends' is active.
    np.testing.assert_allclose(multipliers.path_constraints["fence"], 0, atol=1e-5)
    np.testing.assert_allclose(multipliers.integrals["travel"], 0, atol=1e-5)
    assert float(multipliers.final_time) > 0.1


def test_dynamics_that_cannot_be_met_within_the_limits():
    # Half a newton moves a kilogram 2 m in 4 s from rest to rest.
    solution = solve(cart(force=0.5))
    assert bool(solution.status == jaxscp.Status.virtual_control_remains)
    pattern = (
        r"^The dynamics cannot be met within the limits.* Worst: virtual control moves "
        r"(position|velocity) by (\S+) (m|m/s) between nodes (\d) and (\d) "
        r"\((\S+) s to (\S+) s\)\.$"
    )
    found = re.search(pattern, solution.message)
    assert found, solution.message
    name, amount, unit, first, second, begin, end = found.groups()
    assert unit == {"position": "m", "velocity": "m/s"}[name]
    node, entry = int(first), ("position", "velocity").index(name)
    assert int(second) == node + 1
    nodes = solution.trajectory
    times = np.asarray(nodes.times)
    assert float(begin) == pytest.approx(times[node], rel=1e-3)
    assert float(end) == pytest.approx(times[node + 1], rel=1e-3)
    arrived = flown(
        solution.problem,
        solution.discretization.hold,
        *nodes.controls[node : node + 2],
        np.asarray(nodes.states[node]),
        *times[node : node + 2],
        times[node + 1 : node + 2],
    )
    missing = np.abs(nodes.states[node + 1] - arrived[0])
    assert float(amount) == pytest.approx(missing[entry], rel=1e-3)
    # It is the worst there is.
    broken = np.abs(solution.violations.dynamics) / np.array([3.0, 2.0])
    assert np.unravel_index(np.argmax(broken), broken.shape) == (node, entry)


def test_infeasible_dynamics_with_strong_drag():
    solution = solve(cart(force=0.3))
    assert bool(solution.status == jaxscp.Status.virtual_control_remains)


@pytest.mark.parametrize(("limits", "missing"), [((5.0, 50.0), 2.0), ((0.0, 2.75), 0.25)])
def test_an_integral_that_cannot_be_met(limits, missing):
    # The integral of speed is the way, 3 m, whatever one does.
    solution = solve(cart(travel=limits))
    assert bool(solution.status == jaxscp.Status.virtual_buffer_remains)
    sentence = r"^A constraint cannot be met.* the integral travel misses its limit by "
    amount = number(sentence + r"(\S+) m\.$", solution.message)
    assert amount == pytest.approx(missing, rel=1e-3)
    assert float(solution.integrals["travel"]) == pytest.approx(GOAL, rel=1e-3)


@pytest.mark.parametrize(
    ("fence", "entry", "node", "broken"),
    [((-50.0, 2.5), 1, NODES - 1, 0.5), ((0.25, 50.0), 0, 0, 0.25)],
)
def test_a_path_constraint_that_cannot_be_met(fence, entry, node, broken):
    # One end of the flight, each fixed, lies beyond the fence.
    solution = solve(cart(fence=fence))
    assert bool(solution.status == jaxscp.Status.virtual_buffer_remains)
    time = float(solution.trajectory.times[node])
    sentence = rf"^A constraint cannot be met.* fence\[{entry}\] is broken by "
    place = rf"(\S+) m at node {node} \({time:.4g} s\)\.$"
    amount = number(sentence + place, solution.message)
    assert amount == pytest.approx(broken, rel=1e-3)


@pytest.mark.parametrize("name", FUNCTIONS)
def test_nan_at_the_guess(name):
    # Along the straight line to -3 m, node 2 is the first beyond -1 m.
    solution = solve(cart(goal=-GOAL, edges={FUNCTIONS[name]: -1.0}))
    assert bool(solution.status == jaxscp.Status.non_finite)
    assert not bool(solution.converged)
    # The terminal cost is asked at the end only.
    node = NODES - 1 if name == "terminal_cost" else 2
    trajectory = solution.trajectory
    where = f"{name} at node {node} ({float(trajectory.times[node]):.4g} s), state"
    assert solution.message.startswith("A function of the problem returned NaN or inf")
    assert f"First: the value of {where}" in solution.message
    assert f"[{float(trajectory.states[node, 0]):.2g}" in solution.message


@pytest.mark.parametrize("name", FUNCTIONS)
def test_nan_in_a_derivative_at_the_guess(name):
    # The edge is where the flight ends; the terminal cost sees no other node.
    goal, node = (0.0, NODES - 1) if name == "terminal_cost" else (GOAL, 0)
    solution = solve(cart(goal=goal, edges={FUNCTIONS[name]: 0.0}))
    assert bool(solution.status == jaxscp.Status.non_finite)
    assert not bool(solution.converged)
    assert f"First: the derivative of {name} at node {node} " in solution.message


def test_the_terminal_cost_is_not_blamed_for_what_it_is_never_asked():
    # At the end both are finite; at the start, where the terminal cost would not be,
    # only the integrand counts.
    solution = solve(cart(edges={"terminal_cost": 1.0, "travel": 0.5}))
    assert bool(solution.status == jaxscp.Status.non_finite)
    place = "the value of integrals['travel'].integrand at node 0 (0 s)"
    assert place in solution.message


def test_nan_between_the_nodes():
    problem = cart(edges={"dynamics": -1.0})
    guess = jaxscp.straight_line(problem, NODES)
    guess = eqx.tree_at(
        lambda guess: guess.states, guess, guess.states.at[1, 1].set(-90.0)
    )
    solution = solve(problem, guess)
    assert bool(solution.status == jaxscp.Status.non_finite)
    assert solution.message.endswith("it happens within an interval.")


def test_many_states_stay_on_one_line():
    size = 25
    problem = OptimalControlProblem(
        lambda t, x, u: x / 0.0,
        state=Bounds.free(size),
        control=Bounds.free(1),
        initial_state=Bounds.exactly(np.linspace(1.0, 2.0, size)),
        final_time=Bounds(1.0, 2.0),
    )
    guess = jaxscp.straight_line(problem, NODES)
    none = jnp.zeros_like(guess.states[1:])
    nothing = Violations(guess.states[1:], {}, {}, none, {}, (guess.states[0], {}, {}))
    message = explain(problem, guess, nothing, jaxscp.Status.non_finite)
    assert "First: the value of dynamics at node 0 (0 s)" in message
    assert "\n" not in message


def test_a_step_into_a_singularity_is_not_taken():
    # A model that is wrong by its sign leads backward, where nothing is a number.
    solution = solve(cart(deceit=2.0, edges={"dynamics": -1e-3}))
    assert bool(solution.status == jaxscp.Status.trust_region_collapsed)
    count = int(solution.statistics.iterations)
    # Until the proximal term is heavier than the QP solver resolves.
    assert count > 15
    # Later on, shorter steps, with virtual control, stay where all is a number.
    assert np.isnan(solution.history.defect[:3]).all()
    assert np.isneginf(solution.history.ratio[:3]).all()
    assert not np.any(solution.history.accepted[:count] == 1)
    assert np.isfinite(solution.trajectory.states).all()


def test_derivatives_that_point_the_wrong_way():
    solution = solve(cart(deceit=2.0))
    assert bool(solution.status == jaxscp.Status.trust_region_collapsed)
    assert solution.message.startswith("The trust region collapsed: no step improves")
    accepted = np.asarray(solution.history.accepted)
    assert not np.any(accepted == 1)


def test_a_qp_solver_that_fails(monkeypatch):
    monkeypatch.setattr(
        _qp.Workspace, "solve", lambda self, qp, precision: _qp._unsolved(qp)
    )
    solution = solve(cart())
    assert bool(solution.status == jaxscp.Status.subproblem_failed)
    assert solution.message.startswith("The QP solver failed on a subproblem.")
    # What it returns is the guess.
    guess = jaxscp.straight_line(cart(), NODES)
    np.testing.assert_allclose(solution.trajectory.states, guess.states)


def test_the_iteration_limit():
    solution, _ = interrupted()
    assert bool(solution.status == jaxscp.Status.iteration_limit)
    assert solution.message.startswith("The iteration limit was reached")
    assert int(solution.statistics.iterations) == 2
    amount = number(r"virtual control moves velocity by (\S+) m/s", solution.message)
    assert amount == pytest.approx(
        np.max(np.abs(solution.violations.dynamics[:, 1])), rel=1e-3
    )


def test_failure_raises_the_sentence_with_the_solution():
    with pytest.raises(jaxscp.SolveError) as caught:
        solve(cart(travel=(5.0, 50.0)), throw=True)
    solution = caught.value.solution
    assert str(caught.value) == solution.message
    assert "travel misses its limit by 2 m" in solution.message
    assert not bool(solution.converged)
    assert solution.trajectory.states.shape == (NODES, 2)


# Transformations.


@eqx.filter_jit
def compiled_solve(force, drag):
    return solve(cart(force, drag), throw=True)


def test_under_jit_a_solve_is_the_same():
    inside, outside = compiled_solve(jnp.asarray(4.0), jnp.asarray(0.2)), converged()
    for one, other in zip(
        jax.tree.leaves((inside.trajectory, inside.objective, inside.multipliers)),
        jax.tree.leaves((outside.trajectory, outside.objective, outside.multipliers)),
        strict=True,
    ):
        np.testing.assert_allclose(one, other, rtol=1e-8, atol=1e-8)
    assert inside.statistics.iterations == outside.statistics.iterations
    assert inside.message == outside.message
    # Compiled code knows no clock.
    assert np.isnan(inside.statistics.seconds)


@pytest.mark.parametrize(
    ("force", "drag", "sentence"),
    [
        (0.5, 0.2, "The dynamics cannot be met within the limits"),
        # Traced limits are not checked before: the subproblem finds them upside down.
        (-1.0, 0.2, "A convex subproblem has no solution: limits contradict each other"),
        (4.0, np.nan, "A function of the problem returned NaN or infinity"),
    ],
)
def test_under_jit_a_failure_raises_its_sentence(force, drag, sentence):
    with pytest.raises(RuntimeError, match=sentence):
        jax.block_until_ready(compiled_solve(jnp.asarray(force), jnp.asarray(drag)))


def test_a_batch_is_a_loop():
    forces = np.array([4.0, 0.5, 3.0, -1.0, np.nan, 5.0])
    drags = np.array([0.2, 0.2, 0.1, 0.2, 0.2, 0.3])
    batch = jax.vmap(lambda force, drag: solve(cart(force, drag)))(forces, drags)
    names = (
        "converged",
        "virtual_control_remains",
        "converged",
        "subproblem_infeasible",
        "non_finite",
        "converged",
    )
    for index, name in enumerate(names):
        one = jax.tree.map(lambda leaf, index=index: leaf[index], batch)
        assert bool(one.status == getattr(jaxscp.Status, name)), one.message
        if name != "converged":
            continue
        alone = solve(cart(forces[index], drags[index]))
        assert one.message == alone.message
        assert one.statistics.iterations == alone.statistics.iterations
        for mine, other in zip(
            jax.tree.leaves((one.trajectory, one.history, one.multipliers)),
            jax.tree.leaves((alone.trajectory, alone.history, alone.multipliers)),
            strict=True,
        ):
            np.testing.assert_allclose(mine, other, rtol=1e-12, atol=1e-12)


# JAX's own are strongly typed, or weakly as Python's are.
@pytest.mark.parametrize("number", [np.float64, jnp.float64, jnp.asarray])
def test_new_numbers_compile_nothing(number):
    limits = {"fence": (-1.0, 4.0), "travel": (1.0, 10.0), "final_time": (2.0, 5.0)}
    problem = cart(3.5, **limits)
    problem = eqx.tree_at(
        lambda problem: problem.dynamics.function.drag, problem, number(0.15)
    )
    guess = jaxscp.straight_line(problem, np.array(UNEVEN), final_time=3.0)
    guess = eqx.tree_at(lambda guess: guess.final_time, guess, number(3.0))
    first = converged()
    with compilations() as compiled:
        second = solve(problem, guess)
    assert not compiled
    assert bool(second.converged), second.message
    # They are other numbers.
    assert abs(float(second.objective - first.objective)) > 0.1
    np.testing.assert_allclose(second.trajectory.fractions, UNEVEN)
    np.testing.assert_allclose(second.trajectory.states[-1], [GOAL, 0], atol=1e-12)


def test_from_its_own_solution_a_solve_is_short():
    again = solve(cart(), converged().trajectory)
    assert bool(again.converged)
    assert int(again.statistics.iterations) <= 3
    np.testing.assert_allclose(
        again.trajectory.states, converged().trajectory.states, atol=1e-3
    )
    assert float(again.objective) == pytest.approx(float(converged().objective), rel=1e-4)


# What comes with a solution.


def test_the_problem_comes_back():
    problem, solution = cart(), converged()
    assert eqx.tree_equal(solution.problem, problem)
    assert solution.problem.state_names == problem.state_names


def test_history_ends_with_the_last_record():
    solution = converged()
    statistics, method = solution.statistics, jaxscp.ProximalSCP()
    count = int(statistics.iterations + statistics.polish_iterations)
    for name, values in vars(solution.history).items():
        assert values.shape == (method.max_iterations + method.max_polish,), name
        assert np.isfinite(values[:count]).all(), name
        assert np.isnan(values[count:]).all(), name
    history = jax.tree.map(lambda values: np.asarray(values[:count]), solution.history)
    assert history.objective[-1] == pytest.approx(float(solution.objective), rel=1e-9)
    assert history.radius[0] == pytest.approx(0.1)
    assert set(history.accepted) <= {0.0, 1.0}
    assert max(history.defect[-1], history.buffer[-1]) <= 1e-5
    np.testing.assert_allclose(
        history.ratio * history.predicted_reduction,
        history.actual_reduction,
        rtol=1e-6,
        atol=1e-12,
    )


def test_statistics():
    solution = converged()
    statistics, limits = solution.statistics, solution.discretization
    iterations, subproblems = int(statistics.iterations), int(statistics.subproblems)
    assert 1 < steps(solution) < 20
    assert iterations <= subproblems <= 4 * iterations
    assert subproblems <= int(statistics.qp_iterations) <= 100 * subproblems
    assert limits.min_substeps <= int(statistics.substeps) <= limits.max_substeps
    assert 0 <= float(statistics.integration_error) <= limits.tolerance
    assert 0 < float(statistics.qp_seconds) < float(statistics.seconds)


def test_others_told_of_progress_compile_nothing():
    guess = jaxscp.straight_line(cart(), UNEVEN)
    solution, records = interrupted()
    others: list[dict] = []
    with compilations() as compiled:
        recorded(guess, others.append)
    assert not compiled
    assert tuple(others) == records


@dataclasses.dataclass
class Recorder:
    """Two are equal that have heard the same."""

    rows: list

    def __call__(self, record):
        self.rows.append(record)


def test_equal_listeners_are_two():
    one, other, rows = Recorder([]), Recorder([]), []
    assert one == other
    numbers = [int(listener(each)) for each in (one, other, one, rows.append)]
    assert numbers[0] == numbers[2] != numbers[1] != numbers[3]
    # Python makes methods anew each time.
    assert int(listener(rows.append)) == numbers[3]


def test_who_fails_to_hear_of_progress_stops_the_solve():
    def broken(record):
        raise ZeroDivisionError(f"iteration {record['iteration']}")

    guess = jaxscp.straight_line(cart(), UNEVEN)
    with pytest.raises(jax.errors.JaxRuntimeError, match="iteration 1"):
        recorded(guess, broken)
    # Nothing is left in a state of its own.
    assert recorded(guess)[1] == interrupted()[1]


def test_progress_is_called_once_an_iteration():
    solution, records = interrupted()
    assert [int(record["iteration"]) for record in records] == [1, 2]
    for index, record in enumerate(records):
        assert set(record) == {"attempt", "iteration", *vars(solution.history)}
        assert int(record["attempt"]) == 0
        for name, values in vars(solution.history).items():
            assert float(record[name]) == float(values[index]), name


# Several guesses.


def late(problem):
    """A guess that takes longer."""
    return jaxscp.straight_line(problem, NODES, final_time=3.9)


def with_a_bad_guess(force=4.0):
    """A problem, a good guess, and one where the dynamics are not finite."""
    problem = cart(force, edges={"dynamics": -1.0})
    good = jaxscp.straight_line(problem, NODES)
    bad = eqx.tree_at(lambda guess: guess.states, good, good.states.at[1, 1].set(-90.0))
    return problem, good, bad


def test_one_guess_is_one_attempt():
    solution = converged()
    (attempt,) = solution.attempts
    assert bool(attempt.chosen)
    assert bool(attempt.converged)
    assert attempt.verified is None
    assert float(attempt.objective) == float(solution.objective)
    assert str(attempt) == f"{float(solution.objective):,.2f}, converged, chosen"


def test_a_guess_that_leads_nowhere_is_passed_over():
    problem, good, bad = with_a_bad_guess()
    solution = solve(problem, [bad, good], throw=True)
    first, second = solution.attempts
    assert bool(first.status == jaxscp.Status.non_finite)
    assert (bool(first.chosen), bool(second.chosen)) == (False, True)
    assert (first.verified, second.verified) == (None, True)
    alone = solve(problem, good)
    assert float(solution.objective) == float(alone.objective)
    np.testing.assert_array_equal(solution.trajectory.states, alone.trajectory.states)


def test_where_no_guess_converges_the_nearest_is_returned():
    problem = cart(travel=(5.0, 50.0))
    with pytest.raises(jaxscp.SolveError, match="travel misses its limit") as caught:
        solve(problem, [late(problem), jaxscp.straight_line(problem, NODES)], throw=True)
    solution = caught.value.solution
    missed = [float(attempt.violation) for attempt in solution.attempts]
    # The way is 3 m whatever one does.
    scale = float(solution.violations.scales[2]["travel"])
    np.testing.assert_allclose(missed, 2.0 / scale, rtol=1e-3)
    chosen = [bool(attempt.chosen) for attempt in solution.attempts]
    assert chosen.index(True) == np.argmin(missed)
    assert sum(chosen) == 1


def test_other_guesses_compile_nothing():
    def both(force):
        problem = cart(force)
        return solve(problem, (jaxscp.straight_line(problem, NODES), late(problem)))

    first = both(4.0)
    with compilations() as compiled:
        second = both(3.5)
    assert not compiled
    for attempt in (*first.attempts, *second.attempts):
        assert bool(attempt.converged)


def test_traced_solves_are_judged_by_how_they_ended():
    @eqx.filter_jit
    def traced(force):
        problem, good, bad = with_a_bad_guess(force)
        return jaxscp.solve(problem, [bad, good])

    inside = traced(jnp.asarray(4.0))
    problem, good, bad = with_a_bad_guess()
    outside = solve(problem, [bad, good])
    np.testing.assert_allclose(
        inside.trajectory.states, outside.trajectory.states, rtol=1e-8, atol=1e-8
    )
    for mine, other in zip(inside.attempts, outside.attempts, strict=True):
        assert bool(mine.status == other.status)
        assert bool(mine.chosen) == bool(other.chosen)
        assert mine.verified is None
    with pytest.raises(RuntimeError, match="cannot be met within the limits"):
        jax.block_until_ready(traced(jnp.asarray(0.5)))


def test_progress_says_which_guess():
    guess = jaxscp.straight_line(cart(), UNEVEN)
    longer = jaxscp.straight_line(cart(), UNEVEN, final_time=3.9)
    _, records = recorded([guess, longer])
    seen = [(int(record["attempt"]), int(record["iteration"])) for record in records]
    assert seen == [(0, 1), (0, 2), (1, 1), (1, 2)]


# Which of several is the best.


@functools.cache
def cheap_and_dear() -> tuple[jaxscp.Solution, jaxscp.Solution]:
    """Both converge; the longer way takes more effort."""
    return solve(cart(goal=2.0), throw=True), converged()


def astray(solution) -> jaxscp.Solution:
    """The same with a node moved by a metre: no integrator gets there."""
    return eqx.tree_at(
        lambda solution: solution.trajectory.states,
        solution,
        solution.trajectory.states.at[2, 0].add(1.0),
    )


def stopped(solution, violation) -> jaxscp.Solution:
    """The same, interrupted that far from being feasible."""
    status = jaxscp.Status.iteration_limit
    (attempt,) = solution.attempts
    missed = jnp.asarray(violation)
    attempt = dataclasses.replace(attempt, status=status, violation=missed)
    return dataclasses.replace(solution, status=status, attempts=(attempt,))


def verdicts(*solutions):
    """Of each: whether it is verified, and whether it is chosen and returned."""
    solution = best(solutions)
    chosen = [bool(attempt.chosen) for attempt in solution.attempts]
    returned = solutions[chosen.index(True)]
    assert float(solution.objective) == float(returned.objective)
    np.testing.assert_array_equal(solution.trajectory.states, returned.trajectory.states)
    verified = [attempt.verified for attempt in solution.attempts]
    return list(zip(verified, chosen, strict=True))


def test_the_cheapest_is_chosen_and_the_others_are_not_verified():
    cheap, dear = cheap_and_dear()
    assert verdicts(dear, cheap, dear) == [(None, False), (True, True), (None, False)]


def test_what_does_not_verify_gives_way():
    cheap, dear = cheap_and_dear()
    assert verdicts(astray(cheap), dear) == [(False, False), (True, True)]


def test_where_nothing_verifies_the_cheapest_is_chosen():
    cheap, dear = cheap_and_dear()
    assert verdicts(astray(dear), astray(cheap)) == [(False, False), (False, True)]


def test_what_converged_goes_before_what_is_cheaper():
    cheap, dear = cheap_and_dear()
    assert verdicts(stopped(cheap, 1e-3), dear) == [(None, False), (True, True)]


@pytest.mark.parametrize(
    ("missed", "chosen"), [((0.1, 0.2), 0), ((0.2, 0.1), 1), ((np.nan, 0.1), 1)]
)
def test_without_convergence_the_nearest_is_chosen(missed, chosen):
    both = (stopped(s, m) for s, m in zip(cheap_and_dear(), missed, strict=True))
    expected = [(None, index == chosen) for index in range(2)]
    assert verdicts(*both) == expected


class HoldOfOnesOwn(jaxscp.ZeroOrderHold):
    """Not one that `verify` knows."""


def test_under_a_hold_that_verify_does_not_know_the_cheapest_is_chosen():
    other = jaxscp.Discretization(HoldOfOnesOwn())
    cheap, dear = (dataclasses.replace(s, discretization=other) for s in cheap_and_dear())
    assert verdicts(dear, cheap) == [(None, False), (None, True)]


def test_an_attempt_is_a_line():
    cheap, dear = cheap_and_dear()
    objective = f"{float(cheap.objective):,.2f}"
    attempts = best([cheap, dear]).attempts
    assert str(attempts[0]) == f"{objective}, converged, verified, chosen"
    assert str(attempts[1]) == f"{float(dear.objective):,.2f}, converged"
    (attempt,) = stopped(cheap, 0.25).attempts
    line = f"{objective}, iteration_limit, misses a limit by 2.5e-01, chosen"
    assert str(attempt) == line


# Resampling.


@pytest.mark.parametrize("which", ["zero-order", "first-order"])
def test_samples(which):
    solution = converged() if which == "zero-order" else interrupted()[0]
    # As exact as the solve was: its tolerance is of the states' scales.
    exactness = 3e-5 if which == "zero-order" else 1e-8
    nodes = solution.trajectory
    times = np.asarray(nodes.times)
    hold = solution.discretization.hold

    at_nodes = solution.sample(times)
    np.testing.assert_allclose(at_nodes.times, times, rtol=1e-12)
    np.testing.assert_allclose(at_nodes.states[:-1], nodes.states[:-1], atol=1e-12)
    np.testing.assert_allclose(at_nodes.controls, nodes.controls, atol=1e-12)

    shares = np.array([0.2, 0.5, 0.9])
    inner = times[:-1, None] + np.diff(times)[:, None] * shares
    between = solution.sample(inner.ravel())
    states = np.asarray(between.states).reshape(NODES - 1, 3, 2)
    controls = np.asarray(between.controls).reshape(NODES - 1, 3, 1)
    left, right = np.asarray(nodes.controls[:-1]), np.asarray(nodes.controls[1:])
    if which == "zero-order":
        expected = np.broadcast_to(left[:, None], controls.shape)
    else:
        expected = left[:, None] + shares[:, None] * (right - left)[:, None]
    np.testing.assert_allclose(controls, expected, atol=1e-12)
    for k in range(NODES - 1):
        exact = flown(
            solution.problem,
            hold,
            *nodes.controls[k : k + 2],
            np.asarray(nodes.states[k]),
            *times[k : k + 2],
            inner[k],
        )
        np.testing.assert_allclose(states[k], exact, atol=max(exactness, 1e-6))


def test_the_last_sample_closes_the_flight():
    solution = converged()
    end = solution.sample(solution.trajectory.final_time[None])
    # But for the defect that was allowed.
    np.testing.assert_allclose(end.states[0], [GOAL, 0], atol=1e-4)


@pytest.mark.parametrize("moments", [[-0.1, 1.0], [1.0, 4.1]])
def test_samples_outside_the_flight(moments):
    with pytest.raises(ValueError, match=r"^times from .*: the flight lasts .* 0 to 4 s"):
        converged().sample(np.array(moments))


def in_a_line(*limits, **options):
    problems = [cart(travel=(0.0, limit)) for limit in limits]
    return jaxscp.continuation(problems, nodes=NODES, **options)


def test_each_starts_from_the_one_before():
    converged()
    with compilations() as compiled:
        first, second = jaxscp.continuation([cart(), cart(force=3.9)], nodes=NODES)
    assert not compiled
    assert_allclose(first.objective, converged().objective, rtol=1e-12)
    direct = solve(cart(force=3.9), first.trajectory)
    assert eqx.tree_equal(second.trajectory, direct.trajectory)
    # Nothing but the number of steps tells where it started.
    assert steps(second) < steps(first)


def test_what_fails_on_the_way_is_no_start():
    # The integral of speed is the way, 3 m: the second cannot be.
    first, second, third = in_a_line(50.0, 2.75, 50.0)
    assert bool(first.converged)
    assert bool(second.status == jaxscp.Status.virtual_buffer_remains)
    assert eqx.tree_equal(third.trajectory, solve(cart(), first.trajectory).trajectory)


def test_only_the_last_failure_raises():
    solutions = in_a_line(2.75, 50.0)
    assert [bool(solution.converged) for solution in solutions] == [False, True]
    with pytest.raises(jaxscp.SolveError, match="travel misses its limit"):
        in_a_line(50.0, 2.75)
    assert not bool(in_a_line(50.0, 2.75, throw=False)[-1].converged)
    with pytest.raises(ValueError, match=r"problems=\(\): give at least one\."):
        in_a_line()


@pytest.fixture
def in_steps(monkeypatch):
    """Missions' solves without the solving: the first fails, the line's end as told."""
    asked = []
    failed = solve(cart(travel=(0.0, 2.75)))

    def given(ends_well):
        last = converged() if ends_well else failed

        def fake(problems, guess, **settings):
            asked.append((problems, guess))
            assert settings.pop("throw") is False
            return failed, last

        monkeypatch.setattr(missions, "solve_problem", lambda *_, **__: failed)
        monkeypatch.setattr(missions, "continuation", fake)
        return asked

    return given


def test_data_that_cannot_be_sent_at_once_rise_in_steps(in_steps):
    asked = in_steps(ends_well=True)
    mission = missions.get("free-space-30MB-60dB")
    solution = missions.solve(mission, nodes=20)
    ((problems, guess),) = asked
    required = [float(each.integrals["data"].bounds.lower) for each in problems]
    assert_allclose(required, 2.4e8 * np.array([0.25, 0.5, 0.75, 1.0]))
    last, whole = (
        jax.tree.leaves(eqx.filter(each, eqx.is_array))
        for each in (problems[-1], mission.problem())
    )
    for ours, plain in zip(last, whole, strict=True):
        assert_allclose(ours, plain, rtol=0)
    assert_allclose(guess.fractions, mission.guess(20).fractions)
    assert float(guess.final_time) < float(mission.guess(20).final_time)
    assert bool(solution.converged)
    assert [bool(each.converged) for each in solution.attempts] == [False, True]
    assert [bool(each.chosen) for each in solution.attempts] == [False, True]


def test_where_steps_do_not_help_either_the_first_solution_is_told(in_steps):
    in_steps(ends_well=False)
    mission = missions.get("free-space-30MB-60dB")
    with pytest.raises(jaxscp.SolveError, match="travel misses its limit") as raised:
        missions.solve(mission, nodes=20)
    attempts = raised.value.solution.attempts
    assert [bool(each.chosen) for each in attempts] == [True, False]


def test_missions_without_data_have_no_steps(in_steps):
    asked = in_steps(ends_well=True)
    solution = missions.solve(missions.get("free-flight"), nodes=20, throw=False)
    assert not bool(solution.converged)
    assert not asked


def test_a_solution_is_a_guess():
    solution = converged()
    again = solve(cart(), solution)
    assert again.objective == pytest.approx(float(solution.objective), rel=1e-9)
    assert steps(again) <= steps(solution)


def test_a_number_that_is_mapped_over_may_not_be_captured():
    def effort(drag):
        problem = cart()
        dynamics = lambda t, x, u: jnp.stack([x[1], u[0] - drag * x[1]])  # noqa: E731
        problem = eqx.tree_at(lambda p: p.dynamics, problem, dynamics)
        return solve(problem).objective

    with pytest.raises(ValueError, match=r"captured 'drag', over which jax.vmap maps"):
        jax.vmap(effort)(jnp.asarray([0.1, 0.2]))
