"""`Verification`: what re-propagating a trajectory found."""

import dataclasses
from collections.abc import Iterator

import numpy as np
from jaxtyping import Float

from ._limit_checks import Violation


@dataclasses.dataclass(frozen=True)
class Dense:
    """The re-propagated trajectory, sampled along every interval.

    Both ends of an interval are among its samples, so each inner node is there twice:
    as the end of one interval and as the start of the next. A held control jumps there.

    - `times` [s], `states`, `controls`: the samples.
    - `integrands`, `accumulated`: each integral's integrand and its value so far.
    """

    times: Float[np.ndarray, " K"]
    states: Float[np.ndarray, "K n"]
    controls: Float[np.ndarray, "K m"]
    integrands: dict[str, Float[np.ndarray, " K"]]
    accumulated: dict[str, Float[np.ndarray, " K"]]


@dataclasses.dataclass(frozen=True)
class Verification:
    """What re-propagation found.

    - `verified`: whether everything is finite, every interval ends at its next node,
        and no limit is broken at the nodes or by an integral (nor between the nodes, if
        that was asked for).
    - `interval_errors`: distance of the flow's end from the next node, state units; NaN
        where the flow cannot be followed.
    - `interval_tolerances`: what was allowed of it.
    - `flight_error`: the same at the end of the flight, from the first node under the
        nodes' controls; `None` if that strays too far to mean anything. Not judged: an
        open loop may be unstable.
    - `objective`, `integrals`: costs and totals along the flow.
    - `node_violations`: limits broken at nodes, by boundaries, time or integrals.
    - `violations`: the same, with limits and path constraints also between the nodes.
    - `dense`: the samples between the nodes.
    - `times` [s], `state_names`: of the nodes, and of the columns above.
    - `units`: of every state and integral, by name.
    """

    verified: bool
    interval_errors: Float[np.ndarray, "I n"]
    interval_tolerances: Float[np.ndarray, " n"]
    flight_error: Float[np.ndarray, " n"] | None
    objective: float
    integrals: dict[str, float]
    node_violations: dict[str, Violation]
    violations: dict[str, Violation]
    dense: Dense
    times: Float[np.ndarray, " N"]
    state_names: tuple[str, ...]
    units: dict[str, str]

    @property
    def worst_interval(self) -> tuple[int, int]:
        """Interval and state with the largest error in units of its tolerance."""
        ratios = self.interval_errors / self.interval_tolerances
        worst = np.argmax(np.where(np.isfinite(ratios), ratios, np.inf))
        interval, state = np.unravel_index(worst, ratios.shape)
        return int(interval), int(state)

    def __str__(self) -> str:
        interval, state = self.worst_interval
        error = self._amount(state, self.interval_errors[interval])
        start = f"interval {interval}, from {self.times[interval]:.3f} s"
        rows = [
            ("verified", "yes" if self.verified else "no"),
            ("objective", f"{self.objective:.6g}"),
            ("final time", f"{self.times[-1]:.6g} s"),
            *(
                (f"integral {name}", f"{total:.6g} {self.units[name]}".rstrip())
                for name, total in self.integrals.items()
            ),
            ("worst interval", f"{error} off after {start}"),
            ("whole flight", self._flight()),
            *_listed("at nodes", self.node_violations),
            *_listed("nodes and between", self.violations),
        ]
        width = max(len(label) for label, _ in rows)
        return "\n".join(f"{label:<{width}}  {text}" for label, text in rows)

    def _flight(self) -> str:
        if self.flight_error is None:
            return "strays from the nodes"
        state = int(np.argmax(self.flight_error / self.interval_tolerances))
        return f"{self._amount(state, self.flight_error)} off at the end"

    def _amount(self, state: int, errors: np.ndarray) -> str:
        name = self.state_names[state]
        return f"{name} {errors[state]:.3g} {self.units[name]}".rstrip()


def _listed(label: str, found: dict[str, Violation]) -> Iterator[tuple[str, str]]:
    if not found:
        yield label, "no limit broken"
    for name, violation in found.items():
        yield label, f"{name} broken by {violation}"
        label = ""
