"""Names of single limits: of what, which one, and where."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from ._per_limit import PerLimit
from ._problem import entry_name
from ._scaling import Scaling
from ._solution import Solution
from ._transcription import Variables
from ._types import ArrayLike, PyTree


class LimitName(eqx.Module):
    """One limit of the discrete problem.

    - `name`: of what is limited, `limit`: which of its limits, as in
        [`jaxscp.shadow_prices`][].
    - `node`: where; the one before where `between` holds. None for the whole flight.
    - `time`: of that node [s].
    """

    name: str = eqx.field(static=True)
    limit: str = eqx.field(static=True)
    node: int | None = eqx.field(static=True, default=None)
    between: bool = eqx.field(static=True, default=False)
    time: float = eqx.field(static=True, default=0.0)

    @property
    def kind(self) -> str:
        """What is limited, wherever it is."""
        return f"{self.name}, {self.limit}" + (", between nodes" if self.between else "")

    def __str__(self) -> str:
        if self.node is None:
            return f"{self.name}, {self.limit}"
        where = "behind" if self.between else "at"
        return f"{self.name}, {self.limit}, {where} node {self.node} ({self.time:.4g} s)"


def names_at(solution: Solution, side: int, row: np.ndarray) -> list[LimitName]:
    """Names of the limits where a mask holds, a row as of `flat`, in its order.

    **Arguments:**

    - `side`: 0 for the lower limits, 1 for the upper ones.
    """
    unravel = ravel_pytree(solution.optimum.sides)[1]
    chosen = unravel(jnp.asarray(row, float))
    problem = solution.transcription.problem
    word = ("lower limit", "upper limit")[side]
    times = np.asarray(solution.trajectory.times)
    watch = solution.transcription.watch
    path = [
        entry_name(name, entry, size)
        for name, size in problem.path_sizes.items()
        for entry in range(size)
    ]
    lower = [problem.state_names[entry] for entry in watch.lower]
    watched = [(name, "lower limit") for name in lower]
    watched += [(problem.state_names[entry], "upper limit") for entry in watch.upper]
    watched += [(name, "margin") for name in path]

    def nodal(mask: ArrayLike, labels: list[tuple[str, str]], between: bool = False):
        for node, entry in np.argwhere(mask):
            name, limit = labels[entry % len(labels)]
            yield LimitName(name, limit, int(node), between, float(times[node]))

    def whole(mask: ArrayLike, labels: list[str]):
        for (entry,) in np.argwhere(np.atleast_1d(mask)):
            yield LimitName(labels[entry], word)

    variables = chosen.variables
    return [
        *nodal(variables.states, [(name, word) for name in problem.state_names]),
        *nodal(variables.controls, [(name, word) for name in problem.control_names]),
        *whole(variables.final_time, ["final time"]),
        *nodal(chosen.path, [(name, "margin") for name in path]),
        *nodal(chosen.between, watched, between=True),
        *whole(chosen.integral, list(problem.integrals)),
    ]


def flat(values: PyTree) -> np.ndarray:
    """All numbers of a tree in one row: of limits, in the order of the names."""
    return np.concatenate([np.ravel(leaf) for leaf in jax.tree.leaves(values)])


def sizes(scaling: Scaling, like: PerLimit) -> PerLimit:
    """The scale of each quantity that has limits."""
    scales = PerLimit(
        Variables(scaling.state[None], scaling.control[None], scaling.time),
        scaling.path[None],
        scaling.between[None],
        scaling.integral,
    )
    return jax.tree.map(
        lambda scale, leaf: np.broadcast_to(scale, leaf.shape), scales, like
    )
