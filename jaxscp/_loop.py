"""Loops: as often as told and differentiable either way, or written out."""

from collections.abc import Callable

import jax
import jax.numpy as jnp

from ._types import Array, PyTree

# Entries whose tangents fit into a processor's cache together.
_TOGETHER = 200

# Repetitions that are skipped together once enough are done.
_BLOCK = 16


def over_all(function: Callable[..., PyTree], *arrays: Array) -> PyTree:
    """`jax.vmap(function)(*arrays)`, on the CPU in blocks of at most so many entries.

    Time then grows as their number: what a block makes stays in the cache.
    """
    count = arrays[0].shape[0]
    blocks = -(-count // _TOGETHER) if jax.default_backend() == "cpu" else 1
    if blocks == 1:
        return jax.vmap(function)(*arrays)
    size = -(-count // blocks)

    # Filled up with the last entry: any other might not be defined.
    places = jnp.minimum(jnp.arange(blocks * size), count - 1)

    def folded(array: Array) -> Array:
        return array[places].reshape(blocks, size, *array.shape[1:])

    found = jax.lax.map(
        lambda block: jax.vmap(function)(*block), tuple(map(folded, arrays))
    )
    return jax.tree.map(
        lambda array: array.reshape(blocks * size, *array.shape[2:])[:count], found
    )


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
