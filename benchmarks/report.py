"""How every benchmark writes its numbers."""

import json
import os
import platform
from importlib.metadata import version
from pathlib import Path

PACKAGES = ("jax", "jaxlib", "piqp", "numpy", "equinox")


def write_report(path: Path, **numbers) -> None:
    """Numbers as JSON, with the machine and the versions that gave them."""
    facts = {
        "machine": platform.machine(),
        "cores": os.cpu_count(),
        "python": platform.python_version(),
        "versions": {package: version(package) for package in PACKAGES},
    }
    path.write_text(json.dumps({"facts": facts, **numbers}, indent=2) + "\n")
