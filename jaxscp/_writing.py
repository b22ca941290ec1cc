"""Files: written whole or not at all."""

import os
import tempfile
import threading
from pathlib import Path


def write_bytes(path: str | Path, content: bytes) -> None:
    """Write a file whole: under another name first, renamed when complete.

    What is not a regular file, such as a pipe or /dev/stdout, is written to directly.
    """
    target = Path(os.path.realpath(path))
    if target.exists() and not target.is_file():
        target.write_bytes(content)
        return
    writer = f"{os.getpid()}-{threading.get_ident()}"
    partial = target.with_name(f".{target.name}.{writer}.partial")
    try:
        partial.write_bytes(content)
        os.replace(partial, target)
    finally:
        partial.unlink(missing_ok=True)


def check_writable(option: str, path: str | Path) -> None:
    """Refuse a path that could not be written, before any work is done for it.

    **Raises:** `ValueError` naming the option, the path and what is wrong.
    """
    target = Path(os.path.realpath(path))
    if target.is_dir():
        raise ValueError(f"{option} {path}: is a directory; add a file name.")
    if target.exists():
        if not os.access(target, os.W_OK):
            raise ValueError(f"{option} {path}: is not writable; choose another file.")
        if not target.is_file():
            return
    if not target.parent.is_dir():
        raise ValueError(
            f"{option} {path}: the directory {target.parent} does not exist; create it "
            "or choose another."
        )
    try:
        with tempfile.TemporaryFile(dir=target.parent):
            pass
    except OSError as error:
        raise ValueError(
            f"{option} {path}: cannot write in {target.parent} ({error.strerror}); "
            "choose another directory."
        ) from error


def check_folder(option: str, path: str | Path) -> None:
    """Make a folder where there is none, and refuse one that cannot be written in.

    **Raises:** `ValueError` naming the option, the path and what is wrong.
    """
    target = Path(path)
    try:
        target.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=target):
            pass
    except OSError as error:
        raise ValueError(
            f"{option} {path}: cannot write there ({error.strerror}); choose another "
            "folder."
        ) from error
