"""`Curvature`: the Hessian of a cost by all variables, block by block."""

from collections.abc import Callable

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from ._types import Array, Float, Scalar


class Curvature(eqx.Module):
    """Second derivatives by the (x, u) of the nodes and the flight time.

    - `blocks`: by (x, u) of each node. `border`: by those and the flight time.
    - `corner`: by the flight time.
    - `ahead`: by (x, u) of each node and the control of the next, where an interval
        depends on both.
    - `tail`: by the last control and the state of the last node, where that node has no
        control of its own.

    A node without a control of its own has zeros in its place.
    """

    blocks: Float[Array, "N w w"]
    border: Float[Array, "N w"]
    corner: Scalar
    ahead: Float[Array, "I w m"] | None = None
    tail: Float[Array, "m n"] | None = None

    @classmethod
    def of_nodes(
        cls,
        blocks: Float[Array, "N w w"],
        states: int,
        *,
        two_sided: bool,
        borrows: bool,
    ) -> "Curvature":
        """Nothing but a block at each node.

        **Arguments:**

        - `two_sided`: whether an interval depends on the controls at both its ends.
            The others are those of [`Curvature.assembled`][].
        """
        nodes, w, _ = blocks.shape
        m = w - states
        return cls(
            blocks,
            jnp.zeros((nodes, w)),
            jnp.zeros(()),
            jnp.zeros((nodes - 1, w, m)) if two_sided else None,
            jnp.zeros((m, states)) if borrows else None,
        )

    @classmethod
    def assembled(
        cls,
        at_nodes: Float[Array, "N s s"],
        at_intervals: Float[Array, "I v v"],
        states: int,
        *,
        borrows: bool,
    ) -> "Curvature":
        """From Hessians by (x, u, flight time) and by (x, u, u ahead, flight time).

        **Arguments:**

        - `states`: entries of x. Where held controls leave u ahead out, it is missing.
        - `borrows`: whether the last node has no control of its own: its u is that of
            the node before.
        """
        w, last, n = at_nodes.shape[1] - 1, at_intervals.shape[1] - 1, states
        blocks = at_nodes[:, :w, :w].at[:-1].add(at_intervals[:, :w, :w])
        border = at_nodes[:, :w, w].at[:-1].add(at_intervals[:, :w, last])
        corner = jnp.sum(at_nodes[:, w, w]) + jnp.sum(at_intervals[:, last, last])
        ahead = tail = None
        if last > w:
            blocks = blocks.at[1:, n:, n:].add(at_intervals[:, w:last, w:last])
            border = border.at[1:, n:].add(at_intervals[:, w:last, last])
            ahead = at_intervals[:, :w, w:last]
        if borrows:
            own, tail = blocks[-1], blocks[-1, n:, :n]
            blocks = blocks.at[-2, n:, n:].add(own[n:, n:])
            blocks = blocks.at[-1].set(jnp.zeros_like(own).at[:n, :n].set(own[:n, :n]))
            border = border.at[-2, n:].add(border[-1, n:]).at[-1, n:].set(0.0)
        return cls(blocks, border, corner, ahead, tail)

    def plus(self, other: "Curvature") -> "Curvature":
        """The sum of two; a block that one of them lacks is the other's."""
        return Curvature(
            self.blocks + other.blocks,
            self.border + other.border,
            self.corner + other.corner,
            _sum(self.ahead, other.ahead),
            _sum(self.tail, other.tail),
        )

    def scaled(self, sizes: Float[Array, " w"], time: Scalar) -> "Curvature":
        """By variables that are divided by their sizes."""
        m = 0 if self.ahead is None else self.ahead.shape[2]
        n = 0 if self.tail is None else self.tail.shape[1]
        return Curvature(
            self.blocks * jnp.outer(sizes, sizes)[None],
            self.border * (sizes * time)[None],
            self.corner * time**2,
            None
            if self.ahead is None
            else self.ahead * jnp.outer(sizes, sizes[sizes.size - m :])[None],
            None if self.tail is None else self.tail * jnp.outer(sizes[n:], sizes[:n]),
        )

    def along(self, z: Float[Array, "N w"], time: Scalar) -> Scalar:
        """Half the quadratic form of a step; a control repeats where it is held."""
        curved = jnp.einsum("ki,kij,kj->", z, self.blocks, z)
        curved += 2.0 * time * jnp.vdot(self.border, z) + self.corner * time**2
        if self.ahead is not None:
            m = self.ahead.shape[2]
            curved += 2.0 * jnp.einsum("ki,kij,kj->", z[:-1], self.ahead, z[1:, -m:])
        if self.tail is not None:
            n = self.tail.shape[1]
            curved += 2.0 * z[-1, n:] @ self.tail @ z[-1, :n]
        return 0.5 * curved


def _sum(one: Array | None, other: Array | None) -> Array | None:
    if one is None or other is None:
        return other if one is None else one
    return one + other


def convex_part(
    matrix: Float[Array, "*b w w"], entries: np.ndarray
) -> Float[Array, "*b w w"]:
    """The matrices without their negative eigenvalues.

    **Arguments:**

    - `entries`: the rows and columns that may have anything in them: to look for
        eigenvalues in all of them takes longer.
    """
    if not entries.size:
        return jnp.zeros_like(matrix)
    part = (..., entries[:, None], entries)
    convex = _with_eigenvalues(matrix[part], lambda values: jnp.maximum(values, 0.0))
    return jnp.zeros_like(matrix).at[part].set(convex)


def magnitude(matrix: Float[Array, "*b w w"]) -> Float[Array, "*b w w"]:
    """The matrices with the signs of their negative eigenvalues changed."""
    return _with_eigenvalues(matrix, jnp.abs)


def _with_eigenvalues(matrix: Array, change: Callable[[Array], Array]) -> Array:
    values, vectors = jnp.linalg.eigh(matrix)
    return (vectors * change(values)[..., None, :]) @ vectors.mT
