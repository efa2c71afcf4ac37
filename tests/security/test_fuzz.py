"""Random configurations, FITS files and artifacts: a valid object or the error that users see, and nothing else.

A few examples by default, always the same; `WARMLENS_FUZZ=1500 pytest tests/security/test_fuzz.py` tries 10,500.
"""

from __future__ import annotations

import contextlib
import faulthandler
import gzip
import json
import os
import resource
import signal
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import yaml
from astropy.io import fits
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from warmlens.artifacts.atomic import ArtifactError
from warmlens.artifacts.chain import audit, check_chains, input_paths
from warmlens.artifacts.file import Dataset, content_digest, open_artifact
from warmlens.artifacts.writing import Provenance, write_artifact
from warmlens.campaign.files import chunks, shards
from warmlens.config.file import ConfigError, expand_path, parse_block, parse_config
from warmlens.config.model import Config
from warmlens.config.observation import FitsBandBlock
from warmlens.config.yaml import read_yaml
from warmlens.products.images import read_band
from warmlens.products.observation import read_observation
from warmlens.stage_table import STAGES, stage_settings

ROOT = Path(__file__).parents[2]
EXAMPLES = int(os.environ.get("WARMLENS_FUZZ", "30"))
SECONDS = 20.0  # an example takes milliseconds; a busy machine needs room
fuzz = settings(
    max_examples=EXAMPLES,
    deadline=None,
    derandomize="WARMLENS_FUZZ" not in os.environ,
    suppress_health_check=list(HealthCheck),
    database=None,
)


@pytest.fixture(scope="module", autouse=True)
def bounded_memory() -> Iterator[None]:
    taken = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    limits = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (taken + 2**31, limits[1]))
    yield
    resource.setrlimit(resource.RLIMIT_AS, limits)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("fuzz")


@contextlib.contextmanager
def user_errors(*classes: type[Exception]) -> Iterator[None]:
    """Errors that users see are fine if they are short; a hang and anything else are not.

    A library that hangs where Python gets no word ends the whole run; the file that it read is left in `folder`.
    """

    def stop(*_: object) -> None:
        raise AssertionError(f"took longer than {SECONDS} s")

    signal.signal(signal.SIGALRM, stop)
    signal.setitimer(signal.ITIMER_REAL, SECONDS)
    faulthandler.dump_traceback_later(3 * SECONDS, exit=True)
    try:
        yield
    except classes as error:
        assert 0 < len(str(error)) < 100_000
    finally:
        faulthandler.cancel_dump_traceback_later()
        signal.setitimer(signal.ITIMER_REAL, 0.0)


# ------------------------------------------------------------------------------------------ configuration

SCALARS = st.one_of(
    st.none(),
    st.booleans(),
    st.integers(),
    st.integers(-3, 60),
    st.sampled_from([10**9, 10**18, 10**400, -(10**400), 2**63]),
    st.floats(),
    st.floats(0.01, 20.0),
    st.text(max_size=12),
    st.sampled_from(["", "../x", "a/b", "\0", "$HOME", "${", "~x", "nan", "1e3", "{a}", "fits", "grid", "F814W"]),
    st.binary(max_size=4),
    st.dates(),
)
VALUES = st.recursive(
    SCALARS,
    lambda inner: st.one_of(
        st.lists(inner, max_size=4),
        st.tuples(inner, inner).map(list),
        st.dictionaries(st.one_of(st.text(max_size=6), st.integers(), st.none()), inner, max_size=3),
    ),
    max_leaves=8,
)
PAPER: dict[str, Any] = json.loads(json.dumps(yaml.safe_load((ROOT / "config.yaml").read_text())))


def _paths(value: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    if path:
        yield path
    items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for key, item in items:
        yield from _paths(item, (*path, key))


def _set(value: Any, path: tuple[Any, ...], new: Any) -> Any:
    if not path:
        return new
    copy = value.copy()
    with contextlib.suppress(KeyError, IndexError, TypeError, AttributeError):  # an earlier change took it away
        copy[path[0]] = _set(copy[path[0]], path[1:], new)
    return copy


NUMBERS = st.floats(0.0, 20.0) | st.integers(0, 60) | st.floats()  # where a configuration may still be valid
CHANGED = st.booleans().flatmap(lambda number: NUMBERS if number else VALUES)
CHANGES = st.lists(st.tuples(st.sampled_from(sorted(_paths(PAPER), key=str)), CHANGED), min_size=1, max_size=2)


@fuzz
@given(changes=CHANGES)
def test_values_of_the_configuration(changes: list[tuple[tuple[Any, ...], Any]]) -> None:
    raw = PAPER
    for path, value in changes:
        raw = _set(raw, path, value)
    with user_errors(ConfigError):  # also of what nobody means, which a campaign is not started with
        config = parse_block(Config, raw)
        assert parse_block(Config, json.loads(config.model_dump_json())) == config
        assert len(chunks(config)) <= 10_000
        assert len(shards(config)) <= 10_000
        with contextlib.suppress(ConfigError):
            assert parse_config(raw) == config
        for stage in STAGES:
            with contextlib.suppress(ValueError):  # a stage that this campaign has not
                stage_settings(config, stage)


FRAGMENTS = st.sampled_from(
    [
        "a", "b: ", "- ", ": ", "\n", "\n  ", "\n    ", "[", "]", "{", "}", ", ", "&a ", "*a", "<<: ", "? ", "!",
        "!!", "!!python/object/apply:os.getcwd []", "!!set", "!!binary ", "|", ">", "|-\n ", "'", '"', "\\", "#",
        "%YAML 9\n", "---\n", "...\n", "\t", "\0", "\ufeff", "\u2028", "\x85", "no", "1e3", "0o7", "010", "1:2:3",
        "2001-01-01", "2001-13-99", ".inf", "-.nan", "9" * 400, "0x", "0b2", "1_", "~", "=", "@", "`",
        "results: ", "campaign:\n",
    ]
)  # fmt: skip


@fuzz
@given(
    content=st.one_of(
        st.lists(st.one_of(FRAGMENTS, st.text(max_size=3)), max_size=40).map(lambda parts: "".join(parts)),
        VALUES.map(lambda value: yaml.dump({"a": value})),
    ).map(lambda text: text.encode("utf-8", "surrogatepass"))
    | st.binary(max_size=60)
)
def test_text_of_the_configuration(folder: Path, content: bytes) -> None:
    path = folder / "overlay.yaml"
    path.write_bytes(content)
    with user_errors(ConfigError):
        layer = read_yaml(path)
        assert all(isinstance(key, str) for key in layer)
        parse_config({**PAPER, **layer})


@fuzz
@given(text=st.text(max_size=30) | st.lists(st.sampled_from("$~{}/.a \n\0\\'")).map("".join))
def test_paths(text: str) -> None:
    with user_errors(ConfigError):
        assert str(expand_path(text)).isprintable()
    with user_errors(ConfigError):
        assert ".." not in Path(parse_config({**PAPER, "results": text}).results).parts


# --------------------------------------------------------------------------------------------------- FITS

SHAPE = (21, 21)
PIXELS = np.ones(SHAPE, dtype=">f4")
PIXELS[10, 10] = 50.0  # so that it is a PSF too
CARDS: dict[str, Any] = {
    "SIMPLE": "T", "BITPIX": -32, "NAXIS": 2, "NAXIS1": SHAPE[1], "NAXIS2": SHAPE[0], "EXTEND": "T",
    "BUNIT": "'electron/s'", "EXPTIME": 1980.0, "BKGRMS": 0.008, "BSCALE": 1.0, "BZERO": 0.0,
    "CTYPE1": "'RA---TAN'", "CTYPE2": "'DEC--TAN'", "CRVAL1": 172.96, "CRVAL2": -12.53, "CRPIX1": 11.0,
    "CRPIX2": 9.5, "CD1_1": -1.4e-5, "CD1_2": 0.0, "CD2_1": 0.0, "CD2_2": 1.4e-5,
}  # fmt: skip
STRUCTURE = ("SIMPLE", "BITPIX", "NAXIS", "NAXIS1", "NAXIS2")
FURTHER = (
    "NAXIS3", "GROUPS", "PCOUNT", "GCOUNT", "BLANK", "WCSAXES", "CDELT1", "CROTA2", "PC1_1", "CUNIT1", "LONPOLE",
    "A_ORDER", "PV2_1", "CPDIS1", "TFIELDS", "XTENSION", "ZIMAGE", "CONTINUE", "HIERARCH NAXIS", "CHECKSUM",
    "naxis", "", "COMMENT", "END", "CRPIX99", "EQUINOX", "RADESYS", "DATE-OBS", "MJD-OBS",
    "LATPOLE", "PV1_3", "PS1_1", "PC001001",
)  # fmt: skip
CARD_VALUES = st.one_of(
    st.integers(-(10**19), 10**19),
    st.integers(-2, 40),
    st.sampled_from([8, 16, 32, 64, -32, -64, 999_999_999, 2**31, 2**63]),
    st.floats(),
    st.sampled_from(["T", "F", "", "'", "''", "'x", "1E999", "(1, 2)", "NaN", "-INF", "'GLON-CAR'", "'DEC--SIN'"]),
    st.text(max_size=20),
)


def _header(cards: list[tuple[str, Any]]) -> bytes:
    text = b"".join(f"{key:8s}= {value!s:>20s}".encode("utf-8", "replace")[:80].ljust(80) for key, value in cards)
    return (text + b"END".ljust(80)).ljust(-(-(len(text) + 80) // 2880) * 2880)


@pytest.fixture(scope="module")
def psf(folder: Path) -> str:
    image = np.zeros((5, 5))
    image[2, 2] = 3.0
    fits.PrimaryHDU(image).writeto(folder / "psf.fits")
    return str(folder / "psf.fits")


def _read_both(science: Path, psf: str, extension: int = 0) -> None:
    """As the image, and as the PSF of an image."""
    for block in (
        FitsBandBlock(science=str(science), psf=psf, extension=extension),
        FitsBandBlock(science=psf, psf=str(science), units="electron/s", exposure_s=1.0, background_rms=1.0,
                      pixel_scale_arcsec=0.05, center_pixel=(2.0, 2.0)),
    ):  # fmt: skip
        with user_errors(ConfigError):
            grid, band = read_band("F814W", block)
            assert band.image.shape == grid.shape
            assert np.isfinite(band.image).all()
            assert band.psf.sum() == pytest.approx(1.0)


@fuzz
@given(
    changes=st.lists(st.tuples(st.sampled_from(sorted({*CARDS} - {*STRUCTURE})), CARD_VALUES), max_size=3),
    structure=st.lists(st.tuples(st.sampled_from([*STRUCTURE, *FURTHER]), CARD_VALUES), max_size=1),
    first=st.booleans(),
    n_bytes=st.sampled_from([2880, 2880, 2880, 1764, 100, 5760]),
    extension=st.sampled_from([0, 0, 0, 2]),
)
def test_headers_of_fits_files(
    folder: Path,
    psf: str,
    changes: list[tuple[str, Any]],
    structure: list[tuple[str, Any]],
    first: bool,
    n_bytes: int,
    extension: int,
) -> None:
    known = {key: value for key, value in [*changes, *structure] if key in CARDS}
    further = [item for item in structure if item[0] not in CARDS]
    simple, *cards = {**CARDS, **known}.items()
    path = folder / "science.fits"
    header = _header([simple, *further, *cards] if first else [simple, *cards, *further])
    path.write_bytes(header + PIXELS.tobytes().ljust(5760, b"\0")[:n_bytes])
    _read_both(path, psf, extension)


DAMAGE = st.lists(
    st.tuples(st.integers(0, 10**6), st.integers(0, 255) | st.sampled_from(list(b"0123456789-.TF' \xff"))),
    max_size=6,
)


def _damage(content: bytes, changes: list[tuple[int, int]], end: float) -> bytes:
    """Other bytes after the signature, which would be refused at once."""
    damaged = bytearray(content)
    for place, byte in changes:
        damaged[10 + 2654435761 * place % (len(content) - 10)] = byte
    return bytes(damaged[: max(1, int(end * len(content)))])


@fuzz
@given(changes=DAMAGE, end=st.sampled_from([1.0, 1.0, 1.0, 1.0, 0.7]), packed=st.booleans())
def test_damaged_fits_files(
    folder: Path, psf: str, changes: list[tuple[int, int]], end: float, packed: bool
) -> None:
    content = _header(list(CARDS.items())) + PIXELS.tobytes().ljust(2880, b"\0")
    content = gzip.compress(content, mtime=0) if packed else content
    path = folder / "damaged.fits"
    path.write_bytes(_damage(content, changes, end))
    _read_both(path, psf)


# ---------------------------------------------------------------------------------------------- artifacts


@pytest.fixture(scope="module")
def intact(folder: Path) -> bytes:
    path = folder / "campaign/observation.h5"
    (folder / "sci.fits").write_bytes(b"image")
    grid = {"ny": 6, "nx": 7, "pixel_scale": 0.05, "origin_x": 0.0, "origin_y": 0.0, "axes": [[1, 0], [0, 1]]}
    metadata = {
        "kind": "fits",
        "grid": grid,
        "bands": ["B"],
        "noise": {"B": {"background_rms": 1.0, "exposure_s": 1.0}},
    }
    datasets = {
        f"B/{name}": Dataset(np.ones((6, 7), dtype=dtype), "", ("y", "x"), name)
        for name, dtype in (("image", np.float32), ("sigma", float), ("mask", bool), ("psf", float))
    }
    datasets["words"] = Dataset(["a", "bc"], "", ("n",), "text")
    inputs = {"B/science": folder / "sci.fits"}
    write_artifact(path, Provenance("observation", {"a": 1}, inputs, span=(0, 3)), datasets, metadata)
    return path.read_bytes()


def _read_artifact(path: Path) -> None:
    with user_errors(ArtifactError), open_artifact(path) as artifact:
        for name in artifact.names:
            artifact.dataset(name)
        input_paths(artifact, path)
    with user_errors(ArtifactError):
        read_observation(path)
    with user_errors(ArtifactError):
        check_chains([path], {"observation": "0"})
    with user_errors():
        audit({path: "observation"}, {})


ATTRIBUTES = (
    "complete", "schema_version", "stage", "digest", "settings", "metadata", "inputs", "span", "wall_seconds",
    "seed_key", "created_utc",
)  # fmt: skip
JSON = st.recursive(
    st.none() | st.booleans() | st.integers(-5, 5) | st.floats() | st.text(max_size=8),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(
        st.sampled_from(["bands", "grid", "noise", "kind", "B", "path", "digest", "B/science", "artifact"]), inner
    ),
    max_leaves=8,
)  # fmt: skip
ATTRIBUTE_VALUES = st.one_of(
    st.none(),
    st.integers(-(2**62), 2**62),
    st.floats(),
    JSON.map(json.dumps),
    st.text(st.characters(exclude_categories=["Cs"], exclude_characters="\0"), max_size=10),
    st.lists(st.floats(), max_size=3).map(np.array),
    st.binary(max_size=6).map(np.bytes_),
)


@fuzz
@given(
    changes=st.lists(st.tuples(st.sampled_from(ATTRIBUTES), ATTRIBUTE_VALUES), max_size=3),
    node=st.sampled_from(
        [None, "soft", "external", "hard", "group", "ragged", "huge", "scalar", "shape", "strings", "axes"]
    ),
)
def test_attributes_and_nodes_of_artifacts(
    folder: Path, intact: bytes, changes: list[tuple[str, Any]], node: str | None
) -> None:
    path = folder / "campaign/changed.h5"
    path.write_bytes(intact)
    with h5py.File(path, "r+", libver=("v110", "v110")) as file:
        for name, value in changes:
            if name in file.attrs:
                del file.attrs[name]
            if value is not None:
                file.attrs[name] = value
        match node:
            case "soft":
                file["more"] = h5py.SoftLink("/B")
            case "external":
                file["B/more"] = h5py.ExternalLink("observation.h5", "/B")
            case "hard":
                file["B/more"] = file["B"]
            case "group":
                file.create_group("more/and/more")
            case "ragged":
                file.create_dataset("more", (2,), dtype=h5py.vlen_dtype(np.int8))
            case "huge":
                file.create_dataset("more", (10**12, 10**12), chunks=(1, 1), dtype="f8")
            case "scalar":
                file["more"] = 5.0
            case "shape":
                del file["B/image"]
                file["B/image"] = np.ones(42)
            case "strings":
                del file["B/image"]
                file.create_dataset("B/image", data=[["a", "b"]], dtype=h5py.string_dtype())
            case "axes":
                file["B/image"].attrs["axes"] = 5
    _read_artifact(path)


@fuzz
@given(changes=DAMAGE, end=st.sampled_from([1.0, 1.0, 1.0, 1.0, 0.9]))
def test_damaged_artifacts(folder: Path, intact: bytes, changes: list[tuple[int, int]], end: float) -> None:
    path = folder / "campaign/damaged.h5"
    path.write_bytes(_damage(intact, changes, end))
    _read_artifact(path)


def test_what_is_not_changed_is_read(folder: Path, intact: bytes, psf: str) -> None:
    """Without it the readers above might refuse everything."""
    assert isinstance(parse_config(PAPER), Config)
    path = folder / "campaign/observation.h5"
    with open_artifact(path) as artifact:
        assert content_digest(artifact.file, artifact.metadata) == artifact.digest
    assert audit({path: "observation"}, {}) == []
    assert read_observation(path).grid.shape == (6, 7)
    science = folder / "intact.fits"
    science.write_bytes(_header(list(CARDS.items())) + PIXELS.tobytes().ljust(2880, b"\0"))
    assert read_band("F814W", FitsBandBlock(science=str(science), psf=psf))[0].shape == SHAPE
