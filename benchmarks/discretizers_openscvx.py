"""The flow over every interval by OpenSCvx 0.5.2, in a process of its own."""

import json
import tempfile
from pathlib import Path

from . import peer
from .discretizer_case import Case

# Names to the classes of its discretizers and to their steps: Tsit5's as they come, that
# is adaptive to tolerances of 1e-6, relative, and 1e-3, absolute; or equal ones.
OPENSCVX = {
    "OpenSCvx, default": ("VectorizeDiscretizeLinearize", "adaptive"),
    "OpenSCvx, by interval": ("DiscretizeLinearizeVectorize", "adaptive"),
    "OpenSCvx, dense": ("LinearizeDiscretize", "adaptive"),
    "OpenSCvx, sparse": ("LinearizeDiscretizeSparse", "adaptive"),
    "OpenSCvx, sparse, equal steps": ("LinearizeDiscretizeSparse", "Tsit5"),
    "OpenSCvx, by interval, RK45": ("DiscretizeLinearizeVectorize", "RK45"),
}


def runs_of(names: list[str], substeps: tuple[int, ...]) -> list[dict]:
    """One for every number of equal steps, one in all where steps are adaptive."""
    found = []
    for name in names:
        scheme, steps = OPENSCVX[name]
        run = {"discretizer": name, "scheme": scheme, "steps": steps}
        counts = (None,) if steps == "adaptive" else substeps
        found += [run | {"substeps": count} for count in counts]
    return found


def openscvx(
    case: Case, runs: list[dict], python: str, limit: float, compared: bool
) -> list[dict]:
    """The runs with their seconds.

    **Arguments:**

    - `limit`: after so many seconds the runs that remain are left out.
    - `compared`: whether values and Jacobians are wanted, too.
    """
    plain = {
        "mission": case.mission,
        "gathers": case.gathers,
        "states": case.states.tolist(),
        "controls": case.controls.tolist(),
        "final_time": case.final_time,
        "runs": runs,
        "compared": compared,
    }
    with tempfile.TemporaryDirectory() as folder:
        files = Path(folder) / "case.json", Path(folder) / "result.json"
        files[0].write_text(json.dumps(plain))
        options = ("--limit", str(limit))
        return peer.run("openscvx_discretizer", *files, *options, python=python)["rows"]
