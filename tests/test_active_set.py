"""Steps from a guess of the active constraints against those of the QP solver."""

import dataclasses
import functools
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from by_hand import motion
from jax.flatten_util import ravel_pytree
from numpy.testing import assert_allclose
from past_a_disc import (
    FRACTIONS,
    Parts,
    damping_of,
    dense,
    drawn,
    flat,
    held_damping_of,
    of_limits,
    predict,
    prepare,
    prices_for,
    quick_jit,
    solve,
    transcribed,
)

from jaxscp import Bounds, OptimalControlProblem
from jaxscp._active_set import NewtonStep, active_set_step, active_sides
from jaxscp._damping import Damping
from jaxscp._layout import Structure
from jaxscp._model import Model
from jaxscp._peaks import Watch
from jaxscp._problem import Integral
from jaxscp._qp import PIQP
from jaxscp._subproblem import SubproblemSolution
from jaxscp._subproblem_data import Limits
from jaxscp._transcription import Derivatives, Variables

PRECISION = 1e-11


@quick_jit
def compiled_step(model, metric, limits, last, weight, longest, heaviest):
    return active_set_step(
        model,
        metric,
        limits,
        Watch.of(hurried()),
        NewtonStep.begun(last, weight),
        jnp.asarray(PRECISION),
        longest=longest,
        heaviest=heaviest,
        slack=0.0,
    )


def newton_step(model, metric, limits, last, weight=1.0, longest=np.inf, heaviest=0.0):
    # Python's numbers would each be compiled for themselves.
    numbers = (jnp.asarray(number, float) for number in (weight, longest, heaviest))
    return compiled_step(model, metric, limits, last, *numbers)


def step_from(*args):
    return newton_step(*args).solution


class Power(eqx.Module):
    limit: jax.Array

    def __call__(self, t, x, u):
        return x[1] + 0.3 * u[0] - self.limit


def hurried(
    limit=0.8, longest=5.0, way=0.0, power=2.0, push=1.5
) -> OptimalControlProblem:
    """One metre along a line, from rest to rest.

    - `limit`: of the speed [m/s]. `push`: of the acceleration [m/s^2].
    - `longest`: flight time allowed [s]. `way`: integral of the position asked for [m s].
    - `power`: limit of what speed and acceleration make together.
    """
    return motion(
        state=Bounds([-2.0, -limit], [2.0, limit]),
        control=Bounds([-push], [push]),
        final_state=Bounds.exactly([1.0, 0.0]),
        final_time=Bounds(1.0, longest),
        running_cost=cost,
        path_constraints={"power": Power(jnp.asarray(power))},
        integrals={"way": Integral(position, Bounds.at_least(way))},
    )


def cost(t, x, u):
    return u[0] ** 2 + 0.5


def position(t, x, u):
    return x[0]


def subproblem(name: str, *limits: float) -> tuple[Structure, Parts]:
    """Around a smooth motion that takes three seconds."""
    transcription = transcribed(hurried(*limits), name)
    s = jnp.asarray(FRACTIONS)
    there = Variables(
        jnp.stack([s**2 * (3.0 - 2.0 * s), 1.2 * s * (1.0 - s)], axis=1),
        (1.0 - 2.0 * s)[: transcription.control_nodes, None],
        jnp.asarray(3.0, float),
    )
    parts = prepare(transcription, there, transcription.no_multipliers)
    return Structure.of(transcription), parts


class Case(NamedTuple):
    model: Model
    damping: Damping
    limits: Limits
    solution: SubproblemSolution


def gentle(model: Model) -> Damping:
    return damping_of(model, 0.5)


def heavier(weight: jax.Array, model: Model) -> Damping:
    return gentle(model).times(weight)


def solved(structure: Structure, parts: Parts, damping: Damping) -> Case:
    model, limits, prices = parts.model, parts.limits, prices_for(structure, relax=0.0)
    solution = solve(structure, PIQP(), model, damping, prices, limits)
    assert bool(solution.effort.solved)
    return Case(model, damping, limits, solution)


def check_same(found: SubproblemSolution, expected: SubproblemSolution, atol=1e-7):
    assert bool(found.effort.solved)
    assert_allclose(flat(found.step), flat(expected.step), atol=atol)
    size = max(1.0, *(np.max(np.abs(x), initial=0.0) for x in multipliers_of(expected)))
    for one, other in zip(*map(multipliers_of, (found, expected)), strict=True):
        assert_allclose(one, other, atol=atol * size)


def multipliers_of(solution: SubproblemSolution) -> list[np.ndarray]:
    own = solution.multipliers
    each = (own.dynamics, own.path, own.between, own.integral, of_limits(solution))
    return [np.asarray(part) for part in each]


def counted_from(case: Case, s: Variables) -> Case:
    """The same subproblem, its step counted from another one."""
    model, limits, told = case.model, case.limits, dense(case.model)
    slope = ravel_pytree(s)[1](jnp.asarray(told.g + told.H @ flat(s)))
    near = Model(predict(model, s), with_slope(model.derivatives, slope), model.curvature)
    shifted = dataclasses.replace(
        limits,
        state=tuple(end - s.states for end in limits.state),
        control=tuple(end - s.controls for end in limits.control),
        time=tuple(end - s.final_time for end in limits.time),
    )
    centre = jax.tree.map(jnp.subtract, case.damping.centre, s)
    damping = dataclasses.replace(case.damping, centre=centre)
    return case._replace(model=near, damping=damping, limits=shifted)


def with_slope(derivatives: Derivatives, slope: Variables) -> Derivatives:
    """With another gradient of the cost, left ends first."""
    growth, intervals = derivatives.intervals.increments, len(slope.states) - 1
    right = growth.right_control
    if right is not None:
        right = right.at[:, -1].set(0.0).at[-1, -1].set(slope.controls[-1])
    growth = dataclasses.replace(
        growth,
        left_state=growth.left_state.at[:, -1].set(slope.states[:-1]),
        left_control=growth.left_control.at[:, -1].set(slope.controls[:intervals]),
        time=growth.time.at[:, -1].set(0.0),
        right_control=right,
    )
    return Derivatives(
        dataclasses.replace(derivatives.intervals, increments=growth),
        dataclasses.replace(
            derivatives.nodes,
            terminal_state=slope.states[-1],
            terminal_time=slope.final_time,
        ),
    )


# What is active: limits of what together, as `hurried` takes them.
CASES = {
    "power": ("zero-order", (0.59, 3.08, 1.15, 0.41, 1.28)),
    "speed": ("zero-order", (0.43, 3.03, 0.98, 0.55, 0.92)),
    "push": ("zero-order", (0.79, 2.6, 1.12, 0.74, 0.79)),
    "way": ("zero-order", (0.72, 2.99, 1.81, 0.67, 1.19)),
    "power between": ("first-order-between", (0.62, 3.07, 1.02, 0.44, 0.98)),
    "push and way": ("first-order-between", (0.61, 2.46, 1.23, 0.61, 0.81)),
    "all of them": ("first-order-between", (0.51, 3.11, 1.37, 0.52, 0.82)),
    "speed between": ("first-order-between", (0.49, 2.93, 1.33, 0.71, 0.95)),
}
every_case = pytest.mark.parametrize("case", CASES)


@functools.cache
def case_of(case: str, damping_of=gentle) -> Case:
    """A subproblem and its solution."""
    name, limits = CASES[case]
    structure, parts = subproblem(name, *limits)
    return solved(structure, parts, damping_of(parts.model))


def active_in(case: Case) -> set[str]:
    """What kinds of constraints have multipliers."""
    solution = case.solution
    own, peaks = solution.multipliers, solution.multipliers.between.reshape(5, -1)
    kinds = {
        "power": own.path,
        "speed": solution.state[1:-1],
        "push": solution.control,
        "way": own.integral,
        "power between": peaks[:, 4:],
        "speed between": peaks[:, :4],
    }
    sizes = {kind: np.max(np.abs(each), initial=0.0) for kind, each in kinds.items()}
    assert all(size < 1e-6 or size > 1e-3 for size in sizes.values())
    return {kind for kind, size in sizes.items() if size > 1e-3}


def test_each_case_is_worth_its_name():
    found = {case: active_in(case_of(case)) for case in CASES}
    together = {"push", "way", "power", "power between"}
    expected = {case: {case} for case in CASES}
    expected |= {"push and way": {"push", "way"}, "all of them": together}
    assert found == expected | {"power between": {"power", "power between"}}


def check_next_to(case: Case, aside: float, seed=0, **tolerance):
    """From a point a little aside of a solution, with its multipliers."""
    draw = np.random.default_rng(seed).normal
    from_there = jax.tree.map(
        lambda leaf: leaf + aside * jnp.asarray(draw(size=leaf.shape)), case.solution.step
    )
    near = counted_from(case, from_there)
    found = step_from(near.model, near.damping, near.limits, case.solution)
    back = jax.tree.map(jnp.add, found.step, from_there)
    check_same(dataclasses.replace(found, step=back), case.solution, **tolerance)


@pytest.mark.parametrize("aside", [0.0, 1e-3])
@every_case
def test_next_to_a_solution_it_finds_it(case, aside):
    check_next_to(case_of(case), aside)


@every_case
def test_other_squares_are_damped_too(case):
    """Those of constraints, and of a step counted from elsewhere."""
    check_next_to(case_of(case, held_damping_of), 1e-3)


def weakened(model: Model, factor: float) -> Model:
    """With path constraints in another unit."""

    def path(model):
        at = model.derivatives.nodes
        return [model.residuals.path, at.path_state, at.path_control, at.path_time]

    return eqx.tree_at(path, model, [factor * block for block in path(model)])


def test_constraints_that_hardly_give_way():
    """Squares alone would leave a gap that closes too slowly."""
    name, limits = CASES["power"]
    structure, parts = subproblem(name, *limits)
    model = weakened(parts.model, 0.01)
    weak = solved(structure, parts._replace(model=model), gentle(model))
    assert np.max(weak.solution.multipliers.path) > 30.0
    check_next_to(weak, 1e-3)


def test_it_takes_no_qp():
    case = case_of("push")
    found = step_from(case.model, case.damping, case.limits, case.solution)
    check_same(found, case.solution)
    effort = found.effort
    assert (int(effort.solves), int(effort.iterations)) == (0, 0)
    assert float(effort.seconds) == 0.0
    assert not bool(effort.infeasible)
    assert not bool(effort.relaxed)


@pytest.mark.parametrize("heaviest", [0.0, 100.0])
@every_case
def test_a_wrong_guess_is_mended_or_refused(case, heaviest):
    """Never taken for a solution; a gap may remain of multipliers that are far off."""
    name, case, mended = case, case_of(case), 0
    for seed in range(20):
        draw = np.random.default_rng(seed)
        size = 10.0 ** draw.uniform(-2.0, 1.5)
        wrong = drawn(functools.partial(draw.normal, 0.0, size), case.solution)
        wrong = dataclasses.replace(wrong, effort=case.solution.effort)
        parts = (case.model, case.damping, case.limits, wrong)
        found = newton_step(*parts, heaviest=heaviest)
        if bool(found.found):
            right, weight = case.solution, found.weight
            # Where a wrong guess looked like a saddle the weight may be another one.
            if float(weight) != 1.0:
                assert float(weight) <= heaviest
                right = case_of(name, functools.partial(heavier, weight)).solution
            check_same(found.solution, right, atol=1e-6)
            mended += 1
    assert mended < 20


def bent(case: Case, node: int, entry: int, by: float) -> Model:
    """With other curvature by one entry of (x, u) at a node."""
    curvature = case.model.curvature
    blocks = curvature.blocks.at[node, entry, entry].add(by)
    curvature = dataclasses.replace(curvature, blocks=blocks)
    return dataclasses.replace(case.model, curvature=curvature)


def test_convexity_is_needed_along_active_constraints_only():
    case = case_of("push")
    near = counted_from(case, case.solution.step)
    pushed = np.abs(np.ravel(case.solution.control)) > 1e-3
    at_limit, free = np.flatnonzero(pushed)[0], np.flatnonzero(~pushed)[0]
    # The control is the third entry of a node's block.
    held = bent(near, at_limit, 2, -10.0)
    found = step_from(held, near.damping, near.limits, case.solution)
    still = jax.tree.map(jnp.zeros_like, found.step)
    check_same(found, dataclasses.replace(case.solution, step=still))
    loose = bent(near, free, 2, -10.0)
    parts = (loose, near.damping, near.limits, case.solution)
    found = newton_step(*parts, heaviest=np.inf)
    assert bool(found.found)
    # It takes a narrower trust region, no narrower than it must be.
    assert float(found.weight) > 1.0
    light = float(found.weight) / 4.0
    assert float(newton_step(*parts, weight=light, heaviest=np.inf).weight) > light
    # ... nor than it may be.
    assert not bool(newton_step(*parts, heaviest=0.5 * float(found.weight)).found)


@pytest.mark.parametrize(
    ("multiplier", "stays", "becomes"),
    [
        (2e-3, True, True),
        (5e-4, True, False),
        (-5e-4, True, False),
        (-2e-3, False, False),
    ],
)
def test_what_is_active_stays_unless_it_is_wrong(multiplier, stays, becomes):
    """A multiplier within the precision is no reason to change anything."""
    case, precision = case_of("push"), 1e-3
    step = case.solution.step
    after = case.model.linear(step)
    settled = active_sides(after, case.limits, case.solution, step, precision)
    node = np.flatnonzero(np.ravel(settled.variables.controls) > 0.0)[0]
    told = eqx.tree_at(
        lambda s: s.control, case.solution, case.solution.control.at[node].set(multiplier)
    )
    at = (after, case.limits, told, step, precision)
    there = [active_sides(*at, held=settled), active_sides(*at)]
    sides = [float(each.variables.controls[node, 0]) for each in there]
    assert sides == [float(stays), float(becomes)]


@pytest.mark.parametrize("share", [0.5, 0.1])
def test_steps_are_as_long_as_they_may_be(share):
    # From a feasible point, where the shortest step is none.
    case = case_of("push")
    near, start = counted_from(case, case.solution.step), case.solution
    free = (near.model, gentle(near.model), near.limits, start)
    whole = newton_step(*free)
    assert bool(whole.found)
    longest = share * float(whole.length)
    found = newton_step(*free, longest=longest, heaviest=np.inf)
    assert bool(found.found)
    assert float(found.weight) > 1.0
    assert 0.3 * longest < float(found.length) <= 1.2 * longest
