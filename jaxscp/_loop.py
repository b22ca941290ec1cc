"""Loops: as often as told and differentiable either way, or written out."""

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


def sequence(
    body: Callable[[PyTree, tuple], tuple[PyTree, PyTree]],
    start: PyTree,
    told: tuple[Array, ...],
    *,
    unrolled: bool,
) -> PyTree:
    """What `jax.lax.scan` stacks, or the same written out.

    Written out it takes longer to compile; where a loop would carry many tangents across
    its border it takes less to run.
    """
    if not unrolled:
        return jax.lax.scan(body, start, told)[1]
    carry, found = start, []
    # Traced once, and a function of its own for XLA: half the time to compile.
    body = jax.jit(body)
    for each in zip(*told, strict=True):
        carry, result = body(carry, each)
        found.append(result)
    return jax.tree.map(lambda *each: jnp.stack(each), *found)
