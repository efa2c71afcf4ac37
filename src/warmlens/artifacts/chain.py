"""The chain of artifacts from the posterior back to the observation, followed in one place."""

from __future__ import annotations

import itertools
import os
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from warmlens.artifacts.atomic import ArtifactError, UnreadableNowError
from warmlens.artifacts.file import Header, content_digest, input_digest, open_artifact, read_header, reading
from warmlens.artifacts.names import results_folder
from warmlens.config.observation import FITS_FILES

Verdict = Literal["ok", "missing", "unreadable", "damaged", "altered", "settings", "inputs", "manifest"]

_REMEDY = "delete it and run the campaign again"
_THREADS = 2  # HDF5 reads one dataset at a time; the other thread hashes meanwhile


@dataclass(frozen=True)
class Finding:
    """Something wrong with one artifact, or another file of a campaign.

    `cause` is the error of reading it. `absent` is the input that is not there, if that is what is wrong.
    """

    path: Path
    problem: str
    kind: Verdict
    cause: Exception | None = field(default=None, compare=False)
    absent: Path | None = None

    def to_error(self) -> ArtifactError:
        """Return the error for a program that needs the artifact."""
        if isinstance(self.cause, ArtifactError):  # names the file that cannot be read, and its own remedy
            return self.cause
        return ArtifactError(f"{self.path}: {self.problem}; {_REMEDY}")


@dataclass(frozen=True)
class Record:
    """An artifact that was examined: its header, where its inputs lie, and what is wrong.

    The header is None if the artifact is missing or cannot be read.
    """

    path: Path
    stage: str
    header: Header | None = None
    sources: Mapping[str, Path] = field(default_factory=dict)
    findings: tuple[Finding, ...] = ()

    @property
    def verdict(self) -> Verdict:
        """Kind of the first finding; "ok" without any."""
        return self.findings[0].kind if self.findings else "ok"

    def sound_header(self) -> Header:
        """Return the header, or raise the first finding as an `ArtifactError` with what to do."""
        if self.findings:
            raise self.findings[0].to_error()
        assert self.header is not None
        return self.header


class Chain:
    """Compare artifacts of a campaign with one another; the header of an input is read once.

    `expected_settings` has the digest of the settings of every stage under the configuration of the campaign.
    """

    def __init__(self, expected_settings: Mapping[str, str]) -> None:
        self._expected = expected_settings
        self._read: dict[Path, tuple[Header, dict[str, Path]]] = {}

    def compare(self, path: Path, stage: str = "", *, hashed: bool = False, place: Path | None = None) -> Record:
        """Compare an artifact with the settings of its stage, and with its inputs as they are now.

        An artifact of another `stage` counts as damaged; "" stands for any. If `hashed`, its content is compared
        with its digest, too. Its inputs are looked for as if it were at `place`, if that is given.
        """
        header: Header | None = None
        sources: dict[str, Path] = {}
        findings: list[Finding] = []
        try:
            if hashed or stage or path not in self._read:
                with open_artifact(path, *filter(None, [stage])) as artifact, reading(path):
                    sources = input_paths(artifact, place)
                    header = artifact.header
                    self._read[path] = self._read[path.resolve()] = header, sources
                    if hashed and content_digest(artifact.file, artifact.metadata) != header.digest:
                        findings.append(Finding(path, "altered: its content does not match its digest", "altered"))
        except (ArtifactError, OSError) as error:
            return Record(path, stage, header, sources, (_unread(path, error),))
        header, sources = self._read[path]
        wanted = self._expected.get(header.stage)
        if wanted is not None and header.settings_sha256 != wanted:
            problem = "made with other settings or an older version of its stage"
            findings.append(Finding(path, problem, "settings"))
        findings += self._compare_inputs(header, sources)
        return Record(path, stage, header, sources, tuple(findings))

    def _compare_inputs(self, header: Header, sources: Mapping[str, Path]) -> Iterator[Finding]:
        for name, source in sources.items():
            recorded = header.inputs[name]
            label = f"its input {name} ({recorded['path']})"
            try:
                if not os.path.exists(source):  # noqa: PTH110 (False for a path that the system refuses)
                    yield Finding(header.path, f"{label} is missing", "inputs", absent=source)
                elif self._digest(source, header.stage) != recorded["digest"]:
                    yield Finding(header.path, f"{label} has changed since", "inputs")
            except (ArtifactError, OSError) as error:
                yield Finding(header.path, f"{label} cannot be read: {error}", "inputs", error)

    def _digest(self, source: Path, user: str) -> str:
        """Return the digest of an input of the stage `user`."""
        if user == "observation":  # made from files of the user
            return input_digest(source)
        source = source.resolve()  # a results folder may be made of links
        if source not in self._read:
            header = read_header(source)
            self._read[source] = header, input_paths(header)
        return self._read[source][0].digest


def _unread(path: Path, error: ArtifactError | OSError) -> Finding:
    """Return the finding about an artifact that cannot be read; one that the system refuses may be sound."""
    if isinstance(error, OSError):
        error = UnreadableNowError(f"{path}: cannot be read now: {error}; mend that and repeat the command")
    if isinstance(error, UnreadableNowError):
        return Finding(path, f"unreadable: {error}", "unreadable", error)
    if os.path.exists(path):  # noqa: PTH110 (False for a path that the system refuses)
        return Finding(path, f"damaged: {error}", "damaged", error)
    return Finding(path, "missing", "missing", error)


def walk(
    files: Mapping[Path, str],
    expected_settings: Mapping[str, str],
    hashed: Collection[Path] = (),
    done: Callable[[Path], None] = lambda _: None,
) -> Iterator[Record]:
    """Examine artifacts, then everything that they were made from, back to the observation.

    Parameters
    ----------
    files
        Artifacts and their stages; "" for any.
    expected_settings
        Digest of the settings of every stage.
    hashed
        Those whose content is compared with its digest.
    done
        Called with the path of every artifact, from several threads.

    Yields
    ------
    Record
        Of all `files` in their order, then of each other artifact that one without fault was made from. An input
        that is not there is no fault of the others.
    """
    chain = Chain(expected_settings)

    def compare(path: Path, stage: str) -> Record:
        record = chain.compare(path, stage, hashed=path in hashed)
        done(path)
        return record

    seen = {path.resolve() for path in files}
    while files:
        sources: set[Path] = set()
        # Nothing is yielded while threads are open: a generator that is dropped half-way is closed when garbage is
        # collected, maybe inside HDF5's lock, and would wait for ever for threads that need it.
        with ThreadPoolExecutor(_THREADS) as pool:
            records = list(pool.map(compare, files.keys(), files.values()))
        for record in records:
            yield record
            absent = [finding.absent for finding in record.findings]
            # those of an observation are files of the user
            if record.header and None not in absent and record.header.stage != "observation":
                sources.update(path.resolve() for path in record.sources.values() if path not in absent)
        files = dict.fromkeys(sorted(sources - seen), "")
        seen |= sources


def check_chains(paths: Iterable[Path], expected_settings: Mapping[str, str]) -> list[Header]:
    """Check that artifacts and all that they were made from have the expected settings and are unchanged since.

    Returns the headers of all of them. Of the artifacts themselves the content is hashed too; for those that they
    were made from, `audit` does that.
    Paths that do not end in .h5 are ignored.

    Raises
    ------
    ArtifactError
        Naming the first artifact that does not fit, and what to do.
    """
    files = {path.resolve(): "" for path in paths if path.suffix == ".h5"}
    return [record.sound_header() for record in walk(files, expected_settings, hashed=files)]


def examine(
    files: Mapping[Path, str],
    expected_settings: Mapping[str, str],
    done: Callable[[Path], None] = lambda _: None,
) -> list[Record]:
    """Re-hash every artifact of a campaign, and compare its settings and inputs; see `walk` for the arguments."""
    records = walk(files, expected_settings, hashed=files, done=done)
    return list(itertools.islice(records, len(files)))  # others that these were made from are no part of it


def audit(files: Mapping[Path, str], expected_settings: Mapping[str, str]) -> list[Finding]:
    """Return everything that `examine` finds wrong."""
    return [finding for record in examine(files, expected_settings) for finding in record.findings]


def input_paths(header: Header, place: Path | None = None) -> dict[str, Path]:
    """Return where the inputs of an artifact are, by name, if it lies at `place`, or where it was opened.

    Inputs are artifacts of the same results folder. Only an observation is made from files of the user, or from
    the observation of another campaign, which may be anywhere.

    Raises
    ------
    ArtifactError
        If an input, its symbolic links followed, is anything else.
    """
    place = place or header.path
    allowed = (*FITS_FILES, "artifact")
    if header.stage == "observation" and any(name.rpartition("/")[2] not in allowed for name in header.inputs):
        raise ArtifactError(f"{header.path}: an observation is not made from {[*header.inputs]}; {_REMEDY}")
    # normalised, for the folder of `place` may not be there yet
    sources = {name: Path(os.path.normpath(place.parent / each["path"])) for name, each in header.inputs.items()}
    if header.stage == "observation":
        return sources
    folder = results_folder(place.absolute(), header.stage).resolve()
    for name, source in sources.items():
        with reading(header.path, f"the path of its input {name}"):
            inside = source.suffix == ".h5" and source.resolve().is_relative_to(folder)
        if not inside:
            raise ArtifactError(
                f"{header.path}: its input {name} ({header.inputs[name]['path']}) is no artifact of the "
                f"results folder {folder}; {_REMEDY}"
            )
    return sources
