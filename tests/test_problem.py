"""`OptimalControlProblem` as a PyTree, and the holds."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxscp._bounds import Bounds
from jaxscp._hold import FirstOrderHold, ZeroOrderHold
from jaxscp._problem import Integral, OptimalControlProblem


class Drag(eqx.Module):
    coefficient: jax.Array

    def __call__(self, t, x, u):
        return jnp.stack([x[1], u[0] - self.coefficient * x[1]])


class Work(eqx.Module):
    price: jax.Array

    def __call__(self, t, x, u):
        return self.price * x[1] * u[0]


def sledge(coefficient=0.5, price=2.0) -> OptimalControlProblem:
    return OptimalControlProblem(
        Drag(jnp.asarray(coefficient)),
        state=Bounds.free(2),
        control=Bounds(-jnp.ones(1), jnp.ones(1)),
        final_time=Bounds(1.0, 5.0),
        integrals={"work": Integral(Work(jnp.asarray(price)), Bounds(0.0, 9.0))},
        path_constraints={"wall": lambda t, x, u: x[:1] - 3.0},
        units={"work": "J", "wall": "m", "x[1]": "m/s"},
    )


def test_what_is_left_out_is_free_and_costs_nothing():
    problem = sledge()
    assert not problem.initial_state.is_fixed.any()
    np.testing.assert_array_equal(problem.final_state.upper, [np.inf, np.inf])
    t, x, u = jnp.asarray(1.0), jnp.ones(2), jnp.ones(1)
    for cost in (problem.running_cost(t, x, u), problem.terminal_cost(t, x)):
        assert cost.shape == ()
        assert cost == 0.0


def test_names_and_units():
    problem = sledge()
    assert (problem.state_size, problem.control_size) == (2, 1)
    assert problem.state_names == ("x[0]", "x[1]")
    assert problem.control_names == ("u[0]",)
    assert problem.unit("work") == "J"
    assert problem.unit("x[1]") == "m/s"
    assert problem.unit("unheard of") == ""


def test_every_inexact_array_is_a_parameter():
    def speed(problem):
        t, x, u = jnp.asarray(0.0), jnp.array([0.0, 3.0]), jnp.ones(1)
        work = problem.integrals["work"]
        total = problem.dynamics(t, x, u)[1] + work.integrand(t, x, u)
        return total + work.bounds.upper

    gradient = eqx.filter_grad(speed)(sledge())
    assert gradient.dynamics.coefficient == -3.0
    assert gradient.integrals["work"].integrand.price == 3.0
    assert gradient.integrals["work"].bounds.upper == 1.0
    np.testing.assert_array_equal(gradient.control.upper, [0.0])


def test_new_parameter_values_compile_nothing():
    traces = []

    @eqx.filter_jit
    def evaluate(problem):
        traces.append(None)
        return problem.dynamics(jnp.asarray(0.0), jnp.ones(2), jnp.ones(1))

    # The wall is one function: another lambda would be another problem.
    problem = sledge()
    for coefficient in (0.5, 0.7, 0.9):
        changed = eqx.tree_at(
            lambda p: p.dynamics.coefficient, problem, jnp.asarray(coefficient)
        )
        evaluate(changed)
    assert len(traces) == 1


def test_the_given_dictionaries_are_not_kept():
    constraints = {"wall": lambda t, x, u: x}
    problem = OptimalControlProblem(
        Drag(jnp.asarray(0.0)),
        state=Bounds.free(2),
        control=Bounds.free(1),
        final_time=Bounds.exactly(1.0),
        path_constraints=constraints,
    )
    constraints.clear()
    assert list(problem.path_constraints) == ["wall"]


def test_a_problem_survives_flattening():
    problem = sledge()
    leaves, structure = jax.tree.flatten(problem)
    again = jax.tree.unflatten(structure, leaves)
    assert again.units == problem.units
    assert eqx.tree_equal(again, problem)


@pytest.mark.parametrize(
    ("hold", "free", "middle"),
    [(ZeroOrderHold(), 9, [1.0, 2.0]), (FirstOrderHold(), 10, [1.5, 4.0])],
)
def test_holds(hold, free, middle):
    assert hold.control_nodes(10) == free
    left, right = jnp.array([1.0, 2.0]), jnp.array([3.0, 10.0])
    at = [hold.interpolate(left, right, jnp.asarray(f)) for f in (0.0, 0.25, 1.0)]
    np.testing.assert_allclose(at[0], left)
    np.testing.assert_allclose(at[1], middle)
    np.testing.assert_allclose(at[2], left if free == 9 else right)
