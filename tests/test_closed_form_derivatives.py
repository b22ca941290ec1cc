"""Derivatives of optima that are known in closed form."""

import math

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from bank import hypersensitive_optimum, nodes_at

import jaxscp
from jaxscp import Bounds, Discretization, FirstOrderHold, textbook

LINEAR = Discretization(hold=FirstOrderHold())


def energy(distance, duration):
    problem = textbook.minimum_energy_double_integrator(distance, duration)
    return jaxscp.solve(problem, nodes=7, discretization=LINEAR)


@pytest.mark.slow
class TestClosedForms:
    """Where the hold is exact the discrete optimum is the true one."""

    def test_minimum_energy(self):
        """First derivatives, and second ones."""
        d, T = 1.3, 0.9

        def slopes(d, T):
            first = jax.grad(lambda d, T: energy(d, T).objective, (0, 1))(d, T)
            return first, first

        hessian, first = jax.jacfwd(slopes, (0, 1), has_aux=True)(d, T)
        assert first == pytest.approx((24 * d / T**3, -36 * d**2 / T**4), rel=1e-7)
        mixed = -72 * d / T**4
        expected = [[24 / T**3, mixed], [mixed, 144 * d**2 / T**5]]
        np.testing.assert_allclose(hessian, expected, rtol=1e-6)

    def test_trajectory_of_minimum_energy(self):
        """The acceleration 6 d (1 - 2 t / T) / T^2 and the position are linear in d, and
        the position's costate is constant: -24 d / T^3, the price of the way.
        """
        d, T = 1.3, 0.9

        def flight(d):
            solution = energy(d, T)
            flown = solution.trajectory
            prices = solution.multipliers.dynamics[:, 0]
            return flown.controls[:, 0], flown.states[:, 0], prices

        s = np.linspace(0, 1, 7)
        expected = 6 * (1 - 2 * s) / T**2, s**2 * (3 - 2 * s), np.full(6, -24 / T**3)
        for found, known in zip(jax.jacrev(flight)(d), expected, strict=True):
            np.testing.assert_allclose(found, known, rtol=1e-6, atol=1e-7)

    def test_transformed(self):
        """A batch is a loop; `jax.jit` changes nothing, inside or outside."""

        def effort(d):
            return jnp.sum(energy(d, 0.9).trajectory.controls ** 2)

        ways = jnp.array([1.3, 1.1, 2.0])
        loop = jnp.stack([jax.grad(effort)(d) for d in ways])
        gradient = jax.jit(jax.vmap(jax.grad(jax.jit(effort))))
        np.testing.assert_allclose(gradient(ways), loop, rtol=1e-9)

    def test_minimum_time(self):
        d, a = 1.3, 0.9

        def time(d, a):
            problem = textbook.minimum_time_double_integrator(d, a)
            return jaxscp.solve(problem, nodes=7)

        slopes = jax.grad(lambda d, a: time(d, a).trajectory.final_time, (0, 1))(d, a)
        T = 2 * math.sqrt(d / a)
        assert slopes == pytest.approx((T / (2 * d), -T / (2 * a)), rel=1e-6)

    def test_brachistochrone(self):
        """Slower by the root of gravity, on every grid."""

        def solved(gravity):
            problem = textbook.brachistochrone(gravity)
            return jaxscp.solve(problem, nodes=21, discretization=LINEAR)

        g = 9.81
        time, slope = jax.value_and_grad(lambda g: solved(g).trajectory.final_time)(g)
        assert float(slope) == pytest.approx(-float(time) / (2 * g), rel=1e-6)

    @pytest.mark.parametrize("limit", [0.3, 0.2501, 0.2499, 0.2, 0.1667, 0.1666, 1 / 9])
    def test_bryson_denham(self, limit):
        """On all three branches, and beside both changes of the active set."""
        nodes = nodes_at(limit)

        def cost(limit):
            problem = textbook.bryson_denham(limit)
            return jaxscp.solve(problem, nodes=nodes, discretization=LINEAR).objective

        slope = float(jax.grad(cost)(limit))
        if limit >= 1 / 4:
            expected = 0.0
        elif limit >= 1 / 6:
            expected = -48 * (1 - 4 * limit)
        else:
            expected = -4 / (9 * limit**2)
        assert slope == pytest.approx(expected, rel=1e-6, abs=1e-6)

    def test_hypersensitive_converges_with_the_grid(self):
        """By both ends: intervals half as long, a quarter of the error or less. They are
        as many in half of the time, where nothing has to be compiled anew.
        """

        def cost(ends, duration):
            problem = textbook.hypersensitive(duration)
            start, end = (Bounds.exactly(ends[i][None]) for i in (0, 1))
            problem = eqx.tree_at(
                lambda p: (p.initial_state, p.final_state), problem, (start, end)
            )
            return jaxscp.solve(problem, nodes=101, discretization=LINEAR).objective

        ends, step = jnp.array([1.5, 1.0]), 1e-6

        def known(duration):
            def optimum(move):
                return hypersensitive_optimum(*(ends + move), duration)

            return np.array(
                [
                    (optimum(move) - optimum(-move)) / (2 * step)
                    for move in step * np.eye(2)
                ]
            )

        errors = [np.abs(jax.grad(cost)(ends, T) - known(T)) for T in (10.0, 5.0)]
        assert np.all(errors[0] < 0.01)
        assert np.all(errors[1] < 0.27 * errors[0])


class TestRefusals:
    """Where there is no derivative, no number is returned in silence."""

    @staticmethod
    def pushed(mass):
        def dynamics(t, x, u):
            return jnp.stack([x[1], u[0] / mass])

        problem = textbook.minimum_energy_double_integrator()
        return eqx.tree_at(lambda p: p.dynamics, problem, dynamics)

    def test_a_number_a_function_captured(self):
        def cost(mass):
            return jaxscp.solve(self.pushed(mass), nodes=7).objective

        with pytest.raises(ValueError, match=r"dynamics captured 'mass'.*as a field"):
            jax.grad(cost)(2.0)

    @staticmethod
    def by_default(mass):
        def dynamics(t, x, u, mass=mass):
            return jnp.stack([x[1], u[0] / mass])

        return dynamics

    @staticmethod
    def compiled(mass):
        return jax.jit(lambda t, x, u: jnp.stack([x[1], u[0] / mass]))

    class Sledge:
        def __init__(self, mass):
            self.mass = mass

        def __call__(self, t, x, u):
            return jnp.stack([x[1], u[0] / self.mass])

    @pytest.mark.parametrize("made", [by_default, compiled, Sledge])
    def test_wherever_it_is_held(self, made):
        problem = textbook.minimum_energy_double_integrator()

        def cost(mass):
            changed = eqx.tree_at(lambda p: p.dynamics, problem, made(mass))
            return jaxscp.solve(changed, nodes=7).objective

        with pytest.raises(ValueError, match=r"dynamics captured 'mass'.*as a field"):
            jax.grad(cost)(2.0)

    @staticmethod
    def hurried(limit, method):
        """The flight time of a problem without a solution: there is too little time."""
        problem = textbook.minimum_time_double_integrator(1.0, limit)
        late = 0.6 * problem.final_time.upper / 5
        problem = eqx.tree_at(lambda p: p.final_time.upper, problem, late)
        solution = jaxscp.solve(problem, method=method, nodes=7, throw=False)
        return solution.trajectory.final_time

    @pytest.mark.parametrize(
        "method", [jaxscp.ProximalSCP(), jaxscp.PaperSCP()], ids=["default", "paper"]
    )
    def test_a_solution_that_is_not_polished(self, method):
        with pytest.raises(ValueError, match=r"derivatives need a solution of Prox"):
            jax.grad(self.hurried)(1.0, method)

    def test_a_solution_that_is_not_polished_by_its_grid(self):
        problem = textbook.minimum_energy_double_integrator()

        def middle(nodes):
            solution = jaxscp.solve(problem, method=jaxscp.PaperSCP(), nodes=nodes)
            return solution.trajectory.states[3, 0]

        with pytest.raises(ValueError, match=r"derivatives need a solution of Prox"):
            jax.grad(middle)(jnp.linspace(0.0, 1.0, 7))

    def test_a_solution_that_is_not_polished_under_jit(self):
        method = jaxscp.ProximalSCP()
        slope = jax.jit(jax.grad(lambda limit: self.hurried(limit, method)))(1.0)
        assert np.isnan(slope)

    def test_what_is_cut_off(self):
        """Numbers about the solve are no functions of the problem."""

        def effort(d):
            return energy(d, 0.9).history.objective[0] + energy(d, 0.9).optimality

        assert float(jax.grad(effort)(1.3)) == 0.0

    def test_the_guess_does_not_matter(self):
        problem = textbook.minimum_energy_double_integrator()
        guess = jaxscp.straight_line(problem, 7)

        def cost(guess):
            return jaxscp.solve(problem, guess, discretization=LINEAR).objective

        slopes = eqx.filter_grad(cost)(guess)
        assert not np.any(slopes.states)
        assert not np.any(slopes.controls)


def test_shadow_price_of_a_state_limit():
    """Bryson-Denham at 1/9: -36 a metre, felt at two instants."""
    problem = textbook.bryson_denham()
    found = jaxscp.solve(problem, nodes=nodes_at(1 / 9), discretization=LINEAR)
    prices = jaxscp.shadow_prices(found)
    assert float(prices.of("position", "upper limit")) == pytest.approx(-36, rel=1e-6)
    assert "objective / m " in str(prices)
    with pytest.raises(KeyError, match=r"'acceleration', None.* names 0 limits of"):
        prices.of("acceleration")
    with pytest.raises(KeyError, match=r"names 3 limits"):
        prices.of("position")
