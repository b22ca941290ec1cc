"""How continuous time becomes nodes and intervals: the settings."""

import enum
import math

import equinox as eqx

from ._hold import AbstractHold, ZeroOrderHold
from ._types import check_kind


class Quadrature(enum.Enum):
    """How costs and integral constraints are accumulated.

    `FLOW` integrates them with the same Runge-Kutta steps as the states. `TRAPEZOID` is
    the paper's eq. 20, a rule on nodal values: the last node then has a control that
    counts in the cost and moves nothing, which an optimizer exploits.
    """

    FLOW = "flow"
    TRAPEZOID = "trapezoid"


class Discretization(eqx.Module):
    """How continuous time becomes nodes and intervals.

    **Arguments:**

    - `hold`: [`ZeroOrderHold`][] or [`FirstOrderHold`][].
    - `quadrature`: [`Quadrature`][] of costs and integral constraints.
    - `between`: parts of each interval in which path constraints and limits of the state
        are enforced too, each at the moment of its largest value there. With 0 they hold
        at the nodes alone, and may be exceeded between them. One part is enough where
        an interval has room for one peak.
    - `interval_ratio`: lets each interval have a duration of its own, free but for those
        of its neighbours: at most so many times as long, or as short. The guess's
        fractions are where it starts. With None they stay as they are. Needs a zero-order
        hold and the quadrature along the flow.
    - `longest_interval`: how long free intervals may become, in mean ones of the guess;
        infinite by default. Where controls are held for long, little changes of them lead
        far away, and a solve needs many iterations. The flight time is then limited to
        that many times the guess's.
    - `tolerance`: error allowed in the states over one interval, and in the integrals
        over all of them, relative to each quantity's scale, or to a cost that is small
        beside its own. The number of Runge-Kutta substeps, the same in all intervals,
        follows the error that comparing with half as many tells.
    - `min_substeps`, `max_substeps`: limits of that number.
    """

    hold: AbstractHold = ZeroOrderHold()
    quadrature: Quadrature = eqx.field(static=True, default=Quadrature.FLOW)
    between: int = eqx.field(static=True, default=0)
    interval_ratio: float | None = eqx.field(static=True, default=None)
    longest_interval: float = eqx.field(static=True, default=math.inf)
    tolerance: float = eqx.field(static=True, default=3e-5)
    min_substeps: int = eqx.field(static=True, default=2)
    max_substeps: int = eqx.field(static=True, default=256)

    def __check_init__(self):
        check_kind("hold", self.hold, AbstractHold, "ZeroOrderHold() or FirstOrderHold()")
        check_kind(
            "quadrature", self.quadrature, Quadrature, "a member of jaxscp.Quadrature"
        )
        for name in ("between", "min_substeps", "max_substeps"):
            check_kind(name, getattr(self, name), int, "a whole number")
        if not self.tolerance > 0:
            raise ValueError(f"tolerance={self.tolerance}: give a positive number.")
        if self.between < 0:
            raise ValueError(
                f"between={self.between}: give the parts of an interval to watch, or 0."
            )
        if not 1 <= self.min_substeps <= self.max_substeps:
            raise ValueError(
                f"min_substeps={self.min_substeps}, max_substeps={self.max_substeps}: "
                "need 1 <= min_substeps <= max_substeps."
            )
        if self.least_substeps > self.max_substeps:
            raise ValueError(
                f"between={self.between}: needs two substeps a part, and max_substeps is "
                f"{self.max_substeps}; raise it, or watch fewer parts."
            )

        if self.interval_ratio is not None:
            self._check_free_intervals(self.interval_ratio)

    def _check_free_intervals(self, ratio: float):
        if not 1.0 < ratio < math.inf:
            raise ValueError(
                f"interval_ratio={ratio}: give a number above 1, or None for durations "
                "that keep to the guess."
            )
        if not self.longest_interval > 1.0:
            raise ValueError(
                f"longest_interval={self.longest_interval}: give a number of mean "
                "intervals above 1, or infinity."
            )
        # Over uneven intervals neither means what it says.
        if self.holds_right:
            raise ValueError(
                f"interval_ratio={ratio}: needs hold=ZeroOrderHold(), not "
                f"{type(self.hold).__name__}()."
            )
        if self.quadrature is not Quadrature.FLOW:
            raise ValueError(
                f"interval_ratio={ratio}: needs quadrature=Quadrature.FLOW, not "
                f"{self.quadrature}."
            )

    def control_nodes(self, nodes: int) -> int:
        """How many nodes have a control of their own."""
        if self.quadrature is Quadrature.TRAPEZOID:
            return nodes
        return self.hold.control_nodes(nodes)

    @property
    def least_substeps(self) -> int:
        """The fewest substeps that a solve may take."""
        return max(self.min_substeps, self.watching_substeps)

    @property
    def watching_substeps(self) -> int:
        """The fewest that see a peak in each part of an interval that is watched: two."""
        return 2 * self.between

    @property
    def holds_right(self) -> bool:
        """Whether the control of an interval depends on the node at its right end."""
        return self.hold.control_nodes(2) == 2
