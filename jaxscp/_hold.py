"""How a control is defined between the nodes."""

import abc

import equinox as eqx

from ._types import Array, Float, Scalar


class AbstractHold(eqx.Module):
    """A rule that turns nodal controls into a control over time."""

    @abc.abstractmethod
    def control_nodes(self, nodes: int) -> int:
        """How many nodes of `nodes` carry a control of their own."""

    @abc.abstractmethod
    def interpolate(
        self,
        left: Float[Array, " m"],
        right: Float[Array, " m"],
        fraction: Scalar,
    ) -> Float[Array, " m"]:
        """Control at `fraction` (0 to 1) of an interval between two nodes."""


class ZeroOrderHold(AbstractHold):
    """Each control is kept over the interval behind its node (paper, Section III-D)."""

    def control_nodes(self, nodes: int) -> int:
        return nodes - 1

    def interpolate(self, left, right, fraction):
        del right, fraction
        return left


class FirstOrderHold(AbstractHold):
    """Controls vary linearly between their nodes."""

    def control_nodes(self, nodes: int) -> int:
        return nodes

    def interpolate(self, left, right, fraction):
        return left + fraction * (right - left)
