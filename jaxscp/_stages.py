"""A quadratic program along linearized dynamics as a chain of stages.

The state y of the chain is (x, u, totals, flight time): u only where an interval depends
on the controls at both its ends, the totals of the integrals as far as they have come,
and the flight time, which never changes. The decision v of an interval is its one
control, or the control at its right end.
"""

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from ._curvature import Curvature
from ._transcription import Derivatives, Residuals, Variables
from ._types import Array, Float


class Matrices(eqx.Module):
    """What does not depend on where the program is started.

    - `onward`: y at the right end of an interval, from y at its left and the decision v.
    - `cost`: second derivatives of a stage's cost by (y, v). `last`: at the end, by y.
    """

    onward: Float[Array, "I y w"]
    cost: Float[Array, "I w w"]
    last: Float[Array, "y y"]


class Vectors(eqx.Module):
    """The rest.

    - `drift`: y at the right end of an interval, from nothing.
    - `slope`: first derivatives of a stage's cost by (y, v). `last`: at the end, by y.
    """

    drift: Float[Array, "I y"]
    slope: Float[Array, "I w"]
    last: Float[Array, " y"]


class Chain(eqx.Module):
    """A model's derivatives, and what they say of the stages.

    - `free`: how many nodes have a control of their own.
    """

    derivatives: Derivatives
    curvature: Curvature
    free: int = eqx.field(static=True)

    @property
    def sizes(self) -> tuple[int, int, int, int]:
        """Entries of x, of u as far as it is part of y, of the totals, and of v."""
        intervals, n, m = self.derivatives.intervals.next_state.left_control.shape
        u = m if self.free > intervals else 0
        return n, u, self.derivatives.intervals.increments.time.shape[1] - 1, m

    @property
    def sums(self) -> np.ndarray:
        """Where the totals are in y."""
        n, u, q, _ = self.sizes
        return np.arange(n + u, n + u + q)

    def matrices(self, per_total: Float[Array, " q"]) -> Matrices:
        """With the cost's second derivatives by the integrals' totals."""
        return Matrices(self._dynamics(), *self._costs(per_total))

    def vectors(
        self,
        residuals: Residuals,
        gradient: Variables,
        per_total: Float[Array, " q"],
    ) -> Vectors:
        """With the cost's first derivatives, `per_total` by the integrals' totals."""
        n, u, q, m = self.sizes
        growth = self.derivatives.intervals.increments[:-1]
        intervals, controls = residuals.defects.shape[0], gradient.controls
        gained = residuals.increments[:, :-1]
        if growth.right_state is not None:
            gained -= jnp.einsum("kqn,kn->kq", growth.right_state, residuals.defects)
        nothing = jnp.zeros((intervals, u))
        none = jnp.zeros((intervals, 1))
        parts = [-residuals.defects, nothing, gained, none]
        if self.curvature.tail is not None:
            controls = controls.at[-1].add(-self.curvature.tail @ residuals.defects[-1])
        slope = jnp.zeros((intervals + 1, n + u + q + 1)).at[:, :n].set(gradient.states)
        slope = slope.at[0, -1].set(gradient.final_time)
        slope = slope.at[-1, self.sums].set(per_total)
        pull = controls
        if u:
            slope, pull = slope.at[:, n : n + u].set(controls), jnp.zeros((intervals, m))
        return Vectors(
            jnp.concatenate(parts, axis=1),
            jnp.concatenate([slope[:-1], pull], axis=1),
            slope[-1],
        )

    def _dynamics(self) -> Array:
        flow = self.derivatives.intervals.next_state
        growth = self.derivatives.intervals.increments[:-1]
        (n, u, q, m), sums = self.sizes, self.sums
        intervals, y = flow.time.shape[0], n + u + q + 1
        by_state = jnp.zeros((intervals, y, y))
        by_state = by_state.at[:, :n, :n].set(flow.left_state)
        by_state = by_state.at[:, :n, -1].set(flow.time)
        by_control = jnp.zeros((intervals, y, m))
        if u:
            by_state = by_state.at[:, :n, n : n + m].set(flow.left_control)
            if flow.right_control is not None:
                by_control = by_control.at[:, :n].set(flow.right_control)
            by_control = by_control.at[:, np.arange(n, n + m), np.arange(m)].set(1.0)
        else:
            by_control = by_control.at[:, :n].set(flow.left_control)
        grown = jnp.zeros((intervals, q, y))
        grown = grown.at[:, :, :n].set(growth.left_state).at[:, :, -1].set(growth.time)
        chosen = jnp.zeros((intervals, q, m))
        if u:
            grown = grown.at[:, :, n : n + m].set(growth.left_control)
            if growth.right_control is not None:
                chosen = growth.right_control
        else:
            chosen = growth.left_control
        if growth.right_state is not None:
            grown += growth.right_state @ by_state[:, :n]
            chosen += growth.right_state @ by_control[:, :n]
        by_state = by_state.at[:, sums].set(grown).at[:, sums, sums].add(1.0)
        by_state = by_state.at[:, -1, -1].set(1.0)
        by_control = by_control.at[:, sums].set(chosen)
        return jnp.concatenate([by_state, by_control], axis=2)

    def _costs(self, per_total: Float[Array, " q"]) -> tuple[Array, Array]:
        flow, curvature = self.derivatives.intervals.next_state, self.curvature
        n, u, q, m = self.sizes
        intervals, y, inner = flow.time.shape[0], n + u + q + 1, n + u
        blocks, border = curvature.blocks, curvature.border
        if curvature.tail is not None:
            # The last node's state, seen from the node whose control it borrows.
            tail = curvature.tail
            by_x, by_u = tail @ flow.left_state[-1], tail @ flow.left_control[-1]
            blocks = blocks.at[-2, n:, :n].add(by_x).at[-2, :n, n:].add(by_x.T)
            blocks = blocks.at[-2, n:, n:].add(by_u + by_u.T)
            border = border.at[-2, n:].add(tail @ flow.time[-1])
        cost = jnp.zeros((intervals + 1, y, y))
        cost = cost.at[:, :inner, :inner].set(blocks[:, :inner, :inner])
        cost = cost.at[:, :inner, -1].set(border[:, :inner])
        cost = cost.at[:, -1, :inner].set(border[:, :inner])
        cost = cost.at[0, -1, -1].add(curvature.corner)
        cost = cost.at[-1, self.sums, self.sums].add(per_total)
        mixed, own = jnp.zeros((intervals, m, y)), jnp.zeros((intervals, m, m))
        if not u:
            own = blocks[:-1, n:, n:]
            mixed = mixed.at[:, :, :n].set(blocks[:-1, n:, :n])
            mixed = mixed.at[:, :, -1].set(border[:-1, n:])
        elif curvature.ahead is not None:
            mixed = mixed.at[:, :, :inner].set(curvature.ahead.mT)
        rows = [
            jnp.concatenate([cost[:-1], mixed.mT], axis=2),
            jnp.concatenate([mixed, own], axis=2),
        ]
        return jnp.concatenate(rows, axis=1), cost[-1]
