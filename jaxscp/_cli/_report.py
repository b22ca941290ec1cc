"""A solved mission as JSON and as a short table."""

import math
import platform
from importlib import metadata
from typing import Any

import numpy as np

from .._attempt import Attempt
from .._data_sent import data_sent
from .._solution import Solution
from .._status import name_of
from .._verification import Verification
from ..missions import Mission

PACKAGES = ("jaxscp", "equinox", "jax", "jaxlib", "numpy", "piqp", "scipy")


def as_json(
    mission: Mission,
    solution: Solution,
    verification: Verification,
    seconds: dict[str, float],
) -> dict[str, Any]:
    """What `--json` writes; numbers that are not finite become null.

    `defect_max` is relative to the states' scales. `position_error` [m] and
    `violations` come from the verification: intervals flown again from their nodes, and
    limits checked between the nodes too. `optimality` is the scaled residual of the
    optimality conditions, and `polished` whether it is within the tolerance. `attempts`
    has an entry for each attempt; `verified` is null where it was not asked.
    """
    required = mission.data_required
    report = {
        "mission": mission.name,
        "status": name_of(solution.status),
        "converged": bool(solution.converged),
        "verified": bool(verification.verified),
        "objective": float(solution.objective),
        "final_time": float(solution.trajectory.final_time),
        "data_bits": data_sent(mission, verification),
        "data_required_bits": None if required is None else float(required),
        "defect_max": largest_defect(solution),
        "position_error": position_error(verification),
        "violations": {
            name: {"value": worst.value, "unit": worst.unit, "time": worst.time}
            for name, worst in verification.violations.items()
        },
        "polished": bool(solution.polished),
        "optimality": float(solution.optimality),
        "iterations": int(solution.statistics.iterations),
        "polish_iterations": int(solution.statistics.polish_iterations),
        "subproblems": int(solution.statistics.subproblems),
        "attempts": [_entry(attempt, verification) for attempt in solution.attempts],
        "seconds": seconds,
        "versions": {
            "python": platform.python_version(),
            **{package: _version(package) for package in PACKAGES},
        },
    }
    return finite(report)


def table(
    mission: Mission,
    solution: Solution,
    verification: Verification,
    seconds: dict[str, float],
) -> str:
    """The result for a person to read, about ten lines, and one for each attempt."""
    statistics = solution.statistics
    rows = {
        "mission": mission.name,
        "status": solution.message,
        "objective": f"{float(solution.objective):,.2f} N^2 s",
        "final time": f"{float(solution.trajectory.final_time):.3f} s",
        "data": _data(mission, verification),
        "position error": f"{position_error(verification):.2e} m in the worst interval",
        "verified": "yes" if verification.verified else "no",
        "optimality": f"{float(solution.optimality):.1e}, the scaled residual",
        "effort": f"{int(statistics.iterations)} iterations and "
        f"{int(statistics.polish_iterations)} to polish, "
        f"{int(statistics.subproblems)} subproblems",
        "seconds": ", ".join(f"{name} {spent:.2f}" for name, spent in seconds.items()),
    }
    lines = [f"{name:15} {text}" for name, text in rows.items()]
    if len(solution.attempts) > 1:
        lines += [
            f"{f'attempt {number}':15} {attempt}"
            for number, attempt in enumerate(solution.attempts, 1)
        ]
    for name, worst in verification.violations.items():
        where = "at nodes" if name in verification.node_violations else "between nodes"
        lines.append(
            f"{where:15} {name} broken by {worst.value:.2e} {worst.unit}"
            f" at {worst.time:.2f} s"
        )
    return "\n".join(lines)


def progress_line(row: dict[str, Any]) -> str:
    """One iteration of a solve in progress; its first line carries the headings, from
    the second attempt on under the attempt's number.
    """
    columns = {
        "iteration": "d",
        "objective": ".6g",
        "penalized_cost": ".6g",
        "predicted_reduction": ".2e",
        "actual_reduction": ".2e",
        "ratio": ".3f",
        "radius": ".2e",
        "defect": ".2e",
        "buffer": ".2e",
    }
    width = 11
    values = {
        name: int(row[name]) if form == "d" else float(row[name])
        for name, form in columns.items()
    }
    line = " ".join(f"{values[name]:>{width}{form}}" for name, form in columns.items())
    if values["iteration"] > 1:
        return line
    # "penalized_cost" and its like are cut to their first words.
    headings = " ".join(f"{name.partition('_')[0]:>{width}}" for name in columns)
    attempt = int(row["attempt"])
    title = f"attempt {attempt + 1}\n" if attempt else ""
    return f"{title}{headings}\n{line}"


def position_error(verification: Verification) -> float:
    """Largest distance [m] of a re-flown interval's end from the node there."""
    errors = np.asarray(verification.interval_errors)[:, :3]
    return float(np.max(np.linalg.norm(errors, axis=1)))


def largest_defect(solution: Solution) -> float:
    """Largest defect of the last iterate, relative to the states' scales."""
    scales, _, _ = solution.violations.scales
    defects = np.abs(np.asarray(solution.violations.dynamics))
    return float(np.max(defects / np.asarray(scales)))


def _data(mission: Mission, verification: Verification) -> str:
    text = f"{data_sent(mission, verification) / 1e6:.3f} Mbit"
    if mission.data_required is None:
        return f"{text}, none required"
    return f"{text} of {float(mission.data_required) / 1e6:.3f} Mbit required"


def _entry(attempt: Attempt, verification: Verification) -> dict[str, Any]:
    """The solve from one guess; the one chosen is verified here in any case."""
    chosen = bool(attempt.chosen)
    return {
        "objective": float(attempt.objective),
        "status": name_of(attempt.status),
        "converged": bool(attempt.converged),
        "verified": bool(verification.verified) if chosen else attempt.verified,
        "chosen": chosen,
    }


def _version(package: str) -> str | None:
    """None for a package that runs from its source tree without being installed."""
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return None


def finite(value: Any) -> Any:
    """The same tree with null where JSON has no number."""
    if isinstance(value, dict):
        return {name: finite(entry) for name, entry in value.items()}
    if isinstance(value, list):
        return [finite(entry) for entry in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
