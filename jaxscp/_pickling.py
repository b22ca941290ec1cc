"""Pickles of programs' parts, and what is named in a pickle."""

import copyreg
import io
import pickle
import pickletools
from typing import Any

import jax


def _of_structure(structure: jax.tree_util.PyTreeDef) -> tuple:
    # Its own pickle loses which of the marks in it are Equinox's own.
    whole = jax.tree.unflatten(structure, [0] * structure.num_leaves)
    return jax.tree.structure, (whole,)


_TABLE = copyreg.dispatch_table | {jax.tree_util.PyTreeDef: _of_structure}


def pickled(value: Any) -> bytes:
    """For `pickle.loads`."""
    return _written(value, fast=False)


def pickled_by_value(value: Any) -> bytes:
    """The same for equal values, whether or not parts of them are the same object."""
    return _written(value, fast=True)


def _written(value: Any, *, fast: bool) -> bytes:
    content = io.BytesIO()
    # In this protocol each name stands in an instruction of its own.
    pickler = pickle.Pickler(content, protocol=3)
    pickler.dispatch_table, pickler.fast = _TABLE, fast
    pickler.dump(value)
    return content.getvalue()


def packages_in(content: bytes) -> set[str]:
    """Those whose functions and classes it names."""
    return {
        str(name).split()[0].partition(".")[0]
        for instruction, name, _ in pickletools.genops(content)
        if instruction.name == "GLOBAL"
    }
