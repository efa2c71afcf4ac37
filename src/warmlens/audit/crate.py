"""`ro-crate-metadata.json`: a finished campaign as a Research Object Crate, for archives.

The crate describes what is published: tables, figures, report, configuration, the single artifacts, and the
chunks of each stage as a folder. The scan operator, most of the bytes, is only in the manifest: the workflow
recomputes it from the smooth model.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path, PurePosixPath

from rocrate.model.contextentity import ContextEntity
from rocrate.rocrate import ROCrate

from warmlens.artifacts.atomic import atomic_path
from warmlens.artifacts.chain import input_paths
from warmlens.artifacts.file import Header
from warmlens.artifacts.names import CHUNKED, CONFIG, CRATE, MANIFEST
from warmlens.products.manifest import Manifest, ManifestFile
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
    "record": "Record of what was made from what",
}


def write_crate(results: Path, manifest: Manifest, headers: Sequence[Header], license_url: str | None) -> None:
    """Write the metadata of the crate whose folder is `results`, where the manifest is already.

    `headers` are those of all artifacts. Without the URL of a license of the data, a note says how to name one.
    """
    crate = ROCrate(version=VERSION)
    root = crate.root_dataset
    root["name"] = f"warmlens campaign {results.resolve().name}"
    root["description"] = (
        "From the image of a strong gravitational lens to a lower bound on the mass of warm dark matter: "
        f"{manifest.config['campaign']['n_samples']} samples, seed {manifest.seed}. Sizes and SHA-256 of all "
        f"files are in {MANIFEST}."
    )
    root["datePublished"] = manifest.created_utc
    root["license"] = license_url or NO_LICENSE
    software = _add_software(crate, manifest)
    root["citation"] = _add_paper(crate)
    for listed in manifest.files:
        if listed.stage not in (*_WORKING, *CHUNKED):
            _add_file(crate, results, listed)
    about = {"name": "Sizes and digests of all files", "encodingFormat": _FORMATS[".json"]}
    crate.add_file(results / MANIFEST, MANIFEST, properties=about)
    for stage in CHUNKED:
        _add_folder(crate, results, stage, [listed.size for listed in manifest.files if listed.stage == stage])
    entities = {
        header.path: f"{header.stage}/" if header.stage in CHUNKED else header.path.relative_to(results).as_posix()
        for header in headers
    }
    for stage in dict.fromkeys(header.stage for header in headers):
        if stage not in _WORKING:
            _add_action(crate, [header for header in headers if header.stage == stage], software, entities)
    with atomic_path(results / CRATE) as temporary:
        temporary.write_text(json.dumps(crate.metadata.generate(), indent=2) + "\n", encoding="utf-8")


def _add_software(crate: ROCrate, manifest: Manifest) -> ContextEntity:
    libraries = [f"{name} {version}" for name, version in manifest.libraries.items()]
    changed = ", changed since" if manifest.git_dirty else ""
    properties = {
        "@type": "SoftwareApplication",
        "name": "warmlens",
        "version": manifest.package_version,
        "softwareVersion": f"{manifest.package_version} (git commit {manifest.git_commit}{changed})",
        "softwareRequirements": [f"Python {manifest.python}", *libraries],
        "license": "https://spdx.org/licenses/BSD-3-Clause",
    }
    return crate.add(ContextEntity(crate, "#warmlens", properties=properties))


def _add_paper(crate: ROCrate) -> ContextEntity:
    properties = {
        "@type": "ScholarlyArticle",
        "name": CITATION["title"],
        "author": CITATION["authors"],
        "datePublished": CITATION["year"],
        "isPartOf": CITATION["journal"],
        "sameAs": f"https://arxiv.org/abs/{CITATION['arxiv']}",
    }
    return crate.add(ContextEntity(crate, f"https://doi.org/{CITATION['doi']}", properties=properties))


def _add_file(crate: ROCrate, results: Path, listed: ManifestFile) -> None:
    path = PurePosixPath(listed.path)
    kind = f"Artifact of the stage {listed.stage}" if listed.stage else _KINDS[listed.kind]
    properties = {
        "name": kind if listed.path == CONFIG or listed.kind == "report" else f"{kind}: {path.stem}",
        "contentSize": str(listed.size),
        "encodingFormat": _FORMATS[path.suffix],
        "sha256": listed.sha256,
    }
    if listed.created_utc:
        properties["dateCreated"] = listed.created_utc
    crate.add_file(results / path, listed.path, properties=properties)


def _add_folder(crate: ROCrate, results: Path, stage: str, sizes: Sequence[int]) -> None:
    files = f"{len(sizes)} HDF5 files, {sum(sizes)} bytes, each a chunk of samples; digests in {MANIFEST}"
    properties = {"name": f"Artifacts of the stage {stage}", "description": files}
    crate.add_dataset(results / stage, f"{stage}/", properties=properties)


def _add_action(
    crate: ROCrate, headers: Sequence[Header], software: ContextEntity, entities: Mapping[Path, str]
) -> None:
    """Add what a stage made from which inputs; those outside of the campaign, images of the user, are left out.

    `entities` has the identifier of what describes an artifact in the crate, its own or that of its folder.
    """
    stage = headers[0].stage
    used = {entities.get(source, "") for header in headers for source in input_paths(header).values()}
    commits = sorted({header.git_commit for header in headers})
    seconds = sum(header.wall_seconds for header in headers)
    action = crate.add_action(
        software,
        identifier=f"#{stage}",
        object=[entity for name in sorted(used - {""}) if (entity := crate.dereference(name)) is not None],
        result=[crate.dereference(entities[headers[0].path])],
        properties={
            "name": f"Stage {stage}",
            "description": f"git commit {', '.join(commits)}; {seconds:.0f} s",
            "endTime": max(header.created_utc for header in headers),
        },
    )
    crate.root_dataset.append_to("mentions", action)
