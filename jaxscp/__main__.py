"""`jaxscp` and `python -m jaxscp`: list, solve, sweep, verify and audit missions,
and reproduce the paper."""

import gc
import sys
from collections.abc import Sequence
from concurrent.futures import BrokenExecutor

import jax

from ._cache import keep_programs
from ._cli import _commands
from ._cli._arguments import BAD_INPUT, FAILURE, InputError, parser


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command and return its exit status.

    0 if it did what was asked (a solve: converged and verified), 1 if a solve, a
    sweep, the reproduction, a verification or an audit did not succeed, 2 on bad input,
    with one line on standard error.
    """
    try:
        arguments = parser().parse_args(argv)
    except SystemExit as stop:
        return stop.code if isinstance(stop.code, int) else BAD_INPUT
    jax.config.update("jax_enable_x64", True)
    keep_programs()
    # Tracing makes millions of objects that live as long as their program: looking for
    # garbage among them, as often as Python does by itself, is a tenth of a first solve.
    gc.set_threshold(100_000, 50, 100)
    try:
        return getattr(_commands, arguments.command)(arguments)
    except (InputError, OSError) as error:
        line = " ".join(str(error).split())
        print(f"jaxscp {arguments.command}: error: {line}", file=sys.stderr)
        return BAD_INPUT
    except BrokenExecutor as error:
        print(f"jaxscp {arguments.command}: {error}", file=sys.stderr)
        return FAILURE


if __name__ == "__main__":
    sys.exit(main())
