"""Which code runs, for the provenance of artifacts: its git commit, and a digest of what makes the samples."""

from __future__ import annotations

import hashlib
import re
import subprocess
from functools import cache
from pathlib import Path

_PACKAGE = Path(__file__).parents[1]
_SAMPLES = (  # below the package: what the numbers of a sample depend on
    *("cosmology.py", "physics.py", "sampling.py", "halos", "lensing", "imaging", "fitting", "scan", "summaries"),
    *("products", "stages"),
)
_ANSWERS = ("stages/abc", "stages/exclusion.py")  # made of all samples at once
_NO_CODE = re.compile(rb'^[ \t]*(?:#[^\n]*|[rR]?"""(?:(?!""").)*""")?[ \t]*\r?\n', re.MULTILINE | re.DOTALL)


@cache
def code_commit() -> tuple[str, bool]:
    """Return the git commit of the running code and whether it has changed; ("unknown", False) outside git."""

    def git(*arguments: str) -> str | None:
        command = ["git", "-C", str(_PACKAGE), *arguments]
        try:
            done = subprocess.run(command, capture_output=True, text=True, check=False)
        except FileNotFoundError:
            return None
        return done.stdout.strip() if done.returncode == 0 else None

    commit = git("rev-parse", "HEAD")
    tracked = git("ls-files", "--", str(_PACKAGE / "types.py"))
    if not commit or not tracked:
        return "unknown", False
    return commit, bool(git("status", "--porcelain", "--", str(_PACKAGE)))


@cache
def sample_code_digest(package: Path = _PACKAGE) -> str:
    """Return the SHA-256 of the code that makes samples, without comments and docstrings.

    Unlike a commit it knows of changes that are not committed, and of installations without git. Documents,
    figures and the inference do not change it.
    """
    sha = hashlib.sha256()
    answers = tuple(package / name for name in _ANSWERS)
    for place in (package / name for name in _SAMPLES):
        for path in sorted(place.rglob("*.py")) if place.is_dir() else [place]:
            if not any(path.is_relative_to(answer) for answer in answers):
                code = _NO_CODE.sub(b"", path.read_bytes())
                sha.update(path.relative_to(package).as_posix().encode() + b"\0" + code + b"\0")
    return sha.hexdigest()
