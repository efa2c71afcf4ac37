"""Progress of a command on stderr, where that is a terminal."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

from rich.console import Console
from rich.progress import BarColumn, DownloadColumn, Progress, TextColumn, TimeRemainingColumn


@contextlib.contextmanager
def progress(title: str, paths: Iterable[Path]) -> Iterator[Callable[[Path], None]]:
    """Show a bar that advances when the function that is returned is called with each of `paths`."""
    sizes = {path: path.stat().st_size for path in paths if path.is_file()}
    console = Console(stderr=True)
    columns = (TextColumn(title), BarColumn(), DownloadColumn(), TimeRemainingColumn())
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as bar:
        task = bar.add_task(title, total=sum(sizes.values()))
        yield lambda path: bar.advance(task, sizes.get(path, 0))
