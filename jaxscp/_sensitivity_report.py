"""`sensitivity_report`: whether an optimum has derivatives, and how far they reach."""

from collections.abc import Callable, Iterator, Mapping
from itertools import groupby
from typing import Any

import equinox as eqx
import numpy as np

from ._direction import direction as direction_of
from ._free_intervals import lifted
from ._limit_names import LimitName, flat, names_at, sizes
from ._problem import OptimalControlProblem
from ._regularity import Regularity, regularity
from ._response import Response, response
from ._solution import Solution, check_polished
from ._transcription import Transcription
from ._tree import constant
from ._types import ArrayLike, PyTree

# Beyond this the matrix of the conditions is singular as far as can be told.
_SINGULAR = 1e14


class Standing(eqx.Module):
    """How one limit stands at an optimum.

    - `limit`: which one. `unit`: of its slack.
    - `multiplier`: objective per unit. `slack`: way to the limit. Neither is negative.
    - `margin`: the larger one of both, scaled: zero is weakly active.
    """

    limit: LimitName
    unit: str = eqx.field(static=True)
    multiplier: float
    slack: float
    margin: float

    def __str__(self) -> str:
        slack = f"{self.slack:.3g} {self.unit}".rstrip()
        return f"{self.limit}: multiplier {self.multiplier:.3g}, slack {slack}"


class SensitivityReport(eqx.Module):
    """What [`sensitivity_report`][] found; print it.

    - `active`, `weakly_active`: the limits that hold, and those of which neither
        multiplier nor slack is positive.
    - `nearest`: the limit closest to being weakly active: its margin is how strict
        complementarity is. `None` if the problem has no inequalities.
    - `convexity`: least curvature of the Lagrangian along dynamics and active limits,
        scaled: positive at a strict minimum (second-order sufficiency).
    - `condition`: estimate of that of the optimality conditions' matrix.
    - `ahead`, `behind`: derivatives along the direction to either side, and how far they
        reach; `None` without a direction. At a regular optimum both derivatives agree.
    """

    active: tuple[Standing, ...]
    weakly_active: tuple[Standing, ...]
    nearest: Standing | None
    convexity: float
    condition: float
    ahead: Response | None
    behind: Response | None

    @property
    def margin(self) -> float:
        """Of strict complementarity, scaled; infinite without inequalities."""
        return np.inf if self.nearest is None else self.nearest.margin

    @property
    def regular(self) -> bool:
        """Whether the optimum has derivatives."""
        return not self.doubts

    @property
    def doubts(self) -> tuple[str, ...]:
        """Why it may have none, a sentence each."""
        found = [f"Weakly active: {each}." for each in _grouped(self.weakly_active)]
        if not self.convexity > 0.0:
            found.append("The second-order condition of a strict minimum is not met.")
        if not self.condition < _SINGULAR:
            found.append("The active constraints depend on each other.")
        return tuple(found)

    def __str__(self) -> str:
        rows = {"regular": "yes" if self.regular else "no"}
        text = [f"{name:18}{value}" for name, value in (rows | self._figures()).items()]
        text += [f"{'':18}{doubt}" for doubt in self.doubts]
        text += [f"{'active limits':18}{len(self.active)}"]
        text += [f"{'':18}{limits}" for limits in _grouped(self.active)]
        for name, answer in (("ahead", self.ahead), ("behind", self.behind)):
            if answer is not None:
                text.append(f"{name:18}{answer}")
        return "\n".join(text)

    def _figures(self) -> dict[str, str]:
        strict = f"margin {self.margin:.1e}"
        if self.nearest is not None:
            strict += f": {self.nearest}"
        return {
            "strictness": strict,
            "second order": f"least curvature {self.convexity:.1e}",
            "condition": f"at least {self.condition:.1e}",
        }


def sensitivity_report(
    parameters: PyTree,
    solution: Solution,
    direction: Mapping[str, ArrayLike] | None = None,
    *,
    build: Callable[[Any], OptimalControlProblem] = lambda problem: problem,
    weak: float = 1e-6,
) -> SensitivityReport:
    """Whether an optimum has derivatives, which limits decide that, how far they reach.

    Derivatives of a solution are those of its active set. The report names it, says how
    far each limit is from changing sides, and whether the point is a strict minimum. With
    a direction it tells at which share of it the active set changes, to first order; and
    where a limit is weakly active it finds the derivatives to either side.

    **Arguments:**

    - `parameters`: the problem that was solved, or what `build` makes it of, as a mission
        with `build=Mission.problem`.
    - `solution`: a polished one.
    - `direction`: what to change by how much, by dotted paths, such as
        `{"final_state.upper": 1.0, "final_state.lower": 1.0}`, or `{"final_state": 1.0}`
        for both, or of a mission `{"channel.ground_station": [1.0, 0.0, 0.0]}`.
    - `weak`: scaled multipliers and slacks below are zero.

    **Raises:** `ValueError` for a solution that is not polished, a path that names no
    parameter, and a change of the wrong shape.
    """
    check_polished(solution)
    solution = constant(solution)
    found = regularity(solution.transcription, solution.optimum)
    answers: dict[str, Response | None] = {"ahead": None, "behind": None}
    if direction is not None:
        way = direction_of(parameters, direction)
        tangent = _tangent(solution, parameters, way, build)
        for name, side in (("ahead", 1), ("behind", -1)):
            answers[name] = response(solution, found, tangent, weak, side)
    margins = [flat(margin) for margin in found.margins]
    nearest = min(np.min(each, initial=np.inf) for each in margins)
    active = [
        (flat(multiplier) > weak) & np.isfinite(flat(slack))
        for multiplier, slack in zip(found.multipliers, found.slacks, strict=True)
    ]
    weakly = [m <= weak for m in margins]
    least = [(m == nearest) & (m < np.inf) for m in margins]
    one = _standing(solution, found, least)
    return SensitivityReport(
        active=_standing(solution, found, active),
        weakly_active=_standing(solution, found, weakly),
        nearest=one[0] if one else None,
        convexity=float(found.convexity),
        condition=float(found.condition),
        **answers,
    )


def _tangent(
    solution: Solution, parameters: PyTree, way: PyTree, build: Callable
) -> PyTree:
    """How the discrete problem changes along a direction."""

    def posed(parameters: PyTree) -> Transcription:
        grid, settings = solution.trajectory.fractions, solution.discretization
        own = Transcription(build(parameters), settings, grid)
        if settings.interval_ratio is None:
            return own
        return lifted(own, solution.trajectory)[0]

    return eqx.filter_jvp(posed, (parameters,), (way,))[1]


def _standing(
    solution: Solution, found: Regularity, masks: list[np.ndarray]
) -> tuple[Standing, ...]:
    """How the limits stand that masks choose, lower ones first."""
    scaling, problem = solution.optimum.scaling, solution.transcription.problem
    scales = flat(sizes(scaling, solution.optimum.sides))
    objective = float(scaling.objective)
    result: list[Standing] = []
    for side, mask in enumerate(masks):
        names = names_at(solution, side, mask)
        own, way = flat(found.multipliers[side]), flat(found.slacks[side])
        for limit, place in zip(names, np.flatnonzero(mask), strict=True):
            scale = float(scales[place])
            result.append(
                Standing(
                    limit,
                    problem.unit_of_entry(limit.name),
                    multiplier=float(own[place]) * objective / scale,
                    slack=float(way[place]) * scale,
                    margin=float(max(own[place], way[place])),
                )
            )
    return tuple(result)


def _grouped(standings: tuple[Standing, ...]) -> Iterator[str]:
    """Limits with all their nodes, a line each."""
    by_kind = sorted(standings, key=lambda each: each.limit.kind)
    for kind, group in groupby(by_kind, key=lambda each: each.limit.kind):
        nodes = sorted({e.limit.node for e in group if e.limit.node is not None})
        where = f": {_ranges(nodes)}" if nodes else ""
        yield f"{kind}{where}"


def _ranges(nodes: list[int]) -> str:
    """Numbers, with those that follow each other together."""
    runs = groupby(enumerate(nodes), key=lambda pair: pair[1] - pair[0])
    ends = [[node for _, node in run] for _, run in runs]
    return ", ".join(
        str(run[0]) if len(run) == 1 else f"{run[0]} to {run[-1]}" for run in ends
    )
