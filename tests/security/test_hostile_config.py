"""Configurations that somebody made to be read by mistake: always a `ConfigError` that names file or key."""

from __future__ import annotations

import json
import os
import resource
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from astropy.io import fits

from warmlens.artifacts.file import open_artifact
from warmlens.campaign.files import chunks, shards
from warmlens.config.file import ConfigError, load_config, parse_config, read_stored
from warmlens.config.yaml import read_yaml
from warmlens.systematics.run import read_systematics

ROOT = Path(__file__).parents[2]
BIN = Path(sys.executable).parent


@pytest.fixture(autouse=True)
def bounded_memory_and_time() -> Iterator[None]:
    """A small file must not ask for more than 1 GiB beyond what the tests have taken already, or 20 seconds."""
    taken = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    limits = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (taken + 2**30, limits[1]))
    started = time.process_time()
    yield
    resource.setrlimit(resource.RLIMIT_AS, limits)
    assert time.process_time() - started < 20.0


def _laughs(depth: int) -> str:
    """Billion laughs: every line repeats the one before ten times."""
    lines = ["a0: &a0 [x, x]"]
    lines += [f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 10)}]" for i in range(1, depth)]
    return "\n".join(lines)


TEXTS: list[tuple[str | bytes, str]] = [
    ("campaign: !!python/object/apply:os.system ['touch x']", "not valid YAML"),
    ("campaign: !!python/name:os.system", "not valid YAML"),
    ("campaign: !!python/tuple [1, 2]", "not valid YAML"),
    ("campaign: !mine 3", "not valid YAML"),
    ("results: !!binary aGFsbG8=", "line 1: .*binary.* is not read"),
    ("campaign: !!set {a, b}", "is not read"),
    ("__use_yte__: true\nresults: ?open('x', 'w').name", "__use_yte__ is refused"),
    (_laughs(9), "holds more than 20000 values, counting what aliases repeat"),
    ("a: &a {b: *a}", "nested more than 30 deep|more than 20000 values"),
    ("a: &a [*a, *a]", "nested more than 30 deep|more than 20000 values"),
    ("results: a\nresults: b", "line 2: the key 'results' is given twice"),
    ("campaign:\n  seed: 1\n  n_samples: 3\n  seed: 2", "line 4: the key 'seed' is given twice"),
    ('{"results": "a", "results": "b"}', "the key 'results' is given twice"),
    ("a: &a {seed: 1}\ncampaign: {<<: *a}", "merge keys"),
    ("1: 2", "the key 1 is not text"),
    ("yes: 2", "yes is a truth value to YAML"),
    ("null: 2", "the key None is not text"),
    ("? [a, b]\n: 2", "is not text"),
    ("? {a: b}\n: 2", "is not text"),
    ("results: no", "no is a truth value to YAML; write true or false, or put it in quotes"),
    ("results: 2020-01-01", "is a date to YAML; put it in quotes"),
    ("campaign: {seed: 010}", "010 is not a plain whole number"),
    ("campaign: {seed: 0x1F}", "0x1F is not a plain whole number"),
    ("campaign: {seed: 190:20:30}", "190:20:30 is not a plain whole number"),
    ("redshifts: {lens: 1:20.5}", "1:20.5 is not a plain number"),
    ("campaign: {seed: " + "9" * 10_000 + "}", "is not a plain whole number"),
    ("[" * 200_000, "nested more than 30 deep"),
    ("a: " + "[" * 5000 + "]" * 5000, "nested more than 30 deep"),
    ("{a: " * 5000 + "1" + "}" * 5000, "nested more than 30 deep"),
    ("- " * 50_000 + "1", "nested more than 30 deep"),
    ("\n".join(" " * i + "a:" for i in range(500)), "nested more than 30 deep"),
    ("x: " + "y" * 2**18, "larger than 256 kB"),
    ("a: 1\n---\nb: 2", "not valid YAML"),
    ("", "expected a mapping of keys, found NoneType"),
    ("just text", "expected a mapping of keys, found str"),
    ("[1, 2]", "expected a mapping of keys, found list"),
    ("a: b: c", "not valid YAML"),
    ("\tresults: x", "not valid YAML"),
    (b"\xff\xfer\x00e\x00s\x00", "not text in UTF-8"),
    (b"results: \xe9t\xe9", "not text in UTF-8"),
    (b"results: a\x00b", "not valid YAML"),
    (bytes(range(256)), "not text in UTF-8"),
    (bytes(range(128, 256)) * 20, "not text in UTF-8"),
]


@pytest.mark.parametrize(("text", "reason"), TEXTS, ids=[repr(item[0][:25]) for item in TEXTS])
def test_hostile_text(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, text: str | bytes, reason: str) -> None:
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "overlay.yaml"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    for read in (read_yaml, read_systematics, lambda file: load_config([ROOT / "config.yaml", file])):
        with pytest.raises(ConfigError, match=reason) as error:
            read(path)
        assert str(path) in str(error.value)
        assert len(str(error.value)) < 2000
    assert [item.name for item in tmp_path.iterdir()] == ["overlay.yaml"]


def test_plain_data_are_read(tmp_path: Path) -> None:
    path = tmp_path / "a.yaml"
    path.write_text(
        "a: &x [1, -2, 0, 1_000, 2.5, 1.0e-3, .inf, true, False, null, 'no', \"010\", 1e3]\nb: *x\nc: {}"
    )
    layer = read_yaml(path)
    assert layer["b"] == [1, -2, 0, 1000, 2.5, 1e-3, float("inf"), True, False, None, "no", "010", "1e3"]
    path.write_text(json.dumps({"a": [1, 2.5, "\u00e9\u2609", None, True], "b": {"c": {}}}, indent=1))
    assert read_yaml(path) == json.loads(path.read_text())


def test_what_is_no_file(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "fifo")
    for name, reason in (("absent.yaml", "no such file"), ("fifo", "not a file"), (".", "not a file")):
        with pytest.raises(ConfigError, match=reason):
            read_yaml(tmp_path / name)
    with pytest.raises(ConfigError, match="not a file"):
        read_yaml(Path("/dev/zero"))


@pytest.fixture(scope="module")
def paper() -> dict[str, Any]:
    return json.loads(json.dumps(yaml.safe_load((ROOT / "config.yaml").read_text())))


def _changed(raw: dict[str, Any], key: str, value: Any) -> dict[str, Any]:
    head, _, rest = key.partition(".")
    return {**raw, head: _changed(raw[head], rest, value) if rest else value}


VALUES: list[tuple[str, Any, str]] = [
    *(("results", value, "must be a folder of its own") for value in ("/", ".", "..", "../x", "a/../../b", "//x")),
    *(("results", value, "must be a folder of its own") for value in ("~/x", "-x", "--help", "./", "///")),
    *(("results", value, "an empty path") for value in ("", " ", "\u3000")),
    *(("results", value, "cannot be printed") for value in ("a\0b", "a\nb", "a\x1b[31m", "a\u202eb", "\ud800")),
    *(("results", value, "holds braces") for value in ("a{start}", "{config}", "}")),
    *(("results", value, "valid string") for value in (5, None, ["a"], {"a": "b"}, 1.5)),
    *(
        ("observation.bands", [value], "match pattern")
        for value in ("../x", "$(touch x)", "a b", "", ".", "..", "-x")
    ),
    *(
        ("observation.bands", [value], "match pattern")
        for value in ("a/b", "a\0", "a\n", "F814W\n", "{a}", "\u00e9")
    ),
    ("observation.bands", ["x" * 65], "at most 64 characters"),
    ("observation.bands", ["rays"], "is the name of other groups in artifacts"),
    ("campaign.n_samples", 10**30, "less than or equal to 9999999"),
    ("campaign.n_samples", 9_999_999, "at most are 10000 chunks"),
    ("campaign.chunk_size", 10**9, "less than or equal to 9999999"),
    ("campaign.seed", True, "holds a truth value"),
    ("campaign.seed", 1.5, "valid integer"),
    ("campaign.seed", float("inf"), "finite number|valid integer"),
    ("campaign.n_samples", "1_000_000_000", "less than or equal to|valid integer"),
    ("dark_matter.m_th_kev", [True, 5.0], "holds a truth value"),
    ("dark_matter.m_th_kev", [1.0, float("nan")], "finite number"),
    ("dark_matter.m_th_kev", [1.0, 10**400], "valid number|finite"),
    ("cosmology.Om0", float("nan"), "less than 1"),
    ("abc.fraction", float("nan"), "greater than 0|finite|less than"),
    ("abc.max_failed_fraction", float("nan"), "greater than|finite|less than"),
    ("scan.step_arcsec", 1e-320, "must be at least 0.0001"),
    ("scan.window_arcsec", [1e300, 4.0], "holds too many steps"),
    ("observation.simulated.shape", [10**9, 10**9], "less than or equal to 4096"),
    ("observation.simulated.psf_pixels", 10**9 + 1, "less than or equal to 4096"),
    ("observation.simulated.truth.m_th_kev", float("nan"), "greater than 0"),
    ("smooth_model.lens.kwargs_lens", [{"theta_E": float("nan")}] * 4, "theta_E must be a finite number"),
    ("smooth_model.lens.kwargs_lens", [{"theta_E": "1e3"}] * 4, "theta_E must be a finite number"),
    ("smooth_model.lens.kwargs_lens", [{"coeffs": [1.0, [2.0, None]]}] * 4, "coeffs must be a finite number"),
    ("smooth_model.lens.kwargs_lens", [{"theta_E": {"a": 1}}] * 4, "theta_E must be a finite number"),
    ("smooth_model.lens.kwargs_lens", [{1: 2}] * 4, "valid string"),
    ("campaign", [], "valid dictionary"),
    ("campaign", "x" * 10_000, "valid dictionary"),
]


@pytest.mark.parametrize(("key", "value", "reason"), VALUES, ids=lambda item: repr(item)[:30])
def test_hostile_values(paper: dict[str, Any], key: str, value: Any, reason: str) -> None:
    with pytest.raises(ConfigError, match=reason) as error:
        parse_config(_changed(paper, key, value))
    assert error.value.problems[0].startswith(key.split(".")[0])
    assert len(str(error.value)) < 2000


@pytest.mark.parametrize(
    "value", ["results/x", "/scratch/me/x", "a b'c$d", 'a "b"', "a;b", "*", "a=b", "\u00e9t\u00e9", "a..b", "x/.y"]
)
def test_results_folders(paper: dict[str, Any], value: str) -> None:
    assert parse_config({**paper, "results": value}).results == value


def test_plans_that_are_too_long_are_refused_at_once(paper: dict[str, Any]) -> None:
    large = _changed(_changed(paper, "scan.window_arcsec", [400.0, 400.0]), "scan.step_arcsec", 0.01)
    config = parse_config({**large, "unusual": ["scan.window_arcsec"]})
    with pytest.raises(ConfigError, match="1600000000 positions in shards of"):
        shards(config)
    assert len(chunks(parse_config(paper))) < 100


def test_what_lies_in_a_results_folder(tmp_path: Path) -> None:
    path = tmp_path / "config.json"
    for text in ("", "[]", "{", "[" * 100_000, '{"results": 5}', '{"a":' + "9" * 5000 + "}", "\0"):
        path.write_text(text)
        with pytest.raises(ConfigError):
            read_stored(path)
    path.write_bytes(b"\xff\xfe")
    with pytest.raises(ConfigError, match="not readable as JSON"):
        read_stored(path)


# ------------------------------------------------------------------------------------- through the shell


@pytest.fixture
def odd_folder(tmp_path: Path) -> Path:
    """A working folder with the workflow whose name a shell would take apart."""
    folder = tmp_path / "a b'c$d"
    folder.mkdir()
    for name in ("Snakefile", "workflow", "config.yaml"):
        (folder / name).symlink_to(ROOT / name)
    return folder


def _run(folder: Path, program: str, *arguments: str, **variables: str) -> subprocess.CompletedProcess[str]:
    command = [str(BIN / program), *arguments]
    environment = {**os.environ, "NO_COLOR": "1", **variables}
    return subprocess.run(
        command, cwd=folder, capture_output=True, text=True, check=False, timeout=120, env=environment
    )


@pytest.fixture
def unlimited() -> None:
    """Children inherit the limit on memory, which numba's compiler and Snakemake would exceed."""
    resource.setrlimit(resource.RLIMIT_AS, (resource.RLIM_INFINITY, resource.getrlimit(resource.RLIMIT_AS)[1]))


def test_a_campaign_in_an_odd_folder(odd_folder: Path, unlimited: None) -> None:
    """A stage runs for real, with blanks, quotes and a dollar sign in the path of everything."""
    data, results = odd_folder / "da ta's $(touch x)", "re's ul\"ts$(touch x);y"
    data.mkdir()
    image = np.ones((120, 120))
    cards = {"BUNIT": "electron/s", "EXPTIME": 100.0, "BKGRMS": 0.1}
    fits.PrimaryHDU(image, fits.Header(cards)).writeto(data / 'sci "ence.fits')
    psf = np.zeros((5, 5))
    psf[2, 2] = 1.0
    fits.PrimaryHDU(psf).writeto(data / "psf.fits")
    band = {"science": '$DATA/sci "ence.fits', "psf": "$DATA/psf.fits", "pixel_scale_arcsec": 0.05}
    overlay = {
        "results": results,
        "observation": {
            "kind": "fits",
            "bands": ["F814W"],
            "fits": {"F814W": {**band, "center_pixel": [60.0, 60.0]}},
        },
    }
    (odd_folder / "my overlay's.yaml").write_text(yaml.safe_dump(overlay))
    artifact = f"{results}/observation.h5"
    done = _run(
        odd_folder, "snakemake", artifact, "--cores", "1", "--workflow-profile", "workflow/profiles/local",
        "--configfile", "my overlay's.yaml", DATA=str(data),
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    with open_artifact(odd_folder / artifact, "observation") as found:
        assert found.metadata["bands"] == ["F814W"]
    assert not list(odd_folder.rglob("x"))


def test_the_workflow_refuses_what_validate_refuses(odd_folder: Path, unlimited: None) -> None:
    """Snakemake's own reader takes the last of two keys."""
    (odd_folder / "overlay.yaml").write_text("campaign: {seed: 1}\ncampaign: {seed: 2}")
    done = _run(odd_folder, "snakemake", "--dry-run", "--cores", "1", "--configfile", "overlay.yaml")
    assert done.returncode != 0
    assert "the key 'campaign' is given twice" in done.stdout + done.stderr
