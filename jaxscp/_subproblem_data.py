"""What a subproblem is made of, and how it travels to the host."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from ._curvature import Curvature
from ._damping import Damping
from ._model import Model, cost_gradient
from ._transcription import Derivatives, Residuals, Variables
from ._types import Array, Float, Scalar


class Limits(eqx.Module):
    """Scaled limits of the step and of the integrals; equal where they are fixed."""

    state: tuple[Float[Array, "N n"], Float[Array, "N n"]]
    control: tuple[Float[Array, "M m"], Float[Array, "M m"]]
    time: tuple[Float[Array, "1"], Float[Array, "1"]]
    integral: tuple[Float[Array, " q"], Float[Array, " q"]]

    @property
    def ends(self) -> tuple[Variables, Variables]:
        """The lower and the upper limits of the step."""
        low, high = (
            Variables(self.state[side], self.control[side], self.time[side][0])
            for side in (0, 1)
        )
        return low, high


class Prices(eqx.Module):
    """What a subproblem charges for virtual variables, all scaled.

    - `virtual_control`: where there is any.
    - `path`: of the virtual buffers of path constraints, which a node shares with the
        interval behind it. `limit`: of those of the state's limits between the nodes,
        where there are any. `integral`: of those of integrals.
    - `radius`: of the hard trust region, where there is one.

    And how exactly it is to be solved:

    - `precision`: absolute tolerance on residuals and duality gap.
    - `relax`: whether virtual control may be bought where the dynamics cannot be met.
    """

    virtual_control: Float[Array, "I n"]
    path: Float[Array, "N p"]
    limit: Float[Array, "I e"]
    integral: Float[Array, " q"]
    radius: Scalar
    precision: Scalar
    relax: Scalar


class SubproblemData(eqx.Module):
    """What travels to the host.

    - `curvature`, `gradient`: of the cost, the damping included.
    - `of_totals`: second and, at zero, first derivatives by the integrals' totals.
    """

    residuals: Residuals
    derivatives: Derivatives
    curvature: Curvature
    gradient: Variables
    of_totals: tuple[Float[Array, " q"], Float[Array, " q"]]
    prices: Prices
    limits: Limits

    @classmethod
    def of(
        cls, model: Model, damping: Damping, prices: Prices, limits: Limits
    ) -> "SubproblemData":
        return cls(
            model.residuals,
            model.derivatives,
            model.curvature.plus(damping.curvature(model)),
            damped_gradient(model, damping),
            damping.of_totals,
            prices,
            limits,
        )


def damped_gradient(model: Model, damping: Damping) -> Variables:
    """First derivatives of the cost with its damping, where the step is zero."""
    slope = cost_gradient(model.derivatives)
    still = jax.tree.map(jnp.zeros_like, damping.step)
    added = jax.grad(lambda step: damping.value(model, step))(still)
    return jax.tree.map(jnp.add, slope, added)


@dataclasses.dataclass(frozen=True)
class Outline:
    """Shapes of a [`SubproblemData`][], to cut it from a vector."""

    tree: jax.tree_util.PyTreeDef
    shapes: tuple[tuple[int, ...], ...]

    @classmethod
    def of(cls, data: SubproblemData) -> "Outline":
        leaves, tree = jax.tree.flatten(data)
        return cls(tree, tuple(leaf.shape for leaf in leaves))

    @property
    def size(self) -> int:
        return sum(int(np.prod(shape)) for shape in self.shapes)

    def cut(self, flat: np.ndarray) -> SubproblemData:
        """The blocks of a vector that has one leaf after the other."""
        ends = np.cumsum([int(np.prod(shape)) for shape in self.shapes])[:-1]
        parts = zip(np.split(flat, ends), self.shapes, strict=True)
        return jax.tree.unflatten(self.tree, [part.reshape(to) for part, to in parts])
