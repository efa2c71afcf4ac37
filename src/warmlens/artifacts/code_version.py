"""Which code runs: its git commit, for the provenance of artifacts."""

from __future__ import annotations

import subprocess
from functools import cache
from pathlib import Path


@cache
def code_commit() -> tuple[str, bool]:
    """Return the git commit of the running code and whether it has changed; ("unknown", False) outside git."""
    folder = Path(__file__).parents[1]

    def git(*arguments: str) -> str | None:
        command = ["git", "-C", str(folder), *arguments]
        try:
            done = subprocess.run(command, capture_output=True, text=True, check=False)
        except FileNotFoundError:
            return None
        return done.stdout.strip() if done.returncode == 0 else None

    commit = git("rev-parse", "HEAD")
    tracked = git("ls-files", "--", str(folder / "types.py"))
    if not commit or not tracked:
        return "unknown", False
    return commit, bool(git("status", "--porcelain", "--", str(folder)))
