"""Programs that other processes have compiled, found without tracing them.

JAX's persistent cache wants to see the lowered program first. Where it has XLA's part,
tracing and lowering are most of a first solve.
"""

import contextlib
import os
import pickle
import threading
import time
import uuid
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.monitoring
from jax.experimental import serialize_executable

from ._cache import whole_programs
from ._fingerprint import fingerprint
from ._host import called_by, register
from ._packed import Packed
from ._pickling import pickled
from ._types import PyTree
from ._writing import write_bytes

# What JAX's listeners are told when a program is read.
LOADING = "/jaxscp/load_program_duration"
# What JAX tells them when it has compiled a program and put it into its cache.
_MISS = "/jax/compilation_cache/cache_misses"
# A megabyte each.
_MOST_FILES = 100
_found: dict[str, "Program"] = {}


class Program(NamedTuple):
    """A function's, for arguments of some structure and shapes.

    - `compiled`: makes arrays of arrays.
    - `others`, `structure`: of the result, as in [`Packed`][].
    """

    compiled: jax.stages.Compiled
    others: tuple[Any, ...]
    structure: jax.tree_util.PyTreeDef

    def __call__(self, arguments: PyTree) -> PyTree:
        arrays = self.compiled(Packed.of(arguments).arrays)
        return Packed(arrays, self.others, self.structure).unpack()


def kept_program(
    function: Callable, arguments: PyTree, options: dict[str, Any]
) -> Program | None:
    """A function's program for arguments like these; none if it cannot be kept."""
    folder = whole_programs()
    if folder is None or jax.default_backend() != "cpu" or jax.device_count() > 1:
        return None
    name = fingerprint(function, arguments, options)
    if name is None:
        return None
    if name not in _found:
        file = folder / name
        _found[name] = _load(file) or _save(file, function, arguments, options)
    return _found[name]


def _load(file: Path) -> Program | None:
    begun = time.perf_counter()
    try:
        parts = pickle.loads(zlib.decompress(file.read_bytes()))
        executable, result, on_host = parts
        for name, function in on_host.items():
            register(name, function)
        # JAX readies LAPACK for XLA when it lowers the first program that calls it.
        jax.jit(jax.lax.linalg.eigh).lower(jax.ShapeDtypeStruct((2, 2), float))
        compiled = serialize_executable.deserialize_and_load(*executable)
    except Exception:
        # No such file, a damaged one, or XLA refuses it: it is compiled anew.
        return None
    # Another user's may be read all the same.
    with contextlib.suppress(OSError):
        os.utime(file)
    taken = time.perf_counter() - begun
    jax.monitoring.record_event_duration_secs(LOADING, taken)
    return Program(compiled, *result)


def _save(
    file: Path, function: Callable, arguments: PyTree, options: dict[str, Any]
) -> Program:
    given, results = Packed.of(arguments), []

    def program(arrays):
        arguments = Packed(arrays, given.others, given.structure).unpack()
        found = Packed.of(function(*arguments))
        results.append((found.others, found.structure))
        return found.arrays

    # In JAX's cache it is not the same as before something changed that it is named for.
    name = f"{function.__name__}_{file.name[:16]}"
    # Nor is it what was there when a file was written that cannot be read.
    program.__name__ = f"{name}_{uuid.uuid4().hex}" if file.exists() else name
    lowered = jax.jit(program, compiler_options=options).lower(given.arrays)
    with _Misses() as misses:
        compiled = lowered.compile()
    made = Program(compiled, *results[0])
    if misses.count:
        # Without a file it serves this process all the same.
        with contextlib.suppress(Exception):
            _write(file, made, called_by(lowered.as_text()))
    return made


def _write(file: Path, made: Program, on_host: dict[str, Callable]) -> None:
    executable = serialize_executable.serialize(made.compiled)
    result = (made.others, made.structure)
    content = zlib.compress(pickled((executable, result, on_host)), 1)
    file.parent.mkdir(parents=True, exist_ok=True)
    write_bytes(file, content)
    files = sorted(file.parent.iterdir(), key=lambda each: each.stat().st_mtime)
    for each in files[:-_MOST_FILES]:
        each.unlink(missing_ok=True)


class _Misses:
    """Counts what this thread compiles because JAX's cache has not got it, while open.

    What comes from that cache runs, but lacks its kernels when it is written again.
    """

    def __init__(self) -> None:
        self.count = 0

    def __enter__(self) -> "_Misses":
        self._thread = threading.get_ident()
        jax.monitoring.register_event_listener(self._hear)
        return self

    def __exit__(self, *exception: object) -> None:
        jax.monitoring.unregister_event_listener(self._hear)

    def _hear(self, event: str, **details: Any) -> None:
        del details
        here = self._thread == threading.get_ident()
        self.count += here and event == _MISS
