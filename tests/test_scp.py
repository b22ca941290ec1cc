"""The paper's theorems as properties of both methods, seen step by step.

A point mass flies around a disc in free time and must cover a distance integral: every
kind of constraint the methods treat, small enough to compile fast.
"""

import dataclasses
import itertools
import math
import re

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxscp
from jaxscp import Bounds, Integral, OptimalControlProblem
from jaxscp._constraints import integral_limits, violations, worst_violation
from jaxscp._merit import ExactPenalty
from jaxscp._scp import run
from jaxscp._state import SCPState
from jaxscp._status import Status
from jaxscp._transcription import Transcription, Variables

NODES = 12


def drift(t, x, u):
    # Nonlinear enough for defects: thrust fades with speed.
    return jnp.concatenate([x[2:], u / (1.0 + 0.1 * (x[2:] @ x[2:]))])


def effort(t, x, u):
    return u @ u + 0.1


def disc(t, x, u):
    return jnp.stack([1.0 - jnp.hypot(x[0] - 5.0, x[1] - 0.2)])


def height(t, x, u):
    return x[1]


PROBLEM = OptimalControlProblem(
    drift,
    running_cost=effort,
    state=Bounds([-20.0, -20.0, -4.0, -4.0], [20.0, 20.0, 4.0, 4.0]),
    control=Bounds([-2.0, -2.0], [2.0, 2.0]),
    initial_state=Bounds.exactly([0.0, 0.0, 0.0, 0.0]),
    final_state=Bounds.exactly([10.0, 0.0, 0.0, 0.0]),
    final_time=Bounds(4.0, 40.0),
    path_constraints={"disc": disc},
    integrals={"height": Integral(height, Bounds.at_least(-12.0))},
)
GUESS = jaxscp.straight_line(PROBLEM, NODES, final_time=10.0, control=[0.1, -0.1])
TRANSCRIPTION = Transcription(PROBLEM, jaxscp.Discretization(), GUESS.fractions)
METHODS = {
    "proximal": jaxscp.ProximalSCP(),
    "paper": jaxscp.PaperSCP(max_iterations=30, tolerance=1e-6),
}


def strongly_typed(state: SCPState) -> SCPState:
    """Python numbers leave weak types behind, for which a step would compile anew."""
    return jax.tree.map(lambda leaf: jnp.asarray(leaf, leaf.dtype), state)


@pytest.mark.parametrize(
    ("method", "settings", "named"),
    [
        (jaxscp.ProximalSCP, {"max_iterations": 0}, "max_iterations=0: give a whole"),
        (jaxscp.PaperSCP, {"max_failures": 0}, "max_failures=0: give a whole"),
        (jaxscp.ProximalSCP, {"max_polish": -1}, "max_polish=-1: give a whole"),
        (jaxscp.ProximalSCP, {"tolerance": 0.0}, "tolerance=0.0: give a positive"),
        (jaxscp.ProximalSCP, {"min_radius": math.nan}, "min_radius=nan: give a pos"),
        (jaxscp.ProximalSCP, {"initial_weight": -1.0}, "initial_weight=-1.0: give"),
        (jaxscp.PaperSCP, {"initial_radius": 0.0}, "initial_radius=0.0: need"),
        (jaxscp.PaperSCP, {"alpha": 1.0}, "alpha=1.0: need alpha > 1"),
    ],
)
def test_settings_that_make_no_sense(method, settings, named):
    with pytest.raises(ValueError, match=re.escape(named)):
        method(**settings)


def test_there_is_room_for_every_rejected_step():
    problem = OptimalControlProblem(
        lambda t, x, u: jnp.stack([x[1], u[0] + 20.0 * jnp.sin(5.0 * x[0])]),
        running_cost=lambda t, x, u: u @ u,
        state=Bounds.free(2, scale=[1.0, 1.0]),
        control=Bounds.free(1, scale=[1.0]),
        initial_state=Bounds.exactly([0.0, 0.0]),
        final_state=Bounds.exactly([6.0, 0.0]),
        final_time=Bounds.exactly(2.0),
    )
    method = jaxscp.PaperSCP(max_iterations=2, initial_radius=1e5)
    told = []
    solution = jaxscp.solve(
        problem, method=method, nodes=6, throw=False, progress=told.append
    )
    jax.effects_barrier()
    accepted = np.asarray(solution.history.accepted)
    # Where the model is so wrong most steps are refused.
    assert np.sum(accepted == 0.0) > 4 * method.max_iterations
    assert np.sum(accepted == 1.0) == solution.statistics.iterations == 2
    assert [row["iteration"] for row in told] == list(range(1, len(told) + 1))
    assert len(told) == np.sum(np.isfinite(accepted))


@eqx.filter_jit
def begin(method, transcription) -> SCPState:
    return strongly_typed(method.init(transcription, transcription.variables(GUESS)))


@eqx.filter_jit
def step(method, transcription, state) -> SCPState:
    return strongly_typed(method.step(transcription, state))


@eqx.filter_jit
def ended(method, transcription, state):
    return method.terminate(transcription, state)


@pytest.fixture(scope="module", params=METHODS, ids=str)
def states(request):
    """The method and every state from the first to the last."""
    method = METHODS[request.param]
    state = begin(method, TRANSCRIPTION)
    states = [state]
    while not bool(ended(method, TRANSCRIPTION, state)[0]):
        state = step(method, TRANSCRIPTION, state)
        states.append(state)
    return method, states


def history(states):
    _, every = states
    count = int(every[-1].records)
    return {
        name: np.asarray(values)[:count]
        for name, values in vars(every[-1].history).items()
    }


def test_stepping_by_hand_is_the_loop(states):
    method, every = states
    guess = TRANSCRIPTION.variables(GUESS)
    looped, status = eqx.filter_jit(run)(method, TRANSCRIPTION, guess)
    assert int(looped.iterations) == int(every[-1].iterations)
    assert int(looped.polish) == int(every[-1].polish)
    assert bool(status == ended(method, TRANSCRIPTION, every[-1])[1])
    # As exactly as the QP solver's tolerance allows.
    np.testing.assert_allclose(
        looped.iterate.variables.states, every[-1].iterate.variables.states, atol=1e-6
    )


def test_ends_feasible(states):
    method, every = states
    limits = integral_limits(TRANSCRIPTION, every[-1].scaling)
    polishes = isinstance(method, jaxscp.ProximalSCP)
    allowed = method.tolerance if polishes else 1e-4
    assert float(worst_violation(every[-1].iterate.residuals, limits)) < allowed
    # And the guess was not: the disc stands in the way.
    assert float(jnp.max(disc(0.0, GUESS.states[6], None))) > 0.3


def test_only_the_proximal_method_ends_optimal(states):
    """The paper's criterion knows nothing of the optimality conditions."""
    method, every = states
    _, status = ended(method, TRANSCRIPTION, every[-1])
    if isinstance(method, jaxscp.ProximalSCP):
        assert bool(status == Status.converged)
        assert float(every[-1].optimality) <= 1e-8
        assert int(every[-1].polish) > 0
    else:
        assert bool(status == Status.converged_roughly)
        assert int(every[-1].polish) == 0


@pytest.mark.parametrize(
    ("residual", "expected"),
    [
        (np.inf, Status.converged_roughly),  # unknown
        (0.9, Status.converged_roughly),
        (1.1, Status.stalled),
        (1e6, Status.stalled),
    ],
)
def test_far_from_optimal_is_not_even_roughly_converged(states, residual, expected):
    method, every = states
    last = dataclasses.replace(
        every[-1],
        stationary=jnp.array(True),
        optimality=jnp.asarray(residual),
        radius=jnp.asarray(1.0),
    )
    done, status = ended(method, TRANSCRIPTION, last)
    assert bool(done)
    assert bool(status == expected)


def test_predicted_reduction_is_never_negative(states):
    """Theorem 1, but for the QP solver's tolerance."""
    seen = history(states)
    assert (seen["predicted_reduction"] >= -1e-7 * seen["penalized_cost"]).all()


def test_acceptance_never_raises_the_penalized_cost(states):
    """Theorem 3's first step: each accepted step lowers the cost it was judged by."""
    seen = history(states)
    accepted = seen["accepted"] == 1
    assert accepted.any()
    assert (seen["actual_reduction"][accepted] >= 0).all()
    assert not (
        seen["actual_reduction"][accepted]
        < 0.01 * seen["predicted_reduction"][accepted] - 1e-12
    ).any()


def test_rejection_stays_and_shrinks(states):
    _, every = states
    for before, after in itertools.pairwise(every):
        if int(after.records) == int(before.records):
            continue  # the last look finds nothing left to do
        record = jax.tree.map(lambda h, k=int(before.records): h[k], after.history)
        same = np.array_equal(
            before.iterate.variables.states, after.iterate.variables.states
        )
        assert same == (float(record.accepted) == 0)
        if float(record.ratio) < 0.25:
            assert float(after.radius) < float(before.radius)


def test_limits_hold_at_every_iterate(states):
    _, every = states
    for state in every:
        variables = state.iterate.variables
        low, high = TRANSCRIPTION.state_limits
        # Newton's steps leave a gap that falls with the residual they start from.
        residual = float(state.optimality)
        gap = 1e-6 * max(1.0, residual if np.isfinite(residual) else 0.0)
        assert float(jnp.max(low - variables.states)) < gap
        assert float(jnp.max(variables.states - high)) < gap
        assert float(jnp.max(jnp.abs(variables.controls))) < 2.0 + 1e-6


@pytest.mark.parametrize("name", METHODS)
def test_ratio_tends_to_one_as_the_radius_shrinks(name):
    """Theorem 2, at a point that is not stationary."""
    method = METHODS[name]
    start = begin(method, TRANSCRIPTION)
    # A few steps in: at the guess itself nothing is smooth in time, as all speeds are 0.
    for _ in range(2):
        start = step(method, TRANSCRIPTION, start)
    misses = []
    for radius in (1e-1, 1e-2, 1e-3, 1e-4):
        state = eqx.tree_at(
            lambda s: (s.radius, s.reach.weight),
            start,
            (jnp.asarray(radius, float), jnp.asarray(1.0 / radius)),
        )
        after = step(method, TRANSCRIPTION, state)
        misses.append(abs(1.0 - float(after.history.ratio[int(state.records)])))
    assert misses[-1] < 1e-2
    assert misses[-1] <= misses[0]


def test_a_stationary_point_predicts_nothing(states):
    """Theorem 1: the predicted reduction vanishes where the iteration ends."""
    method, _ = states
    seen = history(states)
    first, last = seen["predicted_reduction"][0], seen["predicted_reduction"][-1]
    if isinstance(method, jaxscp.ProximalSCP):
        assert last < 1e-6
    assert last < 1e-2 * first


def test_penalty_counts_each_violation_once():
    """The exact penalty by hand, from residuals of known size."""
    residuals = TRANSCRIPTION.evaluate(TRANSCRIPTION.variables(GUESS), 4)
    peaks = np.random.default_rng(0).normal(size=(NODES - 1, 5))
    residuals = eqx.tree_at(lambda r: r.between, residuals, jnp.asarray(peaks))
    limits = jnp.array([-1.0]), jnp.array([jnp.inf])
    broken = violations(residuals, limits)
    weights = jax.tree.map(jnp.ones_like, broken)
    total = float(jnp.sum(residuals.increments[:, 0]))
    expected = float(residuals.objective)
    expected += float(np.abs(np.asarray(residuals.defects)).sum())
    expected += float(np.maximum(np.asarray(residuals.path), 0).sum())
    expected += float(np.maximum(peaks, 0).sum())
    expected += max(-1.0 - total, 0.0)
    assert float(ExactPenalty(weights).cost(residuals, limits)) == pytest.approx(expected)


def test_paper_trust_region_holds_at_every_node():
    """Eq. 19 with infinity norms, in scaled variables."""
    method = METHODS["paper"]
    state = begin(method, TRANSCRIPTION)
    state = eqx.tree_at(lambda s: s.radius, state, jnp.asarray(0.05, float))
    taken: Variables = step(method, TRANSCRIPTION, state).solution.step
    size = jnp.max(jnp.abs(taken.states), axis=1) + jnp.abs(taken.final_time)
    size = size.at[:-1].add(jnp.max(jnp.abs(taken.controls), axis=1))
    assert float(jnp.max(size)) == pytest.approx(0.05, rel=1e-4)


@pytest.mark.parametrize(
    "settings", [{"rho_1": 0.8}, {"rho_0": 0.0}, {"alpha": 1.0}], ids=str
)
def test_paper_parameters_are_checked(settings):
    with pytest.raises(ValueError, match=next(iter(settings))):
        jaxscp.PaperSCP(**settings)
