"""Artifacts that somebody made to be read by mistake: always an `ArtifactError` that names the file."""

from __future__ import annotations

import dataclasses
import json
import os
import resource
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from warmlens.artifacts.atomic import ArtifactError
from warmlens.artifacts.chain import audit, check_chains, input_paths
from warmlens.artifacts.file import Dataset, content_digest, input_digest, open_artifact
from warmlens.artifacts.writing import Provenance, write_artifact
from warmlens.config.digest import settings_digest
from warmlens.imaging.grid import PixelGrid
from warmlens.products.observation import copy_bands, read_observation
from warmlens.products.samples import SampleTable

EXPECTED = {"halos": settings_digest({}), "deflections": settings_digest({})}


@pytest.fixture(autouse=True)
def bounded_memory() -> Iterator[None]:
    """A file of kilobytes must not ask for more than 2 GiB beyond what the tests have taken already."""
    taken = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    limits = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (taken + 2**31, limits[1]))
    yield
    resource.setrlimit(resource.RLIMIT_AS, limits)


@pytest.fixture
def sound(tmp_path: Path) -> Path:
    return _write(tmp_path / "campaign/halos/chunk-0000000-0000003.h5")


def _write(path: Path, stage: str = "halos", **inputs: Path) -> Path:
    datasets = {
        "group/maps": Dataset(np.ones((3, 8, 9), dtype=np.float32), "arcsec", ("n", "y", "x"), "maps"),
        "numbers": Dataset(np.arange(3.0), "keV", ("n",), "numbers"),
        "words": Dataset(["a", "", "b"], "", ("n",), "text"),
    }
    write_artifact(path, Provenance(stage, {}, inputs, span=(0, 3)), datasets, {"bands": ["F814W"]})
    with h5py.File(path, "r+") as file:
        del file.attrs["seal"], file.attrs["arrays"]  # whoever makes a hostile file makes one that fits, or none
    return path


def _refused(path: Path, reason: str) -> None:
    with pytest.raises(ArtifactError, match=reason) as error, open_artifact(path):
        pass
    assert str(path) in str(error.value)
    assert "run the campaign again" in str(error.value)


def test_a_sound_artifact_is_read(sound: Path) -> None:
    with open_artifact(sound, "halos") as artifact:
        assert artifact.names == ("group/maps", "numbers", "words")
        assert content_digest(artifact.file, artifact.metadata) == artifact.digest
        assert artifact.dataset("numbers").axes == ("n",)


def _elsewhere(file: h5py.File) -> str:
    """Another file in the same folder, with something to be stolen."""
    other = Path(file.filename).with_name("secret.h5")
    with h5py.File(other, "w") as secret:
        secret["numbers"] = np.arange(3.0)
    return str(other)


def _replace(file: h5py.File, node: Any) -> None:
    del file["numbers"]
    file["numbers"] = node


def _external_link(file: h5py.File) -> None:
    _replace(file, h5py.ExternalLink(_elsewhere(file), "/numbers"))


def _external_group(file: h5py.File) -> None:
    file["more"] = h5py.ExternalLink(_elsewhere(file), "/")


def _soft_link(file: h5py.File) -> None:
    _replace(file, h5py.SoftLink("/group/maps"))


def _dangling_link(file: h5py.File) -> None:
    file["nowhere"] = h5py.SoftLink("/absent")


def _second_link(file: h5py.File) -> None:
    file["again"] = file["numbers"]


def _cycle(file: h5py.File) -> None:
    file["group/back"] = file["group"]


def _cycle_to_the_root(file: h5py.File) -> None:
    file["group/root"] = file["/"]


def _deep(file: h5py.File) -> None:
    group = file["group"]
    for _ in range(3000):
        group = group.create_group("g")


def _many(file: h5py.File) -> None:
    for i in range(2001):
        file.create_group(f"many/{i}")


def _raw_file(file: h5py.File) -> None:
    del file["numbers"]
    file.create_dataset("numbers", (3,), "f8", external=[("/etc/passwd", 0, 24)])


def _virtual(file: h5py.File) -> None:
    layout = h5py.VirtualLayout((3,), "f8")
    layout[:] = h5py.VirtualSource(_elsewhere(file), "numbers", (3,))
    del file["numbers"]
    file.create_virtual_dataset("numbers", layout)


def _references(file: h5py.File) -> None:
    file.create_dataset("pointers", data=[file["numbers"].ref], dtype=h5py.ref_dtype)


def _region_references(file: h5py.File) -> None:
    file.create_dataset("pointers", data=[file["numbers"].regionref[:2]], dtype=h5py.regionref_dtype)


def _named_type(file: h5py.File) -> None:
    file["type"] = np.dtype("f8")


def _compound(file: h5py.File) -> None:
    file.create_dataset("table", data=np.zeros(3, dtype=[("a", "f8"), ("b", "i4")]))


def _vlen(file: h5py.File) -> None:
    file.create_dataset("ragged", (3,), dtype=h5py.vlen_dtype(np.float64))


def _huge_chunked(file: h5py.File) -> None:
    file.create_dataset("huge", (10**15,), "f8", chunks=(1000,), fillvalue=1.0)


def _huge_contiguous(file: h5py.File) -> None:
    file.create_dataset("huge", (10**8, 10**7), "f8")


def _huge_product(file: h5py.File) -> None:
    file.create_dataset("huge", (2**33, 2**33, 2**33), "f8", chunks=(1, 1, 1))


def _vlen_text(file: h5py.File) -> None:
    del file["words"]
    file["words"] = ["a", "", "b"]


def _huge_text(file: h5py.File) -> None:
    file.create_dataset("huge", (10**6,), "S1000000", chunks=(1,))


def _huge_chunk(file: h5py.File) -> None:
    file.create_dataset("huge", (3,), "f8", chunks=(2**28,), maxshape=(None,), compression="gzip")


def _bomb(file: h5py.File) -> None:
    shape = (80, 2**23)  # 5 GiB of zeros
    bomb = file.create_dataset("bomb", shape, "f8", chunks=(1, 2**23), compression="gzip", compression_opts=9)
    bomb[0] = 0.0
    packed = bomb.id.read_direct_chunk((0, 0))[1]
    for row in range(80):
        bomb.id.write_direct_chunk((row, 0), packed)


def _chunk_bomb(file: h5py.File) -> None:
    bomb = file.create_dataset("bomb", (1000,), "f8", chunks=(1000,), compression="gzip")
    bomb.id.write_direct_chunk((0,), bytes(2**23))  # may inflate to 8 GiB, though 8000 bytes are declared


def _foreign_filter(file: h5py.File) -> None:
    file.create_dataset("packed", data=np.zeros(1000), chunks=(100,), compression="lzf")


def _without_shape(file: h5py.File) -> None:
    file["null"] = h5py.Empty("f8")


STRUCTURES: list[tuple[Callable[[h5py.File], None], str]] = [
    (_external_link, "'numbers' is a link to elsewhere"),
    (_external_group, "'more' is a link to elsewhere"),
    (_soft_link, "'numbers' is a link to elsewhere"),
    (_dangling_link, "'nowhere' is a link to elsewhere"),
    (_second_link, "is linked more than once"),
    (_cycle, "is linked more than once"),
    (_cycle_to_the_root, "is linked more than once"),
    (_deep, "nested more than 6 deep"),
    (_many, "more than 2000 groups and datasets"),
    (_raw_file, "'numbers' is stored in other files"),
    (_virtual, "'numbers' is stored in other files"),
    (_references, "'pointers' is of type object, which is neither numbers nor text"),
    (_region_references, "'pointers' is of type object, which is neither"),
    (_named_type, "'type' is neither a dataset nor a group"),
    (_compound, "'table' is of type"),
    (_vlen, "'ragged' is of type"),
    (_huge_chunked, r"'huge' declares shape \(1000000000000000,\), which is not what is stored"),
    (_huge_contiguous, "'huge' declares shape"),
    (_huge_product, "'huge' declares shape"),
    (_vlen_text, "'words' is of type object, which is neither numbers nor text"),
    (_huge_text, "'huge' declares shape"),
    (_huge_chunk, "'huge' (has chunks that are larger|declares shape)"),
    (_bomb, "'bomb' declares shape"),
    (_chunk_bomb, "'bomb' has a compressed chunk of 8388608 bytes"),
    (_foreign_filter, "'packed' needs filters that no artifact has"),
    (_without_shape, "'null' is empty without a shape"),
]


@pytest.mark.parametrize(("change", "reason"), STRUCTURES, ids=[item[0].__name__ for item in STRUCTURES])
def test_hostile_structures(sound: Path, change: Callable[[h5py.File], None], reason: str) -> None:
    with h5py.File(sound, "r+", libver=("v110", "v110")) as file:
        change(file)
    assert sound.stat().st_size < 2**25
    _refused(sound, reason)


NOT_JSON = ("[]", "7", "null", "{", "NaN", "'{}'", "")
HEADERS: list[tuple[str, Any, str]] = [
    *((name, None, f"no attribute '{name}'") for name in ("stage", "settings", "metadata", "inputs", "span")),
    *((name, None, f"no attribute '{name}'") for name in ("digest", "wall_seconds", "schema_version")),
    ("complete", None, "incomplete or not a warmlens artifact"),
    ("complete", 0, "incomplete or not a warmlens artifact"),
    ("complete", np.ones(5), "'complete' is not a finite number"),
    ("complete", "yes", "'complete' is not a finite number"),
    ("schema_version", np.arange(100_000), "'schema_version' is not a finite number"),
    ("schema_version", np.nan, "'schema_version' is not a finite number"),
    ("schema_version", 99, "schema version 99, this program reads 2"),
    ("stage", 5, "'stage' is not text"),
    ("stage", ["halos"], "'stage' is not text"),
    ("stage", np.array("halos", dtype=h5py.string_dtype()), "'stage' is not text"),  # of variable length
    ("stage", h5py.Empty("f8"), "'stage' is not text"),
    ("stage", b"halos\xff", "'stage' is not text in UTF-8"),
    ("seed_key", b"\xed\xa0\x80", "'seed_key' is not text in UTF-8"),
    *(("settings", text, "'settings' is not (JSON|a JSON object)") for text in NOT_JSON),
    *(("metadata", text, "'metadata' is not (JSON|a JSON object)") for text in NOT_JSON),
    ("metadata", '{"a":' + "[" * 100_000 + "]" * 100_000 + "}", "'metadata' is nested too deep"),
    ("metadata", '{"a":' + "9" * 5000 + "}", "'metadata' is not JSON"),
    ("metadata", '{"a":"' + "x" * 2**25 + '"}', "'metadata' is 33554440 bytes long"),
    ("inputs", '{"halos": "observation.h5"}', "'halos' is not recorded as a path and a digest"),
    ("inputs", '{"halos": {"path": 5, "digest": ""}}', "'halos' is not recorded"),
    ("inputs", '{"halos": {"path": "x.h5"}}', "'halos' is not recorded"),
    ("span", "0-3", "'span' is no span"),
    ("span", np.zeros(3), "'span' is no span"),
    ("span", [0.0, np.nan], "which is no span"),
    ("span", [0, 10**12], "which is no span"),
    ("span", [3, 0], "which is no span"),
    ("span", [-1, 3], "which is no span"),
    ("span", [0.5, 3.0], "which is no span"),
    ("wall_seconds", np.inf, "'wall_seconds' is not a finite number"),
    ("wall_seconds", "long", "'wall_seconds' is not a finite number"),
]


@pytest.mark.parametrize(("name", "value", "reason"), HEADERS, ids=lambda item: repr(item)[:30])
def test_hostile_headers(sound: Path, name: str, value: Any, reason: str) -> None:
    with h5py.File(sound, "r+", libver=("v110", "v110")) as file:
        del file.attrs[name]
        if value is not None:
            file.attrs[name] = np.bytes_(value) if isinstance(value, str | bytes) else value
    _refused(sound, reason)


def test_what_is_no_file(tmp_path: Path) -> None:
    (tmp_path / "folder.h5").mkdir()
    os.mkfifo(tmp_path / "fifo.h5")  # opening it would wait for ever
    for name in ("folder.h5", "fifo.h5"):
        _refused(tmp_path / name, "not a file, expected an artifact")
    with pytest.raises(ArtifactError, match="not a file"):
        input_digest(Path("/dev/zero"))  # never ends


def test_text(sound: Path) -> None:
    with h5py.File(sound, "r+") as file:
        file["words"][1] = b"\xff\xfe"
    with (
        open_artifact(sound) as artifact,
        pytest.raises(ArtifactError, match="dataset 'words' is damaged") as error,
    ):
        artifact.strings("words")
    assert str(sound) in str(error.value)
    with open_artifact(sound) as artifact:
        with pytest.raises(ArtifactError, match="'words' is text, expected numbers"):
            artifact.array("words")
        with pytest.raises(ArtifactError, match="'numbers' is numbers, expected text"):
            artifact.strings("numbers")


# ---------------------------------------------------------------------------------------------- chains


def _with_input(path: Path, recorded: str, name: str = "halos") -> None:
    with h5py.File(path, "r+") as file:
        file.attrs["inputs"] = np.bytes_(json.dumps({name: {"path": recorded, "digest": "0" * 64}}))


def _campaign(tmp_path: Path) -> tuple[Path, Path]:
    halos = _write(tmp_path / "campaign/halos/chunk-0000000-0000003.h5")
    deflections = tmp_path / "campaign/deflections/chunk-0000000-0000003.h5"
    return halos, _write(deflections, "deflections", halos=halos)


def test_a_sound_chain(tmp_path: Path) -> None:
    _, deflections = _campaign(tmp_path)
    check_chains([deflections], EXPECTED)
    assert audit({deflections: "deflections"}, EXPECTED) == []


def test_inputs_stay_in_the_results_folder(tmp_path: Path) -> None:
    _, deflections = _campaign(tmp_path)
    outside = _write(tmp_path / "other/halos/chunk-0000000-0000003.h5")
    (tmp_path / "campaign/halos/link.h5").symlink_to(outside)
    for recorded in (
        "../../other/halos/chunk-0000000-0000003.h5",
        str(outside),
        "../halos/link.h5",
        "../../../../../../etc/passwd",
        "/dev/zero",
        "../halos/../config.yaml",
        "\0",
        "../" + "x" * 5000 + ".h5",
        "../halos/" + "d/" * 5000 + "x.h5",
        "",
    ):
        _with_input(deflections, recorded)
        with pytest.raises(ArtifactError, match="run the campaign again") as error:
            check_chains([deflections], EXPECTED)
        assert str(deflections) in str(error.value)
        findings = audit({deflections: "deflections"}, EXPECTED)
        assert [finding.path for finding in findings] == [deflections]


def test_the_results_folder_may_be_a_symbolic_link(tmp_path: Path) -> None:
    _campaign(tmp_path)
    (tmp_path / "scratch").symlink_to(tmp_path / "campaign")
    linked = tmp_path / "scratch/deflections/chunk-0000000-0000003.h5"
    check_chains([linked], EXPECTED)
    assert audit({linked: "deflections"}, EXPECTED) == []


def test_an_artifact_that_is_its_own_input(tmp_path: Path) -> None:
    _, deflections = _campaign(tmp_path)
    with h5py.File(deflections, "r+") as file:
        digest = file.attrs["digest"].decode()
        file.attrs["inputs"] = np.bytes_(json.dumps({"self": {"path": deflections.name, "digest": digest}}))
    check_chains([deflections], EXPECTED)  # ends


def test_an_observation_may_come_from_anywhere_but_only_by_name(tmp_path: Path) -> None:
    image = tmp_path / "data/sci.fits"
    image.parent.mkdir()
    image.write_bytes(b"image")
    base = _write(tmp_path / "other/observation.h5", "observation")
    path = tmp_path / "campaign/observation.h5"
    for inputs in ({"F814W/science": image}, {"artifact": base}):
        _write(path, "observation", **inputs)
        assert audit({path: "observation"}, {}) == []
        check_chains([path], {})
        with open_artifact(path) as artifact:
            assert list(input_paths(artifact, path).values()) == list(inputs.values())
    _with_input(path, "../../../etc/shadow", name="passwords")
    with pytest.raises(ArtifactError, match="an observation is not made from"):
        check_chains([path], {})
    os.mkfifo(tmp_path / "fifo")
    for recorded in ("../fifo", "/dev/zero", "../data"):
        _with_input(path, recorded, name="F814W/science")
        with pytest.raises(ArtifactError, match="not a file"):
            check_chains([path], {})


# ---------------------------------------------------------------------------------------------- stages


def _observation(path: Path, shape: tuple[int, ...] = (8, 8), **changes: Any) -> Path:
    metadata = {
        "kind": "fits",
        "grid": dataclasses.asdict(PixelGrid.centred((8, 8), 0.05)),
        "bands": ["F814W"],
        "noise": {"F814W": {"background_rms": 0.1, "exposure_s": 1.0}},
        **changes,
    }
    axes = tuple("abcdef"[: len(shape)])
    datasets = {
        f"F814W/{name}": Dataset(np.ones(shape, dtype=dtype), "", axes, name)
        for name, dtype in (("image", float), ("sigma", float), ("mask", bool), ("psf", float))
    }
    write_artifact(path, Provenance("observation", {}), datasets, metadata)
    return path


def test_a_sound_observation(tmp_path: Path) -> None:
    path = _observation(tmp_path / "observation.h5")
    assert read_observation(path).bands[0].image.shape == (8, 8)
    assert set(copy_bands(path, ["F814W"])[0]) == {f"F814W/{name}" for name in ("image", "sigma", "mask", "psf")}


@pytest.mark.parametrize(
    "changes",
    [
        {"shape": (64,)},
        {"shape": (2, 8, 8)},
        {"shape": (8, 9)},
        {"bands": 5},
        {"bands": ["F160W"]},
        {"bands": ["../../F814W"]},
        {"bands": None},
        {"grid": {}},
        {"grid": [1, 2]},
        {"grid": {"ny": 8, "axes": 3}},
        {"noise": {}},
        {"noise": {"F814W": {"x": 1}}},
        {"noise": "much"},
    ],
    ids=str,
)
def test_observations_that_fit_nothing(tmp_path: Path, changes: dict[str, Any]) -> None:
    path = _observation(tmp_path / "observation.h5", **changes)
    for read in (read_observation, lambda path: copy_bands(path, ["F814W"])):
        with pytest.raises(ArtifactError, match="run the campaign again") as error:
            read(path)
        assert str(path) in str(error.value)


def test_metadata_that_lack_a_key(sound: Path) -> None:
    with open_artifact(sound) as artifact:
        assert artifact.metadata == {"bands": ["F814W"]}
        with pytest.raises(ArtifactError, match="its metadata have no 'fits'") as error:
            artifact.metadata["fits"]
    assert str(sound) in str(error.value)


def test_a_table_of_samples_with_columns_that_differ(tmp_path: Path) -> None:
    table = SampleTable.without_substructure(4).datasets()
    path = tmp_path / "chunk.h5"
    write_artifact(path, Provenance("halos", {}), table, {})
    with open_artifact(path) as artifact:
        assert len(SampleTable.read(artifact)) == 4
    for name, data in (("status", np.zeros(3)), ("message", ["", ""]), ("sample_id", np.zeros((4, 1)))):
        axes = ("n",) if isinstance(data, list) else tuple("ab"[: data.ndim])
        write_artifact(
            path, Provenance("halos", {}), {**table, f"samples/{name}": Dataset(data, "", axes, "")}, {}
        )
        with (
            open_artifact(path) as artifact,
            pytest.raises(ArtifactError, match=r"chunk\.h5: its table of samples has columns"),
        ):
            SampleTable.read(artifact)
