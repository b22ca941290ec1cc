"""From one guess of the active limits to the next.

To change all that are wrong at once, as the primal-dual active set method does, need not
end. A limit at a node and those just before and after it say nearly the same: where one
is missed all are, together they push against each other, and dropped together they are
missed again. Of neighbours, therefore, only the one that is most in the wrong changes,
and none becomes active while another has yet to be dropped. Judice and Pires, Computers
and Operations Research 21 (1994), fall back to one change in all; far apart in time,
several do each other no harm.
"""

import jax
import jax.numpy as jnp
import numpy as np

from ._peaks import Watch
from ._per_limit import PerLimit
from ._transcription import Variables
from ._types import Array, Float

# Neighbours are so many intervals apart, or fewer.
_INTERVALS = 2


def pivoted(
    sides: PerLimit, wanted: PerLimit, wrongs: PerLimit, watch: Watch
) -> PerLimit:
    """Where each constraint rests in the next try.

    **Arguments:**

    - `sides`: where it did in the last one; `wanted`: where that says it ought to.
    - `wrongs`: how far one that ought to become active is violated or, negative, how
        large the multiplier of one is that ought not to be; zero elsewhere.
    - `watch`: what the constraints between the nodes are.
    """
    states, path, between = wrongs.variables.states, wrongs.path, wrongs.between
    nodes = jnp.concatenate([states, path], axis=1)
    added = _worst_near(nodes, between, watch)
    dropped = _worst_near(-nodes, -between, watch)

    def turn(wrong: Array, added: Array, dropped: Array) -> Array:
        becomes = (wrong >= added) & (dropped == 0.0)
        return jnp.where(wrong > 0.0, becomes, -wrong >= dropped)

    turns, on_the_way = map(turn, (nodes, between), added, dropped)
    n, variables = states.shape[1], wanted.variables
    states = jnp.where(turns[:, :n], variables.states, sides.variables.states)
    return PerLimit(
        Variables(states, variables.controls, variables.final_time),
        jnp.where(turns[:, n:], wanted.path, sides.path),
        jnp.where(on_the_way, wanted.between, sides.between),
        wanted.integral,
    )


def _worst_near(
    nodes: Float[Array, "N q"], between: Float[Array, "I b"], watch: Watch
) -> tuple[Float[Array, "N q"], Float[Array, "I b"]]:
    """The largest among the neighbours of each, itself among them, and zero.

    Neighbours limit the same quantity, an entry of the state or a path constraint, from
    either side.
    """
    (intervals, each), (_, size) = between.shape, nodes.shape
    parts = each // max(watch.size, 1)
    paths = np.arange(size - watch.path, size)
    quantities = np.concatenate([watch.entries, paths])
    inner = jnp.zeros((intervals, parts, size))
    if parts:
        rows = between.reshape(intervals, parts, watch.size)
        inner = inner.at[:, :, quantities].max(rows)
    # In the order of time: a node, the parts of the interval behind it, the next node.
    blocks = jnp.concatenate([nodes[:-1, None], inner], axis=1)
    line = jnp.concatenate([blocks.reshape(-1, size), nodes[-1:]])
    window = (1 + 2 * _INTERVALS * (1 + parts), 1)
    line = jax.lax.reduce_window(line, 0.0, jax.lax.max, window, (1, 1), "SAME")
    blocks = line[:-1].reshape(blocks.shape)
    at_nodes = jnp.concatenate([blocks[:, 0], line[-1:]])
    if not parts:
        return at_nodes, between
    return at_nodes, blocks[:, 1:, quantities].reshape(between.shape)
