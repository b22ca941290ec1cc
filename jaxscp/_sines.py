"""Sines and cosines that XLA evaluates once.

On the CPU it counts them as cheap and writes them into every kernel that reads them: a
Runge-Kutta step of a quadrotor with its tangents evaluates 180 of them instead of 24. It
never evaluates a quotient twice. So each is divided by a one that it cannot see through.
"""

from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
from jax.extend import core

from ._program import applied, interpreted
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


def _run(program: core.Jaxpr, constants: Sequence, arguments: Sequence) -> list:
    return interpreted(
        program,
        constants,
        arguments,
        of_value=lambda value: value,
        of_equation=_of_equation,
    )


def _of_equation(equation: core.JaxprEqn, operands: list) -> list:
    name = equation.primitive.name
    if name in ("jit", "pjit"):
        inner = equation.params["jaxpr"]
        return _run(inner.jaxpr, inner.consts, operands)
    if name in _ONCE and jnp.issubdtype(operands[0].dtype, jnp.floating):
        return [_ONCE[name](*operands)]
    return applied(equation, operands)
