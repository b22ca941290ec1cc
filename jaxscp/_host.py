"""Calls from compiled programs to Python, by name.

JAX's own callbacks put an address into the program, so that it never keeps it in its
persistent compilation cache. On the CPU a function can be registered under a name with
XLA's foreign function interface instead: what is called so is the same in every process,
and the program can be kept. XLA hands over pointers, which `ctypes` reads as
`xla/ffi/api/c_api.h` defines them, version 0.3. Where XLA refuses that, and on other
devices, JAX's callbacks serve.
"""

import ctypes
import traceback
from collections.abc import Callable
from typing import Any

import jax
import numpy as np

from ._types import Array, Float

_METADATA, _EXECUTE, _INTERNAL = 1, 3, 13
_POINTER, _INT, _SIZE = ctypes.c_void_p, ctypes.c_int, ctypes.c_size_t
# Functions by their names, and what XLA calls for them: neither may be forgotten.
_registered: dict[str, tuple[Callable[[np.ndarray], Any], Any]] = {}


class _Header(ctypes.Structure):
    """What most of the interface's structures begin with."""

    _fields_ = [("struct_size", _SIZE), ("extensions", _POINTER)]


class _Extension(ctypes.Structure):
    _fields_ = [("struct_size", _SIZE), ("type", _INT), ("next", _POINTER)]


class _Version(_Header):
    _fields_ = [
        ("major", _INT),
        ("minor", _INT),
    ]


class _Metadata(ctypes.Structure):
    _fields_ = [("struct_size", _SIZE), ("version", _Version), ("traits", ctypes.c_uint)]


class _MetadataExtension(ctypes.Structure):
    _fields_ = [("base", _Extension), ("metadata", ctypes.POINTER(_Metadata))]


class _Buffers(_Header):
    _fields_ = [
        ("size", ctypes.c_int64),
        ("types", _POINTER),
        ("items", ctypes.POINTER(_POINTER)),
    ]


class _Buffer(_Header):
    _fields_ = [
        ("dtype", _INT),
        ("data", _POINTER),
        ("rank", ctypes.c_int64),
        ("shape", ctypes.POINTER(ctypes.c_int64)),
    ]


class _Error(_Header):
    _fields_ = [
        ("message", ctypes.c_char_p),
        ("code", _INT),
    ]


_CREATE_ERROR = ctypes.CFUNCTYPE(_POINTER, ctypes.POINTER(_Error))


class _Api(_Header):
    _fields_ = [
        ("version", _Version),
        ("internal", _POINTER),
        ("create_error", _CREATE_ERROR),
    ]


class _CallFrame(_Header):
    _fields_ = [
        ("api", ctypes.POINTER(_Api)),
        ("context", _POINTER),
        ("stage", _INT),
        ("arguments", _Buffers),
        ("results", _Buffers),
    ]


_HANDLER = ctypes.CFUNCTYPE(_POINTER, ctypes.POINTER(_CallFrame))


def call_on_host(
    name: str,
    function: Callable[[np.ndarray], np.ndarray],
    size: int,
    vector: Float[Array, " a"],
) -> Float[Array, " size"]:
    """What a Python function of one vector, pure, makes of it: another of known size.

    **Arguments:**

    - `name`: of the function, and of no other, in any process.
    """
    assert vector.dtype == np.float64
    shape = jax.ShapeDtypeStruct((size,), vector.dtype)
    if register(name, function):
        return jax.ffi.ffi_call(name, shape, vmap_method="sequential")(vector)
    return jax.pure_callback(function, shape, vector, vmap_method="sequential")


def tell_host(
    name: str, function: Callable[[np.ndarray], None], vector: Float[Array, " a"]
) -> None:
    """Call a Python function for what it does, not for what it returns: nothing.

    **Arguments:**

    - `name`: as in [`call_on_host`][].
    """
    assert vector.dtype == np.float64
    if register(name, function):
        tell = jax.ffi.ffi_call(name, (), has_side_effect=True, vmap_method="sequential")
        tell(vector)
    else:
        jax.debug.callback(function, vector)


def register(name: str, function: Callable[[np.ndarray], Any]) -> bool:
    """Whether XLA now knows a function by its name."""
    if jax.default_backend() != "cpu":
        return False
    if name not in _registered:
        handler = _HANDLER(_handler(function))
        target = jax.ffi.pycapsule(handler)
        try:
            jax.ffi.register_ffi_target(name, target, platform="cpu")
        except jax.errors.JaxRuntimeError:
            # An XLA that speaks another version.
            return False
        _registered[name] = (function, handler)
    return True


def called_by(program: str) -> dict[str, Callable[[np.ndarray], Any]]:
    """The functions that are named in a program's text."""
    return {name: each for name, (each, _) in _registered.items() if name in program}


def _handler(function: Callable[[np.ndarray], Any]) -> Callable:
    def handle(frame):
        frame = frame.contents
        if frame.extensions:
            return _describe(frame.extensions)
        if frame.stage != _EXECUTE:
            return None
        try:
            answer = function(_vector(frame.arguments).copy())
            if frame.results.size:
                _vector(frame.results)[:] = answer
        except BaseException:
            return _failed(frame, traceback.format_exc())
        return None

    return handle


def _describe(address: int) -> None:
    """Which version of the interface this is written for."""
    extension = ctypes.cast(address, ctypes.POINTER(_MetadataExtension)).contents
    if extension.base.type == _METADATA:
        version = extension.metadata.contents.version
        version.major, version.minor = 0, 3


def _vector(buffers: _Buffers) -> np.ndarray:
    """The only buffer, as an array that shares its memory."""
    buffer = ctypes.cast(buffers.items[0], ctypes.POINTER(_Buffer)).contents
    data = ctypes.cast(buffer.data, ctypes.POINTER(ctypes.c_double))
    return np.ctypeslib.as_array(data, (buffer.shape[0],))


def _failed(frame: _CallFrame, message: str) -> int:
    error = _Error(ctypes.sizeof(_Error), None, message.encode(), _INTERNAL)
    return frame.api.contents.create_error(ctypes.byref(error))
