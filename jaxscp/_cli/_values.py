"""What the command line's values are made of."""

import argparse
import json
import math
from typing import Any, NoReturn


def assignment(text: str) -> tuple[str, Any]:
    """`PATH=JSON` as a path and a value."""
    path, equals, value = text.partition("=")
    if not (equals and path):
        raise argparse.ArgumentTypeError(
            f"{text!r} is not PATH=JSON; write for example vehicle.mass=2.5"
        )
    try:
        return path, json.loads(value, parse_constant=_refuse_constant)
    except ValueError as error:
        raise argparse.ArgumentTypeError(
            f"{path}={value}: the value is not JSON ({error}); write a finite number, "
            "a list such as [1, 2], or null"
        ) from error


def node_count(text: str) -> int:
    """A number of nodes: an integer of at least 2."""
    return _at_least(2, text)


def positive(text: str) -> int:
    """An integer of at least 1."""
    return _at_least(1, text)


def share(text: str) -> float:
    """A positive finite number."""
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not 0.0 < value < math.inf:
        raise argparse.ArgumentTypeError(f"{text!r}: give a positive number, as 1e-3")
    return value


def _at_least(least: int, text: str) -> int:
    if not text.isdecimal() or int(text) < least:
        raise argparse.ArgumentTypeError(f"{text!r}: give an integer of at least {least}")
    return int(text)


def _refuse_constant(name: str) -> NoReturn:
    raise ValueError(f"{name} is not a finite number")
