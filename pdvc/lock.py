"""A folder held by one process at a time: a lock of the operating system, released whatever ends the process."""

from __future__ import annotations

import errno
import os
import platform
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from filelock import FileLock, Timeout

LOCK = ".in-use"
"""The locked file within a folder; it stays there, empty, as removing it would let two processes in."""
HOLDER = ".in-use-by"
"""Who holds it, for the reader of an error; there while it is held."""

FULL_DISK = frozenset({errno.ENOSPC, errno.EDQUOT, errno.EFBIG})
"""Numbers of the errors that making room mends: a full disk, a full quota, a file larger than is allowed."""


class InUseError(OSError):
    """Another process holds a folder: which one, and what to do."""


@contextmanager
def held(folder: Path) -> Iterator[None]:
    """Hold a folder for this process alone, and make it where there is none; a process may hold it several times.

    Raises InUseError at once, in one line, where another process holds it, and OSError where it cannot be written.
    """
    folder.mkdir(parents=True, exist_ok=True)
    lock = FileLock(folder / LOCK, timeout=0, thread_local=False, is_singleton=True)
    holder = folder / HOLDER
    try:
        lock.acquire()
    except Timeout:
        raise InUseError(
            f"{folder}: in use by {_told(holder)}: wait until it has ended, or choose another folder"
        ) from None
    try:
        if lock.lock_counter == 1:
            command = " ".join([Path(sys.argv[0]).name, *sys.argv[1:]])
            since = time.strftime("%Y-%m-%d %H:%M:%S")
            told = f"process {os.getpid()} on {platform.node()} since {since} ({command})"
            # where the disk is full, what follows says so with the file that is needed
            with suppress(OSError):
                holder.write_text(told, encoding="utf-8")
        yield
    finally:
        if lock.lock_counter == 1:
            holder.unlink(missing_ok=True)
        lock.release()


def _told(holder: Path) -> str:
    try:
        return " ".join(holder.read_text(encoding="utf-8").split()) or "another process"
    except (OSError, UnicodeDecodeError):
        return "another process"
