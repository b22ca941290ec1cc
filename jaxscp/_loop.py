"""A loop that repeats as often as it is told, and can be differentiated either way."""

from collections.abc import Callable

import jax
import jax.numpy as jnp

from ._types import Array, PyTree

# Repetitions that are skipped together once enough are done.
_BLOCK = 16


def repeat(
    count: Array | int, most: int, body: Callable[[Array, PyTree], PyTree], start: PyTree
) -> PyTree:
    """As `jax.lax.fori_loop` from zero to a traced `count`, which is at most `most`.

    A loop of unknown length cannot be run backwards; one of known length, most of which
    is skipped, can. Only what each repetition starts from is kept for the way back.
    """

    @jax.checkpoint
    def once(carry, index):
        carry = jax.lax.cond(
            index < count, lambda carry: body(index, carry), lambda carry: carry, carry
        )
        return carry, None

    def block(carry, first):
        def all_of_it(carry):
            return jax.lax.scan(once, carry, first + jnp.arange(_BLOCK))[0]

        whole = jax.lax.cond(first < count, all_of_it, lambda carry: carry, carry)
        return whole, None

    return jax.lax.scan(block, start, jnp.arange(0, most, _BLOCK))[0]
