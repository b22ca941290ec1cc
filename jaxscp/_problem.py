"""`OptimalControlProblem`: what is to be solved, as a PyTree."""

from collections.abc import Callable, Mapping

import equinox as eqx
import jax
import jax.numpy as jnp

from ._bounds import Bounds
from ._types import (
    Array,
    Control,
    Float,
    Scalar,
    State,
    TimeStateControl,
    check_kind,
)

GIVE_BOUNDS = "Bounds(lower, upper), or Bounds.exactly(value)"


class Integral(eqx.Module):
    """An isoperimetric constraint: `bounds` on the total of `integrand` over the flight.

    **Arguments:**

    - `integrand`: scalar function of (t [s], x, u).
    - `bounds`: limits of its integral over time, integrand's unit times seconds.
    """

    integrand: TimeStateControl
    bounds: Bounds


def no_running_cost(t: Scalar, x: State, u: Array) -> Scalar:
    """The running cost of a problem that has none."""
    del t, u
    return jnp.zeros((), x.dtype)


def no_terminal_cost(t_f: Scalar, x_f: State) -> Scalar:
    """The terminal cost of a problem that has none."""
    del t_f
    return jnp.zeros((), x_f.dtype)


class OptimalControlProblem(eqx.Module):
    r"""Minimize a cost subject to dynamics, limits, path and integral constraints.

    $$\min_{x, u, T}\; h(T, x(T)) + \int_0^T \ell(t, x, u)\,dt \quad\text{s.t.}\quad
      \dot x = f(t, x, u),\; g_j(t, x, u) \le 0,\;
      \underline{Q}_i \le \int_0^T r_i\,dt \le \overline{Q}_i$$

    with limits on x, u, x(0), x(T) and T (paper, eq. 5). All callables are pure JAX
    functions, plain ones or Modules with fields; every inexact array leaf of the problem
    is a parameter. New parameter values compile nothing, other functions do.

    **Main arguments:**

    - `dynamics`: f(t, x, u), shape (n,), state unit per second.
    - `state`, `control`: `Bounds` of shapes (n,), (m,), kept over the whole flight.
    - `initial_state`, `final_state`: `Bounds` of shape (n,); free if left out.
    - `final_time`: `Bounds` of a scalar [s], positive.
    - `running_cost`: l(t, x, u), scalar. `terminal_cost`: h(t_f, x_f), scalar.
    - `path_constraints`: name to g(t, x, u) <= 0, shape (p,).
    - `integrals`: name to [`Integral`][].

    **Arguments that make messages readable:**

    - `state_names`, `control_names`: one name an entry.
    - `units`: the unit of each name (states, controls, path constraints, integrals, and
        "objective").
    """

    dynamics: TimeStateControl
    state: Bounds
    control: Bounds
    initial_state: Bounds
    final_state: Bounds
    final_time: Bounds
    running_cost: TimeStateControl
    terminal_cost: Callable[[Scalar, State], Array]
    path_constraints: dict[str, TimeStateControl]
    integrals: dict[str, Integral]
    state_names: tuple[str, ...] = eqx.field(static=True)
    control_names: tuple[str, ...] = eqx.field(static=True)
    units: tuple[tuple[str, str], ...] = eqx.field(static=True)

    def __init__(
        self,
        dynamics: TimeStateControl,
        *,
        state: Bounds,
        control: Bounds,
        initial_state: Bounds | None = None,
        final_state: Bounds | None = None,
        final_time: Bounds,
        running_cost: TimeStateControl = no_running_cost,
        terminal_cost: Callable[[Scalar, State], Array] = no_terminal_cost,
        path_constraints: Mapping[str, TimeStateControl] | None = None,
        integrals: Mapping[str, Integral] | None = None,
        state_names: tuple[str, ...] = (),
        control_names: tuple[str, ...] = (),
        units: Mapping[str, str] | tuple[tuple[str, str], ...] = (),
    ):
        check_kind("state", state, Bounds, GIVE_BOUNDS)
        check_kind("control", control, Bounds, GIVE_BOUNDS)
        for name, parts in (
            ("path_constraints", path_constraints),
            ("integrals", integrals),
        ):
            check_kind(name, parts or {}, Mapping, "a dictionary, name to part")
        for name, part in (integrals or {}).items():
            check_kind(f"integrals[{name!r}]", part, Integral, "Integral(rate, bounds)")
        self.dynamics = dynamics
        self.state, self.control = state, control
        free = Bounds.free(state.lower.size)
        self.initial_state = free if initial_state is None else initial_state
        self.final_state = free if final_state is None else final_state
        self.final_time = final_time
        self.running_cost, self.terminal_cost = running_cost, terminal_cost
        # Sorted, as JAX returns dictionaries: one order of the rows everywhere.
        self.path_constraints = dict(sorted((path_constraints or {}).items()))
        self.integrals = dict(sorted((integrals or {}).items()))
        self.state_names = tuple(state_names) or _indexed("x", state)
        self.control_names = tuple(control_names) or _indexed("u", control)
        self.units = tuple(sorted(dict(units).items()))

    @property
    def state_size(self) -> int:
        """Entries of the state, n."""
        return self.state.lower.size

    @property
    def control_size(self) -> int:
        """Entries of the control, m."""
        return self.control.lower.size

    @property
    def path_sizes(self) -> dict[str, int]:
        """Entries of each path constraint."""
        point = (jnp.zeros(()), self.state.lower, self.control.lower)
        return {
            name: int(jax.eval_shape(constraint, *point).size)
            for name, constraint in self.path_constraints.items()
        }

    def rates(self, t: Scalar, x: State, u: Control) -> Float[Array, " r"]:
        """Integrands of all integrals, and the running cost, at one moment."""
        rates = [integral.integrand(t, x, u) for integral in self.integrals.values()]
        return jnp.stack(
            [jnp.reshape(rate, ()) for rate in [*rates, self.running_cost(t, x, u)]]
        )

    def path(self, t: Scalar, x: State, u: Control) -> Float[Array, " p"]:
        """All path constraints, one after the other, at one moment."""
        constraints = self.path_constraints.values()
        values = [jnp.ravel(constraint(t, x, u)) for constraint in constraints]
        return jnp.concatenate(values) if values else jnp.zeros(0, x.dtype)

    def unit(self, name: str) -> str:
        """The unit of one of its names; "" if unknown."""
        return dict(self.units).get(name, "")

    def unit_of_entry(self, name: str) -> str:
        """The same, also of one entry of a name, as in `buildings[1]`."""
        return self.unit(name) or self.unit(name.partition("[")[0])


def entry_name(name: str, entry: int, size: int) -> str:
    """What one entry of a constraint is called; an only one goes by the constraint's."""
    return f"{name}[{entry}]" if size > 1 else name


def _indexed(letter: str, bounds: Bounds) -> tuple[str, ...]:
    return tuple(f"{letter}[{index}]" for index in range(bounds.lower.size))
