"""What a program depends on, told without tracing it.

Tracing reads the code of functions, their settings, the shapes of arrays and how JAX is
configured. Where all code is jaxscp's own, or of the libraries that it is built on, what
is installed tells it. A user's function may read whatever it likes: nothing tells that.
"""

import functools
import hashlib
import os
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jaxlib
import numpy as np

from ._cache import processor
from ._packed import Packed
from ._pickling import packages_in, pickled_by_value
from ._types import PyTree

_OWN = __name__.partition(".")[0]
_LIBRARIES = {each.__name__: each.__version__ for each in (eqx, jax, jaxlib, np)}
# With what pickles need to make values of parts.
_MAKERS = ("_codecs", "builtins", "collections", "copyreg", "enum", "functools")
_KNOWN = {_OWN, *_LIBRARIES, *_MAKERS}
# Variables of the environment that are read while tracing or compiling.
_READ = ("EQX_", "XLA_")
# Seconds since 1970.
_IMPORTED = time.time()


def fingerprint(
    function: Callable, arguments: PyTree, options: dict[str, Any]
) -> str | None:
    """A name for the program of a function of this package, compiled with some options;
    none if it may depend on more than can be told.
    """
    name, installed = (function.__module__, function.__qualname__), _installed()
    if name[0].partition(".")[0] != _OWN or installed is None:
        return None
    packed = Packed.of(arguments)
    shapes = [
        None if each is None else (each.shape, str(each.dtype), each.weak_type)
        for each in packed.arrays
    ]
    try:
        told = pickled_by_value((shapes, packed.others, packed.structure))
    except Exception:
        # Nearly every kind: functions without a name of their own cannot be pickled.
        return None
    if not packages_in(told) <= _KNOWN:
        return None
    rest = repr((name, sorted(options.items()), _settings(), installed))
    return hashlib.sha256(told + rest.encode()).hexdigest()


def _settings() -> list[tuple[str, str]]:
    """How JAX and XLA are set here and now, but for where they keep programs."""
    # Where a `with` statement has set one, for this thread, the attribute tells.
    settings = [
        (name, repr(getattr(jax.config, name, value)))
        for name, value in jax.config.values.items()
        if "cache" not in name
    ]
    read = [item for item in os.environ.items() if item[0].startswith(_READ)]
    return sorted(settings + read)


@functools.cache
def _installed() -> str | None:
    """This package's sources, its libraries, Python and the processor; none without
    sources, or where they are no longer those that were imported.
    """
    root = Path(__file__).parent
    sources = sorted(root.rglob("*.py"))
    if not sources:
        return None
    digest = hashlib.sha256()
    for source in sources:
        changed = source.stat()
        if max(changed.st_mtime, changed.st_ctime) > _IMPORTED:
            return None
        digest.update(f"{source.relative_to(root)}\0".encode())
        digest.update(source.read_bytes())
    digest.update(repr((_LIBRARIES, sys.version, processor())).encode())
    return digest.hexdigest()
