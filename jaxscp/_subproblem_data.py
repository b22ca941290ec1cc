"""What a subproblem is made of, and how it travels to the host."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from ._convexification import Curvature
from ._model import Model
from ._transcription import Derivatives, Residuals, Variables
from ._types import Array, Float, Scalar


class Limits(eqx.Module):
    """Scaled limits of the step and of the integrals; equal where they are fixed."""

    state: tuple[Float[Array, "N n"], Float[Array, "N n"]]
    control: tuple[Float[Array, "M m"], Float[Array, "M m"]]
    time: tuple[Float[Array, "1"], Float[Array, "1"]]
    integral: tuple[Float[Array, " q"], Float[Array, " q"]]


class Prices(eqx.Module):
    """What a subproblem charges beyond the model's cost, all scaled.

    - `proximal`: weight of half the squared step, the soft trust region.
    - `virtual_control`: cost of virtual control, where there is any.
    - `path`, `integral`: cost of virtual buffers.
    - `radius`: of the hard trust region, where there is one.

    And how exactly it is to be solved:

    - `precision`: absolute tolerance on residuals and duality gap.
    """

    proximal: Scalar
    virtual_control: Float[Array, "I n"]
    path: Float[Array, "N p"]
    integral: Float[Array, " q"]
    radius: Scalar
    precision: Scalar


class SubproblemData(eqx.Module):
    """What travels to the host; the curvature has the proximal term in it."""

    residuals: Residuals
    derivatives: Derivatives
    curvature: Curvature
    gradient: Variables
    prices: Prices
    limits: Limits

    @classmethod
    def of(cls, model: Model, prices: Prices, limits: Limits) -> "SubproblemData":
        nodes, size, _ = model.curvature.blocks.shape
        proximal = prices.proximal / nodes * jnp.eye(size)
        curvature = Curvature(
            model.curvature.blocks + proximal[None],
            model.curvature.border,
            # The flight time moves every node: it counts once for each of them.
            model.curvature.corner + prices.proximal,
        )
        linear = (model.residuals, model.derivatives)
        return cls(*linear, curvature, model.gradient, prices, limits)


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
