"""Programs as JAX traces them, read equation by equation."""

from collections.abc import Callable, Sequence
from typing import Any, TypeVar

from jax.extend import core

_V = TypeVar("_V")


def interpreted(
    program: core.Jaxpr,
    constants: Sequence[Any],
    arguments: Sequence[_V],
    *,
    of_value: Callable[[Any], _V],
    of_equation: Callable[[core.JaxprEqn, list[_V]], Sequence[_V]],
) -> list[_V]:
    """What a program gives where its variables stand for something of one's own.

    **Arguments:**

    - `of_value`: what a constant stands for.
    - `of_equation`: what the results of an equation do, from its operands.
    """
    known = dict(zip(program.constvars, map(of_value, constants), strict=True))
    known |= dict(zip(program.invars, arguments, strict=True))

    def read(atom) -> _V:
        return of_value(atom.val) if isinstance(atom, core.Literal) else known[atom]

    for equation in program.eqns:
        found = of_equation(equation, [read(atom) for atom in equation.invars])
        known |= dict(zip(equation.outvars, found, strict=True))
    return [read(atom) for atom in program.outvars]


def applied(equation: core.JaxprEqn, operands: Sequence[Any]) -> list:
    """The results of an equation."""
    primitive, params = equation.primitive, equation.params
    if any(isinstance(value, core.Jaxpr | core.ClosedJaxpr) for value in params.values()):
        return _alone(equation, operands)
    found = primitive.bind(*operands, **params)
    return found if primitive.multiple_results else [found]


def _alone(equation: core.JaxprEqn, operands: Sequence[Any]) -> list:
    """Of a program with this equation alone: JAX knows how to run those within it."""
    pairs = zip(equation.invars, operands, strict=True)
    known = {atom: each for atom, each in pairs if not isinstance(atom, core.Literal)}
    told = core.DebugInfo("applied", equation.primitive.name, None, None)
    program = core.Jaxpr((), list(known), equation.outvars, [equation], debug_info=told)
    return core.jaxpr_as_fun(core.ClosedJaxpr(program, ()))(*known.values())
