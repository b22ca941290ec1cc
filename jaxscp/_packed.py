"""`Packed`: a tree with functions among its leaves, as one that holds arrays only."""

from typing import Any

import equinox as eqx
import jax

from ._types import PyTree


class Packed(eqx.Module):
    """Arrays as leaves, all other leaves as structure.

    `jax.jit` and `jax.vmap` return nothing but arrays, and a problem holds functions.
    """

    arrays: list[Any]
    others: tuple[Any, ...] = eqx.field(static=True)
    structure: Any = eqx.field(static=True)

    @classmethod
    def of(cls, tree: PyTree) -> "Packed":
        leaves, structure = jax.tree.flatten(tree)
        arrays = [leaf if eqx.is_array(leaf) else None for leaf in leaves]
        others = tuple(None if eqx.is_array(leaf) else leaf for leaf in leaves)
        return cls(arrays, others, structure)

    def unpack(self) -> PyTree:
        """The tree as it was."""
        pairs = zip(self.arrays, self.others, strict=True)
        leaves = [other if array is None else array for array, other in pairs]
        return jax.tree.unflatten(self.structure, leaves)
