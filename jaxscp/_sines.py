"""Sines and cosines that XLA evaluates once.

On the CPU it counts them as cheap and writes them into every kernel that reads them: a
Runge-Kutta step of a quadrotor with its tangents evaluates 180 of them instead of 24. It
never evaluates a quotient twice. So each is divided by a one that it cannot see through.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jax.extend import core

from ._types import Array, PyTree


@jax.custom_jvp
def _sine(x: Array) -> Array:
    return jnp.sin(x) / _one(x)


@jax.custom_jvp
def _cosine(x: Array) -> Array:
    return jnp.cos(x) / _one(x)


def _one(x: Array) -> Array:
    return 1.0 + 0.0 * x


# Derivatives read what is evaluated already.
_sine.defjvps(lambda tangent, _, x: _cosine(x) * tangent)
_cosine.defjvps(lambda tangent, _, x: -_sine(x) * tangent)

_ONCE = {"sin": _sine, "cos": _cosine}


def sines_once(function: Callable[..., PyTree]) -> Callable[..., PyTree]:
    """The same function of arrays. Sines in its loops and branches stay as they are."""

    def call(*arguments: PyTree) -> PyTree:
        program, shape = jax.make_jaxpr(function, return_shape=True)(*arguments)
        found = _run(program.jaxpr, program.consts, jax.tree.leaves(arguments))
        return jax.tree.unflatten(jax.tree.structure(shape), found)

    return call


def _run(program, constants: list, arguments: list) -> list:
    known = dict(zip(program.constvars, constants, strict=True))
    known |= dict(zip(program.invars, arguments, strict=True))

    def read(atom):
        return atom.val if isinstance(atom, core.Literal) else known[atom]

    for equation in program.eqns:
        found = _of_equation(equation, list(map(read, equation.invars)))
        known |= dict(zip(equation.outvars, found, strict=True))
    return list(map(read, program.outvars))


def _of_equation(equation, operands: list) -> list:
    primitive, params = equation.primitive, equation.params
    if primitive.name in ("jit", "pjit"):
        return _run(params["jaxpr"].jaxpr, params["jaxpr"].consts, operands)
    if primitive.name in _ONCE and jnp.issubdtype(operands[0].dtype, jnp.floating):
        return [_ONCE[primitive.name](*operands)]
    if any(isinstance(value, core.Jaxpr | core.ClosedJaxpr) for value in params.values()):
        return _alone(equation, operands)
    found = primitive.bind(*operands, **params)
    return found if primitive.multiple_results else [found]


def _alone(equation, operands: list) -> list:
    """What a program of this equation alone gives: JAX knows how to run those in it."""
    pairs = zip(equation.invars, operands, strict=True)
    known = {atom: each for atom, each in pairs if not isinstance(atom, core.Literal)}
    told = core.DebugInfo("sines_once", equation.primitive.name, None, None)
    program = core.Jaxpr((), list(known), equation.outvars, [equation], debug_info=told)
    return core.jaxpr_as_fun(core.ClosedJaxpr(program, ()))(*known.values())
