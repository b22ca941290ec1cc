"""The points of a sweep: which values a mission takes, and in which order."""

import itertools
import json
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from .. import missions
from .._records import plain, unknown_path
from ..missions import Mission

# Path to value, as JSON has it: what a mission changes to.
Point = dict[str, Any]


def points_of(
    mission: Mission, values: Mapping[str, Any] | Sequence[Mapping[str, Any]]
) -> tuple[Point, ...]:
    """Every combination of the values, the last path's changing first; or those listed.

    **Raises:** `ValueError` for no point at all, an unknown path, or points of a list
    that differ in their paths.
    """
    listed = _combined(values) if isinstance(values, Mapping) else list(values)
    if not listed or not listed[0]:
        raise ValueError(
            f"values={values!r}: there is nothing to solve; give at least one path with "
            "a value."
        )
    first, valid = listed[0], missions.paths(mission)
    for path in first:
        if path not in valid:
            raise unknown_path(path, valid)
    for index, point in enumerate(listed):
        if set(point) != set(first):
            raise ValueError(
                f"values[{index}] has the paths {', '.join(point) or 'none'}, and "
                f"values[0] {', '.join(first)}; give each point a value of every path."
            )
    return tuple({path: plain(point[path]) for path in first} for point in listed)


def missions_of(
    mission: Mission, points: Sequence[Point]
) -> tuple[Mission | ValueError, ...]:
    """The mission of each point, or why there is none: values may exclude each other.

    **Raises:** `ValueError` for a value that no point's mission can have.
    """
    built = tuple(_mission_of(mission, point) for point in points)
    for path in points[0]:
        texts = [json.dumps(point[path]) for point in points]
        possible = {
            text
            for text, each in zip(texts, built, strict=True)
            if isinstance(each, Mission)
        }
        for text, each in zip(texts, built, strict=True):
            if isinstance(each, ValueError) and text not in possible:
                raise each
    return built


def lines_of(points: Sequence[Point], along: str | None) -> tuple[tuple[int, ...], ...]:
    """Points, by number, that are solved one after another.

    They differ in the value of `along` only; without it each is by itself.

    **Raises:** `ValueError` if `along` is none of the points' paths.
    """
    if along is None:
        return tuple((index,) for index in range(len(points)))
    if along not in points[0]:
        raise ValueError(
            f"along={along!r}: not swept over; choose one of {', '.join(points[0])}."
        )
    lines: dict[str, list[int]] = {}
    for index, point in enumerate(points):
        others = {path: value for path, value in point.items() if path != along}
        lines.setdefault(json.dumps(others), []).append(index)
    return tuple(map(tuple, lines.values()))


def _combined(values: Mapping[str, Any]) -> list[Point]:
    columns = []
    for path, column in values.items():
        scalar = isinstance(column, np.ndarray) and not column.ndim
        if scalar or isinstance(column, str) or not isinstance(column, Iterable):
            raise ValueError(f"{path}={column!r}: give a list of the values to take.")
        columns.append(list(column))
        if not columns[-1]:
            raise ValueError(f"{path}=[]: there is nothing to solve; give it a value.")
    return [
        dict(zip(values, combination, strict=True))
        for combination in itertools.product(*columns)
    ]


def _mission_of(mission: Mission, point: Point) -> Mission | ValueError:
    try:
        return missions.replace_many(mission, point)
    except ValueError as error:
        return error
