"""`Sweep`: what came of many missions, as a table and trajectories."""

import csv
import dataclasses
import io
import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from .. import missions
from .._files import npz_bytes, read_npz
from .._trajectory import Trajectory
from .._writing import write_bytes
from ..missions import Mission
from ._points import Point
from ._record import COLUMNS, FLIGHT, Record

FORMAT = 1
_WRITER = "`Sweep.to_npz`"
# Rows and errors that are printed, and the columns after the paths.
_MOST_ROWS, _MOST_ERRORS = 40, 5
_SHOWN = ("status", "verified", "objective", "final_time", "seconds")


@dataclasses.dataclass(frozen=True, eq=False)
class Sweep:
    """Missions that were solved together: `print` shows a short table.

    - `manifest`: what was swept, as JSON has it: the mission, its points, `along`, the
        settings, and the versions.
    - `table`: a row for each point, read-only. Its columns: every path, NaN where the
        value is None, JSON text where values differ in their shape; then `status`, the
        name of a [`Status`][], or "raised"; `converged`, `polished`, `verified`;
        `objective`; `final_time` [s]; `data` [bit]; `iterations`, of convex subproblems,
        `polish_iterations`; `seconds`, of solve and check, compilation included; `error`,
        why it is not converged and verified, or empty.
    - `trajectories`: of each point the last iterate, None where the solve raised.
    """

    manifest: dict[str, Any]
    table: np.ndarray
    trajectories: tuple[Trajectory | None, ...]

    @classmethod
    def of_records(cls, manifest: dict[str, Any], records: Sequence[Record]) -> "Sweep":
        """From what each point led to, in the order of the manifest."""
        columns = _path_columns(manifest["points"]) | {
            name: np.array([getattr(record, name) for record in records])
            for name in COLUMNS
        }
        kinds = [(name, each.dtype, each.shape[1:]) for name, each in columns.items()]
        table = np.empty(len(records), kinds)
        for name, column in columns.items():
            table[name] = column
        table.setflags(write=False)
        return cls(manifest, table, tuple(record.trajectory for record in records))

    @property
    def points(self) -> tuple[Point, ...]:
        """What each point changes in the mission, by path."""
        return tuple(self.manifest["points"])

    @property
    def succeeded(self) -> np.ndarray:
        """Which points converged and were verified."""
        return self.table["converged"] & self.table["verified"]

    def mission(self, index: int) -> Mission:
        """The mission of one point.

        **Raises:** `ValueError` where its values exclude each other.
        """
        base = Mission.from_json(json.dumps(self.manifest["mission"]))
        return missions.replace_many(base, self.points[index])

    def __len__(self) -> int:
        return len(self.table)

    def __str__(self) -> str:
        names = (*self.points[0], *_SHOWN)
        rows = [("point", *names)]
        for index, row in enumerate(self.table):
            rows.append((str(index), *(_shown(row[name]) for name in names)))
        widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
        lines = [
            "  ".join(f"{cell:>{w}}" for cell, w in zip(row, widths, strict=True))
            for row in rows
        ]
        if len(self) > _MOST_ROWS:
            half = _MOST_ROWS // 2
            lines[half + 1 : -half] = [f"... {len(self) - 2 * half} more ..."]
        failed = np.flatnonzero(~self.succeeded)
        for index in failed[:_MOST_ERRORS]:
            lines.append(f"point {index}: {self.table['error'][index]}")
        good = len(self) - len(failed)
        return "\n".join([*lines, f"{good} of {len(self)} converged and verified"])

    def to_csv(self, path: str | Path) -> None:
        """Write the table; vectors take a column for each entry, as in `goal[0]`."""
        text = io.StringIO()
        writer = csv.writer(text, lineterminator="\n")
        columns = list(_flat(self.table))
        writer.writerow([name for name, _ in columns])
        writer.writerows(zip(*(column.tolist() for _, column in columns), strict=True))
        write_bytes(path, text.getvalue().encode())

    def to_npz(self, path: str | Path) -> None:
        """Write everything; [`Sweep.load`][] reads it.

        Entries: `sweep`, the manifest as JSON text; `table`; `flown` (P,), which of the
        P points have a trajectory; of those `fractions` (K, N), `states` (K, N, n),
        `controls` (K, N, m) and `final_time` (K,) [s].
        """
        flown = [flight for flight in self.trajectories if flight is not None]
        arrays = {
            name: np.array([getattr(flight, name) for flight in flown])
            for name in (*FLIGHT, "final_time")
        }
        there = np.array([flight is not None for flight in self.trajectories])
        text = json.dumps(self.manifest, allow_nan=False)
        write_bytes(path, npz_bytes(sweep=text, table=self.table, flown=there, **arrays))

    @classmethod
    def load(cls, path: str | Path) -> "Sweep":
        """Read back what [`Sweep.to_npz`][] wrote.

        **Raises:** `ValueError` if the file is missing, truncated, not of this kind, or
        of another version of the format.
        """
        keys = ("sweep", "table", "flown", *FLIGHT, "final_time")
        entries = read_npz(path, keys, _WRITER)
        try:
            manifest = json.loads(str(entries["sweep"]))
            written = manifest["format"]
        except (ValueError, TypeError, KeyError) as error:
            raise ValueError(f"{path}: not a file of {_WRITER} ({error!r}).") from error
        if written != FORMAT:
            raise ValueError(
                f"{path}: has format {written}, and this version reads {FORMAT}; sweep "
                "again."
            )
        table, flown = entries["table"], entries["flown"]
        table.setflags(write=False)
        arrays = zip(*(entries[name] for name in keys[3:]), strict=True)
        flights = iter([Trajectory(*each) for each in arrays])
        return cls(manifest, table, tuple(next(flights) if f else None for f in flown))


def _path_columns(points: Sequence[Point]) -> dict[str, np.ndarray]:
    return {path: _column([point[path] for point in points]) for path in points[0]}


def _column(values: list[Any]) -> np.ndarray:
    """Of numbers, or of vectors, where the shapes allow it; else of JSON text."""
    shapes = {np.shape(value) for value in values if value is not None}
    if len(shapes) == 1:
        (shape,) = shapes
        nothing = np.full(shape, np.nan)
        return np.array([nothing if v is None else v for v in values], float)
    return np.array([json.dumps(value) for value in values])


def _flat(table: np.ndarray) -> Iterator[tuple[str, np.ndarray]]:
    """Columns with a value a row."""
    for name in table.dtype.names or ():
        column = table[name]
        if column.ndim == 1:
            yield name, column
            continue
        for index in np.ndindex(column.shape[1:]):
            where = ",".join(map(str, index))
            yield f"{name}[{where}]", column[(slice(None), *index)]


def _shown(value: Any) -> str:
    if isinstance(value, np.bool_):
        return "yes" if value else "no"
    if isinstance(value, np.ndarray):
        return f"[{', '.join(f'{entry:.6g}' for entry in value.ravel())}]"
    return f"{value:.7g}" if isinstance(value, np.floating) else str(value)
