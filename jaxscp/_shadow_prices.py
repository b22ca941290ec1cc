"""`shadow_prices`: what limits cost, named and with units."""

from collections.abc import Iterator
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp

from ._bounds import Bounds
from ._problem import OptimalControlProblem, entry_name
from ._solution import Solution
from ._types import Array, Float, Scalar


class ShadowPrice(eqx.Module):
    """What the optimal objective changes by when one limit is raised by one unit.

    - `name`: of what is limited. `limit`: which of its limits.
    - `unit`: of the price. `value`: the price.
    """

    name: str = eqx.field(static=True)
    limit: str = eqx.field(static=True)
    unit: str = eqx.field(static=True)
    value: Scalar

    def __str__(self) -> str:
        return f"{float(self.value):+14.6g} {self.unit:16} {self.name}, {self.limit}"


class ShadowPrices(eqx.Module):
    """The prices of all limits; print them.

    - `prices`: one for each limit that exists, zero where it is not felt.
    - `costates`: what the objective changes by when a state is pushed by one unit at the
        end of an interval. `times`: of these ends [s].
    """

    prices: tuple[ShadowPrice, ...]
    costates: Float[Array, "I n"]
    times: Float[Array, " I"]

    def of(self, name: str, limit: str | None = None) -> Scalar:
        """The price of one limit.

        **Arguments:**

        - `limit`: which one, as printed; needed where there are several.

        **Raises:** `KeyError` listing the limits there are.
        """
        found = [p for p in self.prices if p.name == name and limit in (None, p.limit)]
        if len(found) != 1:
            known = ", ".join(f"({p.name!r}, {p.limit!r})" for p in self.prices)
            raise KeyError(f"({name!r}, {limit!r}) names {len(found)} limits of {known}")
        return found[0].value

    def __str__(self) -> str:
        return "\n".join(str(price) for price in self.prices if float(price.value) != 0.0)


class _Row(NamedTuple):
    """One limited quantity, and what raising its limits costs.

    - `kind`: put before the word for the limit.
    """

    name: str
    kind: str
    bounds: Bounds
    entry: int
    below: Scalar
    above: Scalar


def shadow_prices(solution: Solution) -> ShadowPrices:
    """What each limit costs at a solution: derivatives of the optimal objective.

    They are sums of multipliers, in units of the objective per unit of the limit: per bit
    of required data, per newton of thrust, per radian of tilt. Of a path constraint
    g <= 0 it is the price of a margin: of g + 1 <= 0, to first order, per unit; of a safe
    distance, per metre. Give `units` to the problem, "objective" among them, to read
    them. Multipliers of a solution that is not polished are not exact.
    """
    problem, multipliers = solution.problem, solution.multipliers
    prices: list[ShadowPrice] = []

    def add(name: str, limit: str, value: Scalar) -> None:
        prices.append(ShadowPrice(name, limit, price_unit(problem, name), value))

    for row in _rows(solution):
        if row.bounds.fixed[row.entry]:
            add(row.name, f"{row.kind}value", row.below + row.above)
            continue
        below, above = (limited[row.entry] for limited in row.bounds.limited)
        if below:
            add(row.name, f"{row.kind}lower limit", row.below)
        if above:
            add(row.name, f"{row.kind}upper limit", row.above)
    for name, values in multipliers.path_constraints.items():
        whole = jnp.sum(values, axis=0) + jnp.sum(multipliers.path_between[name], axis=0)
        for index in range(whole.size):
            add(entry_name(name, index, whole.size), "margin", whole[index])
    times = solution.trajectory.times[1:]
    return ShadowPrices(tuple(prices), multipliers.dynamics, times)


def price_unit(problem: OptimalControlProblem, name: str) -> str:
    """The unit of what one unit of a named quantity costs."""
    objective = problem.unit("objective") or "objective"
    own = problem.unit_of_entry(name) or "unit"
    compound = " " in own or "/" in own
    return f"{objective} / ({own})" if compound else f"{objective} / {own}"


def _prices(multiplier: Array) -> tuple[Array, Array]:
    """Of lower limits, whose multipliers are negative, and of upper ones."""
    return -jnp.minimum(multiplier, 0.0), -jnp.maximum(multiplier, 0.0)


def _rows(solution: Solution) -> Iterator[_Row]:
    problem, multipliers = solution.problem, solution.multipliers
    yield from _of_states(solution)
    control = [jnp.sum(p, axis=0) for p in _prices(multipliers.control)]
    for index, name in enumerate(problem.control_names):
        yield _Row(name, "", problem.control, index, control[0][index], control[1][index])
    yield _Row("final time", "", problem.final_time, 0, *_prices(multipliers.final_time))
    for name, integral in problem.integrals.items():
        price = _prices(multipliers.integrals[name])
        yield _Row(name, "", integral.bounds, 0, *price)


def _of_states(solution: Solution) -> Iterator[_Row]:
    """Limits of the states, and of their ends where these are tighter."""
    problem, multipliers = solution.problem, solution.multipliers
    below, above = _prices(multipliers.state)
    own = problem.state
    for kind, node, end in (
        ("first ", 0, problem.initial_state),
        ("last ", -1, problem.final_state),
    ):
        lower, upper = end.prevails(own)
        low = jnp.where(lower, below[node], 0.0)
        high = jnp.where(upper, above[node], 0.0)
        below, above = below.at[node].add(-low), above.at[node].add(-high)
        for index, name in enumerate(problem.state_names):
            yield _Row(name, kind, end, index, low[index], high[index])
    between = _prices(multipliers.state_between)
    pairs = zip((below, above), between, strict=True)
    low, high = (jnp.sum(p, axis=0) + jnp.sum(q, axis=0) for p, q in pairs)
    for index, name in enumerate(problem.state_names):
        yield _Row(name, "", own, index, low[index], high[index])
