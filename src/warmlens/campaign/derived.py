"""Files that derive from the artifacts of a campaign: which there are, from what, and whether they are that still.

The tables and numbers of an answer are compared with its artifact. A figure and the report are compared with the
ledger that was written with them, and the manifest with the files that it lists.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from pathlib import Path

from warmlens.artifacts.atomic import ArtifactError, file_digest
from warmlens.artifacts.chain import Finding
from warmlens.artifacts.file import Artifact, input_digest, open_artifact
from warmlens.artifacts.names import (
    ANSWER_FILES,
    CONFIG,
    CRATE,
    FIGURE_GROUPS,
    FIGURE_VERSION,
    LEDGER,
    MANIFEST,
    REPORT,
    REPORT_VERSION,
    SINGLE,
)
from warmlens.campaign.files import artifact_files, stage_files
from warmlens.config.file import parse_config
from warmlens.config.model import Config
from warmlens.config.types import ConfigError
from warmlens.products.answer import is_answer_numbers, is_answer_table
from warmlens.products.ledger import Ledger, read_ledger, read_limited, write_ledger
from warmlens.products.manifest import Kind, Manifest, ManifestFile, read_manifest
from warmlens.stage_table import campaign_stages

# Stages that a figure shows; of a chunked stage its first chunk, or all of them with "/*".
NEEDED: dict[str, tuple[str, ...]] = {
    "smooth_model": ("observation", "smooth_model"),
    "psf": ("observation", "smooth_model"),
    "halo_maps": ("halos",),
    "deflection_maps": ("observation", "deflections"),
    "mocks": ("observation", "smooth_model", "mocks"),
    "delta_r": ("observed_scan", "scans"),
    "scan_plane": ("observed_scan",),
    "correlation": ("observed_summary", "summaries/*"),
    "posterior": ("abc",),
    "likelihood": ("abc",),
    "calibration": ("abc",),
    "convergence": ("abc",),
    "predictive": ("observed_summary", "abc"),
    "information": ("abc",),
    "3": ("observed_scan", "scans/*"),
    "4": ("observed_summary", "summaries/*"),
    "5": ("abc",),
}
REPORT_LEDGER = LEDGER.format(name="report")

Digests = Callable[[Path], str]


def drawn_groups(config: Config) -> dict[str, list[str]]:
    """Return the figures for which a campaign has the stages, by the job that draws them."""
    stages = campaign_stages(config)
    groups = {
        group: [name for name in names if all(need.removesuffix("/*") in stages for need in NEEDED[name])]
        for group, names in FIGURE_GROUPS.items()
    }
    return {group: names for group, names in groups.items() if names}


def drawn_figures(config: Config) -> list[str]:
    """Return the names of all figures that a campaign draws."""
    return [name for names in drawn_groups(config).values() for name in names]


def needed_paths(config: Config, needed: Sequence[str]) -> dict[str, Path]:
    """Return the artifacts of some stages by stage; by "STAGE/i" where all chunks of it are needed."""
    paths: dict[str, Path] = {}
    for need in needed:
        stage = need.removesuffix("/*")
        files = stage_files(config, stage)
        if stage in SINGLE or stage == need:
            paths[stage] = files[0]
        else:
            paths |= {f"{stage}/{number}": path for number, path in enumerate(files)}
    return paths


def figure_inputs(config: Config, name: str) -> dict[str, Path]:
    """Return the artifacts of a figure of a campaign by stage; by "STAGE/i" if it needs all chunks of it."""
    return needed_paths(config, NEEDED[name])


def figure_files(config: Config, name: str) -> list[Path]:
    """Return the picture of a figure of a campaign and its data."""
    return [Path(config.results) / f"figures/{name}.{kind}" for kind in ("png", "csv")]


def report_inputs(config: Config) -> list[Path]:
    """Return what the report of a campaign is made from: all artifacts, and the pictures of its figures."""
    return [*artifact_files(config), *(figure_files(config, name)[0] for name in drawn_figures(config))]


def derived_files(config: Config) -> dict[Path, Kind]:
    """Return the files of a finished campaign that are no artifacts, with their kinds."""
    root = Path(config.results)
    files: dict[Path, Kind] = {root / CONFIG: "configuration"}
    files |= dict.fromkeys((root / name for name in ANSWER_FILES[campaign_stages(config)[-1]]), "table")
    for outputs, _, _, kind in _made(config).values():
        files |= dict.fromkeys(outputs, kind)
    return files | dict.fromkeys(ledgers(config), "record")


def ledgers(config: Config) -> list[Path]:
    """Return the ledgers of a finished campaign."""
    return list(_made(config))


def _made(config: Config) -> dict[Path, tuple[list[Path], list[Path], int, Kind]]:
    """Return what is made, from what, by which version, and its kind, by the ledger that records it."""
    root = Path(config.results)
    made: dict[Path, tuple[list[Path], list[Path], int, Kind]] = {
        root / LEDGER.format(name=name): (
            figure_files(config, name),
            list(figure_inputs(config, name).values()),
            FIGURE_VERSION,
            "figure",
        )
        for name in drawn_figures(config)
    }
    if campaign_stages(config)[-1] == "abc":
        made[root / REPORT_LEDGER] = ([root / REPORT], report_inputs(config), REPORT_VERSION, "report")
    return made


def record_made(config: Config, name: str, digests: Mapping[Path, str] | None = None) -> None:
    """Write the ledger of a figure of a campaign, or of its "report", which has just been made.

    `digests` are those of the artifacts that are known already. Inputs that are missing are left out.
    """
    path = Path(config.results) / LEDGER.format(name=name)
    outputs, sources, version, _ = _made(config)[path]
    digest = _remembering(digests or {})
    inputs = {source: digest(source) for source in sources if source.exists()}
    write_ledger(path, Path(config.results), version, inputs, outputs)


def _remembering(known: Mapping[Path, str]) -> Digests:
    digests = dict(known)

    def digest(path: Path) -> str:
        if path not in digests:
            digests[path] = input_digest(path)
        return digests[path]

    return digest


def derived_findings(
    config: Config, digests: Mapping[Path, str] | None = None, wrong: Collection[Path] = ()
) -> list[Finding]:
    """Return which derived files in `config.results` are not what they derive from; no artifact is hashed.

    Files that are missing, and figures without a ledger as of earlier versions, are no finding: the workflow makes
    them. A finding about the manifest names the manifest, one about the crate the crate. Whatever a finding names
    can be deleted: the workflow makes it again from the artifacts, `abc.csv` and `abc.json` with their artifact.

    Parameters
    ----------
    config
        Configuration of the campaign.
    digests
        Digests of artifacts that are known already, by path; of others the header is read.
    wrong
        Artifacts that are known to be wrong, with which the manifest is not compared.
    """
    digest = _remembering(digests or {})
    findings = list(_answer_findings(config))
    for ledger in ledgers(config):
        findings += _made_findings(config, ledger, digest)
    return findings + _manifest_findings(config, {*wrong, *(finding.path for finding in findings)}, digest)


def _answer_findings(config: Config) -> Iterator[Finding]:
    """Compare CSV and JSON of the answer with its artifact."""
    root, stage = Path(config.results), campaign_stages(config)[-1]
    path = root / SINGLE[stage]
    files = [root / name for name in ANSWER_FILES[stage] if (root / name).exists()]
    if not path.exists():
        for file in files:
            yield Finding(file, f"{path.name}, which it is made from, is missing", "inputs")
    elif files:
        try:
            with open_artifact(path, stage) as artifact:
                yield from _compare_answer(files, artifact)
        except ArtifactError:  # its own finding; the workflow makes all three again
            return


def _compare_answer(files: Sequence[Path], artifact: Artifact) -> Iterator[Finding]:
    for file in files:
        try:
            same = is_answer_table if file.suffix == ".csv" else is_answer_numbers
            if not same(file, artifact):
                yield Finding(file, f"altered: not what {artifact.path.name} gives", "altered")
        except OSError as error:
            yield Finding(file, f"damaged: {error}", "damaged", error)


def _made_findings(config: Config, ledger_path: Path, digest: Digests) -> list[Finding]:
    """Compare what a ledger records with the files as they are."""
    if not ledger_path.exists():
        return []
    root = Path(config.results)
    outputs, sources, version, _ = _made(config)[ledger_path]
    try:
        ledger = read_ledger(ledger_path)
    except ArtifactError as error:
        return [Finding(ledger_path, f"damaged: {error}", "damaged", error)]
    present = [output for output in outputs if output.exists()]
    if ledger.version != version:
        problem = f"made by version {ledger.version} of its code, which is now {version}"
        return [Finding(output, problem, "settings") for output in present]
    if problem := _changed_input(ledger, root, sources, digest):
        return [Finding(output, problem, "inputs") for output in present]
    findings = []
    for output in present:
        recorded = ledger.outputs.get(output.relative_to(root).as_posix())
        try:
            if recorded != file_digest(output):
                findings.append(
                    Finding(output, f"altered: not what {_name(ledger_path, root)} records", "altered")
                )
        except OSError as error:
            findings.append(Finding(output, f"damaged: {error}", "damaged", error))
    return findings


def _changed_input(ledger: Ledger, root: Path, sources: Sequence[Path], digest: Digests) -> str:
    """Return what has changed since something was made, "" if nothing has; missing sources do not count."""
    names = {_name(source, root): source for source in sources}
    if others := ledger.inputs.keys() - names:
        return f"made from {_some(others)}, now no part of the campaign or of this figure"
    for name, source in names.items():
        if not source.exists():
            continue
        if name not in ledger.inputs:
            return f"made without {name}"
        try:
            if digest(source) != ledger.inputs[name]:
                return f"{name} has changed since it was made"
        except (ArtifactError, OSError):  # its own finding
            continue
    return ""


def _manifest_findings(config: Config, wrong: set[Path], digest: Digests) -> list[Finding]:
    """Compare the manifest with the files that it lists, except `wrong` ones, and the crate with the manifest."""
    root = Path(config.results)
    try:
        manifest = read_manifest(root)
    except ArtifactError as error:
        return [Finding(root / MANIFEST, f"damaged: {error}", "damaged", error)]
    if manifest is None:
        return []
    findings = []
    differ = [path for path in manifest_differences(config, manifest, digest) if path not in wrong]
    if differ:
        problem = f"not up to date: {_some(_name(path, root) for path in differ)}"
        findings.append(Finding(root / MANIFEST, problem, "manifest"))
    if (root / CRATE).exists() and (problem := _crate_problem(root / CRATE, manifest)):
        findings.append(Finding(root / CRATE, problem, "manifest"))
    return findings


def manifest_differences(config: Config, manifest: Manifest, digest: Digests) -> list[Path]:
    """Return the files of a campaign that its manifest lists otherwise, or lists though they are no part of it.

    Of artifacts, size and digest of the content are compared. Files that are missing are left out.
    """
    root = Path(config.results)
    listed = {root / each.path: each for each in manifest.files}
    artifacts, derived = artifact_files(config), derived_files(config)
    strangers = [path for path in listed if path not in artifacts and path not in derived]
    there = (path for path in (*artifacts, *derived) if path.is_file())
    differ = [path for path in there if not _is_listed(path, listed.get(path), digest)]
    if not _is_of(manifest, config):
        differ.append(root / CONFIG)
    return list(dict.fromkeys((*differ, *strangers)))


def _is_of(manifest: Manifest, config: Config) -> bool:
    """Return whether a manifest has a configuration; the folder may have been moved since."""
    try:
        recorded = parse_config(manifest.config)
    except ConfigError:
        return False
    moved = recorded.model_copy(update={"results": config.results})
    return moved == config and manifest.seed == config.campaign.seed


def _is_listed(path: Path, listed: ManifestFile | None, digest: Digests) -> bool:
    """Return whether the manifest lists a file as it is; one that cannot be read has a finding of its own."""
    if listed is None or path.stat().st_size != listed.size:
        return False
    try:
        return digest(path) == listed.digest if listed.kind == "artifact" else file_digest(path) == listed.sha256
    except (ArtifactError, OSError):
        return True


def _crate_problem(path: Path, manifest: Manifest) -> str:
    """Compare the sizes and SHA-256 in the crate with those of the manifest."""
    listed = {each.path: each for each in manifest.files}
    try:
        for entity in json.loads(read_limited(path))["@graph"]:
            if "sha256" in entity:
                name = entity["@id"]
                known = listed.get(name)
                if not known or (entity["sha256"], entity["contentSize"]) != (known.sha256, str(known.size)):
                    return f"describes another {name} than {MANIFEST}"
    except (OSError, ValueError, RecursionError, LookupError, TypeError) as error:
        return f"damaged: no RO-Crate of a campaign ({type(error).__name__}: {error})"
    return ""


def _name(path: Path, root: Path) -> str:
    return path.relative_to(root).as_posix()


def _some(names: Iterator[str] | set[str], most: int = 3) -> str:
    listed = sorted(names)
    more = f" and {len(listed) - most} more" if len(listed) > most else ""
    return ", ".join(listed[:most]) + more
