"""Which entries of its argument a function is nonlinear in, found from its program.

Second derivatives by all other entries vanish everywhere: a quadrotor's rates are linear
in its position and velocity, and most path constraints know nothing but the position.
The program is read once, while JAX traces; whatever is not known to be linear counts as
nonlinear in all that enters it.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend import core

from ._pattern import RULES, Pattern, evaluated, values
from ._types import Array, Float


def nonlinear_entries(
    function: Callable[[Float[Array, " v"]], Array], size: int
) -> np.ndarray:
    """Indices of the entries of a vector that a function is nonlinear in."""
    program = jax.make_jaxpr(function)(jnp.zeros(size))
    whole = Pattern(np.eye(size, dtype=bool), np.zeros((size, size), bool))
    outputs = _run(program.jaxpr, program.consts, [whole], size)
    bends = [out.bends.reshape(-1, size).any(axis=0) for out in outputs]
    return np.flatnonzero(np.any(bends, axis=0))


def compact_hessian(
    function: Callable[[Float[Array, " v"]], Array],
    point: Float[Array, " v"],
    entries: np.ndarray,
) -> Float[Array, "e e"]:
    """Second derivatives by the entries that a function is nonlinear in."""
    return jax.hessian(lambda own: function(point.at[entries].set(own)))(point[entries])


def _run(jaxpr, constants, arguments: list[Pattern], size: int) -> list[Pattern]:
    """Patterns of a program's results."""
    known = dict(zip(jaxpr.invars, arguments, strict=True))
    fixed = [Pattern.none(value, size) for value in constants]
    known |= dict(zip(jaxpr.constvars, fixed, strict=True))

    def read(atom) -> Pattern:
        if isinstance(atom, core.Literal):
            return Pattern.none(atom.val, size)
        return known[atom]

    for equation in jaxpr.eqns:
        found = _of_equation(equation, [read(atom) for atom in equation.invars], size)
        known |= dict(zip(equation.outvars, found, strict=True))
    return [read(atom) for atom in jaxpr.outvars]


def _of_equation(equation, inputs: list[Pattern], size: int) -> list[Pattern]:
    name = equation.primitive.name
    shapes = [out.aval.shape for out in equation.outvars]
    if not any(each.depends for each in inputs):
        return _constants(equation, inputs, size)
    if not any(jnp.issubdtype(o.aval.dtype, jnp.inexact) for o in equation.outvars):
        # Comparisons have no derivatives.
        return [Pattern(*2 * (np.zeros((*shape, size), bool),)) for shape in shapes]
    inner = equation.params.get("jaxpr")
    if name in ("jit", "pjit", "closed_call", "remat", "checkpoint"):
        jaxpr, constants = getattr(inner, "jaxpr", inner), getattr(inner, "consts", ())
        return _run(jaxpr, constants, inputs, size)
    rule = RULES.get(name)
    found = rule(equation, inputs) if rule else None
    if found is not None:
        return [found]
    every = np.any([each.enters.reshape(-1, size).any(axis=0) for each in inputs], axis=0)
    dense = [np.broadcast_to(every, (*shape, size)) for shape in shapes]
    return [Pattern(each, each) for each in dense]


def _constants(equation, inputs: list[Pattern], size: int) -> list[Pattern]:
    """What does not depend on the argument, with its values if these are known."""
    nothing = [np.zeros((*o.aval.shape, size), bool) for o in equation.outvars]
    known = values(inputs)
    if equation.params.get("jaxpr") or known is None:
        return [Pattern(none, none) for none in nothing]
    found = evaluated(equation, known)
    return [Pattern(n, n, v) for n, v in zip(nothing, found, strict=True)]
