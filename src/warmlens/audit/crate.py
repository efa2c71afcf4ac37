"""`ro-crate-metadata.json`: a finished campaign as a Research Object Crate, for archives.

The crate describes what one publishes: tables, figures, report, configuration, the single artifacts, and the
chunks of each stage as a folder. The scan operator, most of the bytes, is working data that the workflow builds
anew from the smooth model; the manifest lists it, the crate does not.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path, PurePosixPath
from typing import Any

from rocrate.model.contextentity import ContextEntity
from rocrate.rocrate import ROCrate

from warmlens.artifacts.chain import Header
from warmlens.artifacts.file import atomic_path
from warmlens.artifacts.names import (
    CHUNKED,
    CONFIG,
    CRATE,
    MANIFEST,
)
from warmlens.audit.manifest import Manifest, ManifestFile
from warmlens.text import CITATION

VERSION = "1.1"  # of RO-Crate: what archives read today
NO_LICENSE = "not chosen; `warmlens manifest RESULTS --license URL` names one"
_WORKING = ("scan_design", "scan_operator")
_FORMATS = {
    ".h5": "application/x-hdf5",
    ".csv": "text/csv",
    ".json": "application/json",
    ".png": "image/png",
    ".html": "text/html",
}
_KINDS = {
    "configuration": "Configuration of the campaign",
    "table": "Result",
    "figure": "Figure",
    "report": "Report of the campaign: one page with everything",
}


def write_crate(results: Path, manifest: Manifest, headers: Sequence[Header], license_url: str | None) -> None:
    """Write the metadata of the crate whose folder is `results`.

    Parameters
    ----------
    results
        Results folder; the manifest is in it already.
    manifest, headers
        Files of the campaign, and what the artifacts among them say of themselves.
    license_url
        Of the data; None leaves a note on how to name one.
    """
    crate = describe(results.resolve().name, results, manifest, headers, license_url)
    with atomic_path(results / CRATE) as temporary:
        temporary.write_text(json.dumps(crate.metadata.generate(), indent=2) + "\n")


def describe(
    name: str, results: Path, manifest: Manifest, headers: Sequence[Header], license_url: str | None
) -> ROCrate:
    """The crate of a campaign called `name`."""
    crate = ROCrate(version=VERSION)
    artifacts = manifest.files[: len(headers)]
    software = _software(crate, manifest)
    root = crate.root_dataset
    root["name"] = f"warmlens campaign {name}"
    root["description"] = (
        "From the image of a strong gravitational lens to a lower bound on the mass of warm dark matter: "
        f"{manifest.config['campaign']['n_samples']} samples, seed {manifest.seed}. Sizes and SHA-256 of all "
        f"files are in {MANIFEST}."
    )
    root["datePublished"] = manifest.created_utc
    root["license"] = license_url or NO_LICENSE
    root["citation"] = _paper(crate)
    for item in manifest.files:
        if item.stage not in (*_WORKING, *CHUNKED):
            _add_file(crate, results, item)
    crate.add_file(
        results / MANIFEST,
        MANIFEST,
        properties={"name": "Sizes and digests of all files", "encodingFormat": _FORMATS[".json"]},
    )
    for stage in CHUNKED:
        _add_folder(crate, results, stage, [item for item in artifacts if item.stage == stage])
    by_path = {results / item.path: item for item in artifacts}
    for stage in dict.fromkeys(header.stage for header in headers):
        if stage not in _WORKING:
            made = [(item, head) for item, head in zip(artifacts, headers, strict=True) if head.stage == stage]
            _add_action(crate, stage, made, software, by_path)
    return crate


def _software(crate: ROCrate, manifest: Manifest) -> ContextEntity:
    properties = {
        "@type": "SoftwareApplication",
        "name": "warmlens",
        "version": manifest.package_version,
        "softwareVersion": f"{manifest.package_version} (git commit {manifest.git_commit}"
        + (", changed since)" if manifest.git_dirty else ")"),
        "softwareRequirements": [f"Python {manifest.python}", *_pins(manifest.libraries)],
        "license": "https://spdx.org/licenses/BSD-3-Clause",
    }
    return crate.add(ContextEntity(crate, "#warmlens", properties=properties))


def _pins(libraries: Mapping[str, str]) -> list[str]:
    return [f"{name} {version}" for name, version in libraries.items()]


def _paper(crate: ROCrate) -> ContextEntity:
    properties = {
        "@type": "ScholarlyArticle",
        "name": CITATION["title"],
        "author": CITATION["authors"],
        "datePublished": CITATION["year"],
        "isPartOf": CITATION["journal"],
        "sameAs": f"https://arxiv.org/abs/{CITATION['arxiv']}",
    }
    return crate.add(ContextEntity(crate, f"https://doi.org/{CITATION['doi']}", properties=properties))


def _add_file(crate: ROCrate, results: Path, item: ManifestFile) -> None:
    path = PurePosixPath(item.path)
    what = f"Artifact of the stage {item.stage}" if item.stage else f"{_KINDS[item.kind]}"
    properties: dict[str, Any] = {
        "name": what if item.path == CONFIG or item.kind == "report" else f"{what}: {path.stem}",
        "contentSize": str(item.size),
        "encodingFormat": _FORMATS[path.suffix],
        "sha256": item.sha256,
    }
    if item.created_utc:
        properties["dateCreated"] = item.created_utc
    crate.add_file(results / path, item.path, properties=properties)


def _add_folder(crate: ROCrate, results: Path, stage: str, files: Sequence[ManifestFile]) -> None:
    size = sum(item.size for item in files)
    properties = {
        "name": f"Artifacts of the stage {stage}",
        "description": f"{len(files)} HDF5 files, {size} bytes, each a chunk of samples; digests in {MANIFEST}",
    }
    crate.add_dataset(results / stage, f"{stage}/", properties=properties)


def _add_action(
    crate: ROCrate,
    stage: str,
    made: Sequence[tuple[ManifestFile, Header]],
    software: ContextEntity,
    artifacts: Mapping[Path, ManifestFile],
) -> None:
    """What a stage made of what; an input outside of the campaign, the image of the user, is not named."""
    sources = {source for _, header in made for _, source, _ in header.inputs.values()}
    used = sorted({_identifier(artifacts[path]) for path in sources if path in artifacts})
    commits = sorted({header.git_commit for _, header in made})
    action = crate.add_action(
        software,
        identifier=f"#{stage}",
        object=[crate.dereference(name) for name in used if crate.dereference(name) is not None],
        result=[crate.dereference(_identifier(made[0][0]))],
        properties={
            "name": f"Stage {stage}",
            "description": f"git commit {', '.join(commits)}; {sum(head.wall_seconds for _, head in made):.0f} s",
            "endTime": max(header.created_utc for _, header in made),
        },
    )
    crate.root_dataset.append_to("mentions", action)


def _identifier(item: ManifestFile) -> str:
    """Of the entity that describes a file: its own, or the folder of its stage."""
    return f"{item.stage}/" if item.stage in CHUNKED else item.path
