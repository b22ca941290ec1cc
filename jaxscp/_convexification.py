"""An indefinite Hessian made convex without changing the QP it belongs to.

Along linearized dynamics the quadratic form of a state's transfer matrix can be taken
from one interval and given to the next. Chosen by a Riccati recursion from the end, the
transfers leave every interval with a convex block, wherever the QP has a minimum at all.
Verschueren, Zanon, Quirynen, Diehl, "A sparsity preserving convexification procedure for
indefinite quadratic programs arising in direct optimal control", 2017.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from ._discretization import Jacobian
from ._types import Array, Float, Scalar

# Curvature lent to fixed entries of the last state: it costs nothing, as they do not
# move, and it is what makes the recursion start convex.
_LENT = 10.0


class Curvature(eqx.Module):
    """Hessian of a model's cost by the scaled step.

    - `blocks`: by (x, u) of each node. `border`: by those and the flight time.
    - `corner`: by the flight time.
    """

    blocks: Float[Array, "N w w"]
    border: Float[Array, "N w"]
    corner: Scalar

    def along(self, z: Float[Array, "N w"], time: Scalar) -> Scalar:
        """Half the quadratic form of a step."""
        curved = jnp.einsum("ki,kij,kj->", z, self.blocks, z)
        return 0.5 * (
            curved + 2.0 * time * jnp.vdot(self.border, z) + self.corner * time**2
        )


def convexified(
    hessian: Float[Array, "N v v"],
    flow: Jacobian,
    fixed: np.ndarray,
    least: Scalar,
) -> tuple[Curvature, Float[Array, "I s s"]]:
    """Convex curvature, and the transfer matrix at each interval's right end.

    **Arguments:**

    - `hessian`: by v = (x, u, flight time) of each node, damping included.
    - `flow`: Jacobian of the linearized dynamics of a held control.
    - `fixed`: mask (N, n) of the states that do not move.
    - `least`: curvature left where the recursion meets a direction without any.

    **Returns:** transfers by s = (x, flight time).
    """
    n, m = flow.left_state.shape[2], flow.left_control.shape[2]
    nodes, last = hessian.shape[0], n + m
    kept, controls = np.append(np.arange(n), last), np.arange(n, last)

    def back(transfer, interval):
        block, by_state, by_control, by_time = interval
        through = jnp.concatenate([by_state, by_control, by_time[:, None]], axis=1)
        through = jnp.concatenate([through, jnp.eye(last + 1)[-1:]])
        whole = block + through.T @ transfer @ through
        cross = whole[np.ix_(controls, kept)]
        values, vectors = jnp.linalg.eigh(whole[np.ix_(controls, controls)])
        convex = values >= 0.5 * least
        values = jnp.where(convex, values, jnp.maximum(jnp.abs(values), least))
        gain = vectors.T @ cross
        taken = gain.T @ (gain / values[:, None])
        left = _symmetric(whole[np.ix_(kept, kept)] - taken)
        # Without a minimum along the controls the transfers would run away.
        left = jax.lax.cond(jnp.all(convex), lambda left: left, convex_part, left)
        return left, (taken, cross, (vectors * values[None]) @ vectors.T, transfer)

    lent = jnp.diag(jnp.append(_LENT * fixed[-1], 0.0))
    first, (taken, cross, own, transfers) = jax.lax.scan(
        back,
        hessian[-1][np.ix_(kept, kept)] + lent,
        (hessian[:-1], flow.left_state, flow.left_control, flow.time),
        reverse=True,
    )
    free = jnp.append(1.0 - fixed[0], 1.0)
    first = convex_part(first * jnp.outer(free, free))
    mixed = cross[:, :, :n]
    blocks = jnp.zeros((nodes, last, last))
    blocks = blocks.at[:-1, :n, :n].set(taken[:, :n, :n]).at[0, :n, :n].add(first[:n, :n])
    blocks = blocks.at[:-1, n:, :n].set(mixed).at[:-1, :n, n:].set(mixed.mT)
    blocks = blocks.at[:-1, n:, n:].set(own)
    border = jnp.zeros((nodes, last)).at[:-1, n:].set(cross[:, :, n])
    border = border.at[:-1, :n].set(taken[:, :n, n]).at[0, :n].add(first[:n, n])
    corner = jnp.sum(taken[:, n, n]) + first[n, n]
    return Curvature(blocks, border, corner), transfers


def _symmetric(matrix: Array) -> Array:
    return 0.5 * (matrix + matrix.mT)


def convex_part(matrix: Array) -> Array:
    """The matrices without their negative eigenvalues."""
    values, vectors = jnp.linalg.eigh(matrix)
    kept = vectors * jnp.maximum(values, 0.0)[..., None, :]
    return kept @ vectors.mT
