"""Processes of their own: each is given a file and writes what it found, as JSON."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[1]


def run(
    module: str, case: Path, result: Path, *options: str, python: str = sys.executable
) -> dict:
    """What a module of the benchmarks wrote, and the machine's load after it. Its process
    works in the result's folder, where it may leave other files.

    **Arguments:**

    - `python`: an interpreter that has what the module needs.

    Raises a ChildProcessError with the last line of its complaint.
    """
    result.unlink(missing_ok=True)
    # Not resolved: the interpreter of an environment is a link.
    interpreter = Path(shutil.which(python) or python).absolute()
    command = [interpreter, "-m", f"benchmarks.{module}", case.absolute(), result]
    paths = filter(None, (str(ROOT), os.environ.get("PYTHONPATH")))
    ended = subprocess.run(
        [*command, *options],
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        cwd=result.parent,
        env=os.environ | {"PYTHONPATH": os.pathsep.join(paths)},
    )
    if not result.exists():
        lines = ended.stderr.strip().splitlines() or [f"exit status {ended.returncode}"]
        raise ChildProcessError(f"{module}: {lines[-1]}")
    return json.loads(result.read_text()) | {"load": os.getloadavg()[0]}
