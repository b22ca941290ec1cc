"""Where the command line keeps what it compiled, for the next run."""

import hashlib
import os
import platform
from pathlib import Path

import jax

# Of Linux' description of a processor, what programs compiled for it depend on.
_FEATURES = ("model name", "flags", "Features")


def keep_programs() -> None:
    """Turn JAX's persistent cache on, unless the user has chosen a folder for it.

    `JAX_ENABLE_COMPILATION_CACHE=false` turns it off.
    """
    if jax.config.read("jax_compilation_cache_dir") is not None:
        return
    folder = _folder()
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError:
        return
    if not os.access(folder, os.W_OK):
        return
    jax.config.update("jax_compilation_cache_dir", str(folder))
    # Small programs, too: there are dozens of them.
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)


def _folder() -> Path:
    """One for each kind of processor: homes are shared, programs are not."""
    home = os.environ.get("XDG_CACHE_HOME")
    caches = Path(home) if home else Path.home() / ".cache"
    return caches / "jaxscp" / hashlib.sha256(_processor().encode()).hexdigest()[:16]


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text(errors="replace").splitlines()
    except OSError:
        lines = []
    # Alike for all of a machine's processors.
    features = sorted({line for line in lines if line.startswith(_FEATURES)})
    return "\n".join([platform.machine(), platform.processor(), *features])
