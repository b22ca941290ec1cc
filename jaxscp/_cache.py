"""Where programs are kept from one process to the next."""

import contextlib
import hashlib
import os
import platform
import threading
from pathlib import Path
from typing import Any

import jax
import jax.monitoring

try:
    import fcntl
except ImportError:  # On Windows.
    fcntl = None  # type: ignore[assignment]

_FOLDER = "jax_compilation_cache_dir"
_ENABLED = "jax_enable_compilation_cache"
# Of Linux' description of a processor, what programs compiled for it depend on.
_FEATURES = ("model name", "flags", "Features")
# What JAX says when it begins to compile a program, and when it has it.
_COMPILING = "/jax/core/compile/backend_compile_duration"
_keeps = False
# Taken while it is settled whether programs are compiled in turn.
_settling = threading.Lock()
_takes_turns = False


def keep_programs(folder: str | Path | None = None) -> None:
    """Keep what is compiled for other processes, which then start in half the time.

    JAX's persistent cache is turned on. It has to trace a program before it can say
    whether it knows it; solves of jaxscp's own missions are kept so that they need not
    be traced, either. The command line and the workers of sweeps always do this;
    `JAX_ENABLE_COMPILATION_CACHE=false` in the environment turns it off.

    **Arguments:**

    - `folder`: where to keep them; by default where JAX has been told to, or else in the
        user's caches (`XDG_CACHE_HOME`). If that cannot be written to, nothing is kept.
        It must be one that nobody else may write to: what lies there is run.
    """
    global _keeps
    if folder is None and getattr(jax.config, _FOLDER) is not None:
        _keeps = True
        return
    folder = _folder() if folder is None else Path(folder)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError:
        return
    if not os.access(folder, os.W_OK):
        return
    jax.config.update(_FOLDER, str(folder))
    # Small programs, too: there are dozens of them.
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    _keeps = True


def whole_programs() -> Path | None:
    """The folder of those that are found untraced (`_kept`), if any are."""
    folder = getattr(jax.config, _FOLDER)
    # JAX also knows places elsewhere.
    if not _keeps or folder is None or "://" in folder:
        return None
    return Path(folder) / "jaxscp" if getattr(jax.config, _ENABLED) else None


def compile_in_turn() -> None:
    """Let processes that share a cache compile one at a time, for good.

    Started together they need the same programs: the first to get there compiles, and
    the others, when it is their turn, find what it has kept. Without a cache, or without
    locks of files, each compiles for itself.
    """
    global _takes_turns
    folder = getattr(jax.config, _FOLDER)
    if fcntl is None or folder is None:
        return
    # Once a process: a file opened twice would keep the process from itself for good.
    with _settling:
        if _takes_turns:
            return
        try:
            Path(folder).mkdir(parents=True, exist_ok=True)
            turn = os.open(Path(folder) / "jaxscp.lock", os.O_RDWR | os.O_CREAT)
        except OSError:
            return
        _take_turns(turn)
        _takes_turns = True


def _take_turns(turn: int) -> None:
    """Lock a file while this process compiles."""

    # JAX tells of both in the thread that compiles, before it looks into the cache and
    # after it has written to it. A process that is killed in between lets go, too.
    def begin(event: str, value: float | int, **details: Any) -> None:
        if event == _COMPILING:
            _lock(turn, fcntl.LOCK_EX)

    def end(event: str, duration_secs: float, **details: Any) -> None:
        if event == _COMPILING:
            _lock(turn, fcntl.LOCK_UN)

    jax.monitoring.register_scalar_listener(begin)
    jax.monitoring.register_event_duration_secs_listener(end)


def _lock(file: int, operation: int) -> None:
    # Some file systems know no locks.
    with contextlib.suppress(OSError):
        fcntl.flock(file, operation)


def _folder() -> Path:
    """One for each kind of processor: homes are shared, programs are not."""
    home = os.environ.get("XDG_CACHE_HOME")
    caches = Path(home) if home else Path.home() / ".cache"
    return caches / "jaxscp" / hashlib.sha256(processor().encode()).hexdigest()[:16]


def processor() -> str:
    """What programs that are compiled for a processor depend on."""
    try:
        lines = Path("/proc/cpuinfo").read_text(errors="replace").splitlines()
    except OSError:
        lines = []
    # Alike for all of a machine's processors.
    features = sorted({line for line in lines if line.startswith(_FEATURES)})
    return "\n".join([platform.machine(), platform.processor(), *features])
