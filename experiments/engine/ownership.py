"""One process at a time in a run or study folder."""

from __future__ import annotations

import contextlib
import errno
import fcntl
import os
import platform
import shlex
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

from experiments.engine.files import make_out_folder, unusable
from experiments.engine.runtime import UserError

LOCK = ".lock"  # empty between runs; while one writes, its line says who does
_NO_LOCKS = (errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP, errno.EINVAL)


@contextlib.contextmanager
def owned(folder: Path) -> Iterator[None]:
    """Make a folder and keep it for this process while the work inside lasts.

    The operating system drops the lock with the process, however that ends: what a dead one left
    behind never blocks.

    Args:
        folder: Folder of a run or a study; made where it is not there.

    Raises:
        UserError: If another process writes to it, or it cannot be written.
    """
    there = folder.is_dir()
    make_out_folder(folder)
    path = folder / LOCK
    try:
        file = open(path, "ab+", buffering=0)  # noqa: SIM115 - held until the work is done
    except OSError as error:
        raise unusable(folder, error) from error
    with file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            file.seek(0)
            who = file.read().decode().strip() or "another process"
            raise UserError(
                f"out {str(folder)!r} is being written by {who}: wait until it is done, stop it, "
                "or give another --out"
            ) from None
        except OSError as error:
            if error.errno not in _NO_LOCKS:
                raise unusable(folder, error) from error
            print(
                f"warning: the file system of {str(folder)!r} has no locks: make sure that no "
                "other process writes there",
                file=sys.stderr,
            )
        try:
            _say(file, f"process {os.getpid()} on {platform.node()} since {_now()} ({_program()})")
        except OSError as error:
            raise unusable(folder, error) from error
        try:
            yield
        finally:
            with contextlib.suppress(OSError):
                _say(file, "")
                if not there and list(folder.iterdir()) == [path]:  # nothing came of it
                    path.unlink()
                    folder.rmdir()


def _say(file: BinaryIO, line: str) -> None:
    file.truncate(0)
    file.write(line.encode())


def _now() -> str:
    return time.strftime("%Y-%m-%d %H:%M:%S")


def _program() -> str:
    """The command line, shortened."""
    line = shlex.join([Path(sys.argv[0]).name, *sys.argv[1:]])
    return line if len(line) < 120 else line[:117] + "..."
