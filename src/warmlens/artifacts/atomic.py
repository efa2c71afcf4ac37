"""Files that are written completely or not at all, and the errors of artifacts."""

from __future__ import annotations

import contextlib
import errno
import glob
import hashlib
import os
import shutil
from collections.abc import Iterator
from pathlib import Path

_SPARE_BYTES = 2**20


class ArtifactError(RuntimeError):
    """An artifact is missing, damaged, of another kind, or cannot be written."""


class UnreadableNowError(ArtifactError):
    """The system refuses to read an artifact, for a reason that lies outside of it and may pass."""


@contextlib.contextmanager
def atomic_path(path: Path, n_bytes: int = 0) -> Iterator[Path]:
    """Yield a temporary name in the folder of `path` to write to; sync and rename it, or remove it after an error.

    The free space is compared with the expected size `n_bytes` first: HDF5 crashes when a disk fills up.

    Raises
    ------
    ArtifactError
        If there is no room, or the file cannot be written.
    """
    temporary = path.with_name(f".{path.name}.tmp-{os.getpid()}")  # which *.h5 does not match
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        for left_over in path.parent.glob(f".{glob.escape(path.name)}.tmp-*"):  # of a killed job
            left_over.unlink()
        free = shutil.disk_usage(path.parent).free
        if free < n_bytes + _SPARE_BYTES:
            raise OSError(errno.ENOSPC, f"{free / 2**20:.0f} MiB free, {n_bytes / 2**20:.0f} MiB needed")
        yield temporary
        with temporary.open("rb") as handle:
            os.fsync(handle.fileno())
        temporary.replace(path)
    except (OSError, RuntimeError) as error:  # h5py reports a failed flush as RuntimeError
        if isinstance(error, ArtifactError):
            raise
        full = getattr(error, "errno", None) == errno.ENOSPC or "No space left" in str(error)
        reason, remedy = (f"the disk is full ({error})", "make room") if full else (str(error), "fix that")
        raise ArtifactError(
            f"{path}: could not be written: {reason}. Finished artifacts are intact; "
            f"{remedy} and repeat the command"
        ) from error
    finally:
        if temporary.exists():  # on a read-only disk, unlink fails even if there is no file
            temporary.unlink()


def file_digest(path: Path) -> str:
    """Return the SHA-256 of the bytes of a file."""
    with path.open("rb") as handle:
        return hashlib.file_digest(handle, "sha256").hexdigest()
