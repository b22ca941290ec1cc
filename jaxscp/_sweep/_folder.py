"""`Folder`: where a sweep keeps its points, each as soon as it is solved."""

import hashlib
import json
from pathlib import Path
from typing import Any

from .._files import npz_bytes, read_npz
from .._writing import check_folder, write_bytes
from ._record import COLUMNS, FLIGHT, Record

MANIFEST = "sweep.json"
_KEYS = (*COLUMNS, *FLIGHT, "sweep")


class Folder:
    """A folder with a manifest, which says what is swept, and a file for each point.

    **Arguments:**

    - `path`: a folder to make, or of the same sweep begun earlier.
    - `manifest`: what is swept, as JSON has it, with "format" and "jaxscp", the versions.

    **Raises:** `ValueError` if it holds something else, or cannot be written.
    """

    def __init__(self, path: str | Path, manifest: dict[str, Any]):
        self._path, self._count = Path(path), len(manifest["points"])
        check_folder("folder", path)
        if (self._path / MANIFEST).exists():
            self._check(manifest)
        else:
            self._begin(manifest)
        # Of what is there: equal manifests may be written differently, as 3 and 3.0.
        content = (self._path / MANIFEST).read_bytes()
        self._digest = hashlib.sha256(content).hexdigest()

    def keep(self, index: int, record: Record) -> None:
        """Write a point's file."""
        write_bytes(self._file(index), npz_bytes(**vars(record), sweep=self._digest))

    def found(self) -> dict[int, Record]:
        """Points that are there, by number.

        **Raises:** `ValueError` naming a file that is damaged or of another sweep.
        """
        files = {index: self._file(index) for index in range(self._count)}
        return {i: self._read(path) for i, path in files.items() if path.exists()}

    def _read(self, path: Path) -> Record:
        entries = read_npz(path, _KEYS, "`jaxscp.sweep`; remove it to solve it again")
        if str(entries.pop("sweep")) != self._digest:
            raise ValueError(f"{path}: is a point of another sweep; remove it.")
        return Record.of_entries(entries)

    def _begin(self, manifest: dict[str, Any]) -> None:
        # A process that was killed leaves hidden files.
        others = [
            entry.name for entry in self._path.iterdir() if not entry.name.startswith(".")
        ]
        if others:
            raise ValueError(
                f"folder {self._path}: has no {MANIFEST} but {min(others)}; choose an "
                "empty folder."
            )
        text = json.dumps(manifest, indent=1, allow_nan=False)
        write_bytes(self._path / MANIFEST, f"{text}\n".encode())

    def _check(self, manifest: dict[str, Any]) -> None:
        path = self._path / MANIFEST
        try:
            found = json.loads(path.read_bytes())
            differing = [name for name in manifest if found[name] != manifest[name]]
        except (ValueError, TypeError, KeyError) as error:
            raise ValueError(
                f"{path}: not the manifest of a sweep ({error!r}); choose another folder."
            ) from error
        if differing:
            name = differing[0]
            raise ValueError(
                f"{path}: of another sweep, {name}={_short(found[name])}, not "
                f"{_short(manifest[name])}; choose another folder."
            )

    def _file(self, index: int) -> Path:
        return self._path / f"point-{index:06d}.npz"


def _short(value: Any, most: int = 60) -> str:
    text = json.dumps(value)
    return text if len(text) <= most else f"{text[:most]}..."
