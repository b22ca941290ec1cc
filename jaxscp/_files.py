"""Files of solutions and of sweeps: checked when read back."""

import io
import zipfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

from ._trajectory import Trajectory
from ._writing import write_bytes
from .missions import Mission

KEYS = ("time", "state", "control", "final_time", "mission")


def save(path: str | Path, mission: Mission, trajectory: Trajectory) -> None:
    """Write a mission and its trajectory as an npz file.

    Entries: `time` (N,) [s], `state` (N, n) and `control` (N, m) in SI units and the
    problem's order, `final_time` [s], `mission` (JSON text).
    """
    content = npz_bytes(
        time=np.asarray(trajectory.times),
        state=np.asarray(trajectory.states),
        control=np.asarray(trajectory.controls),
        final_time=np.asarray(trajectory.final_time),
        mission=np.asarray(mission.to_json()),
    )
    write_bytes(path, content)


def load(path: str | Path) -> tuple[Mission, Trajectory]:
    """Read back what [`save`][] wrote.

    **Raises:** `ValueError` if the file is missing, truncated or not of this kind.
    """
    entries = read_npz(path, KEYS, "`jaxscp solve --save`")
    try:
        mission = Mission.from_json(str(entries["mission"]))
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(f"{path}: its mission cannot be read: {error}") from error
    time, final_time = entries["time"], entries["final_time"]
    state, control = entries["state"], entries["control"]
    problem = mission.problem()
    nodes = time.size
    expected = {
        "time": (nodes,),
        "final_time": (),
        "state": (nodes, problem.state_size),
        "control": (nodes, problem.control_size),
    }
    for name, shape in expected.items():
        entry = entries[name]
        if entry.shape != shape or not np.issubdtype(entry.dtype, np.floating):
            raise ValueError(
                f"{path}: {name} has shape {entry.shape} and type {entry.dtype}; this "
                f"mission needs floats of shape {shape}."
            )
        if not np.isfinite(entry).all():
            raise ValueError(f"{path}: {name} is not finite; there is no flight in it.")
    rises = nodes >= 2 and time[0] == 0.0 and bool(np.all(np.diff(time) > 0))
    if not rises or not np.isclose(time[-1], final_time, rtol=1e-9, atol=0.0):
        raise ValueError(
            f"{path}: time must rise strictly from 0 to final_time={float(final_time):g}."
        )
    return mission, Trajectory(
        fractions=jnp.asarray(time / time[-1]),
        states=jnp.asarray(state),
        controls=jnp.asarray(control),
        final_time=jnp.asarray(final_time),
    )


def read_npz(path: str | Path, keys: Sequence[str], writer: str) -> dict[str, np.ndarray]:
    """Entries of an npz file, complete and without running anything in it.

    **Arguments:**

    - `writer`: what writes such files, for the error.

    **Raises:** `ValueError` if the file is missing, truncated or lacks one of them.
    """
    if not Path(path).is_file():
        raise ValueError(f"{path}: no such file.")
    # NumPy would take anything else for a pickle.
    if not zipfile.is_zipfile(path):
        raise ValueError(f"{path}: not a complete npz file; write one with {writer}.")
    try:
        with np.load(path, allow_pickle=False) as archive:
            missing = [key for key in keys if key not in archive]
            if missing:
                raise ValueError(f"it lacks {', '.join(missing)}")
            return {key: archive[key] for key in keys}
    # A damaged archive makes zipfile and NumPy raise nearly every kind of exception.
    except Exception as error:
        raise ValueError(f"{path}: not a file of {writer} ({error}).") from error


def npz_bytes(**entries: Any) -> bytes:
    """The content of an npz file."""
    content = io.BytesIO()
    np.savez(content, **entries)
    return content.getvalue()
