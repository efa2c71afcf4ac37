from __future__ import annotations

import os
from pathlib import Path

import pytest
import yaml
from rich.console import Console

from warmlens.config.file import ConfigError, load_config
from warmlens.stage_table import stage_digests
from warmlens.systematics.run import last_words, read_systematics, run, write_overlays
from warmlens.systematics.table import FAILED, Row, draw_table, print_table, write_table

ROOT = Path(__file__).parents[2]
SHIPPED = ROOT / "workflow/configs/systematics.yaml"
CHANGED_FIRST = {
    "lens": ("smooth_model", "scan_design"),
    "source": ("smooth_model",),
    "source and lens": ("smooth_model",),
    "psf": ("smooth_model",),
    "mask": ("smooth_model",),
    "halos": ("halos",),
    "filter": ("deflections",),
}


@pytest.mark.parametrize("shipped", [SHIPPED, ROOT / "workflow/configs/systematics_hst.yaml"])
def test_every_shipped_variant_is_valid_and_changes_what_its_group_says(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, shipped: Path
) -> None:
    monkeypatch.chdir(ROOT)
    monkeypatch.setenv("WARMLENS_HST_DATA", str(tmp_path))
    block = read_systematics(shipped)
    layers = [Path("config.yaml"), *(Path(name) for name in block.base)]
    base = load_config(layers)
    overlays = write_overlays(block.model_copy(update={"results": str(tmp_path)}), base)
    seen = set()
    for name, overlay in overlays.items():
        variant = load_config([*layers, overlay])
        assert variant.results == str(tmp_path / name)
        assert variant.observation.artifact == f"{base.results}/observation.h5"
        before, after = stage_digests(base), stage_digests(variant)
        changed = [stage for stage in after if before[stage] != after[stage] and stage != "observation"]
        assert changed[0] in CHANGED_FIRST[block.variants[name].group]
        assert tuple(after.items()) not in seen, f"{name} is the same as another variant"
        seen.add(tuple(after.items()))


def test_the_shipped_variants_hold_those_of_the_paper() -> None:
    paper = {"shapelets_0", "shapelets_10", "source_global", "source_nested", "halos_paper", "filter_starlet"}
    assert paper <= set(read_systematics(SHIPPED).variants)


@pytest.mark.parametrize(
    ("variants", "problems"),
    [
        (
            {
                "a": {"group": "x", "description": "", "overlay": {"halos": {"preset": "best"}}},
                "b": {"group": "x", "description": "", "overlay": {"halos": {"presett": "paper"}}},
            },
            ["variant a: halos.preset: ", "variant b: halos.presett: unknown key"],
        ),
        ({"a": {"group": "x", "overlay": {}}}, [": variants.a.description: Field required"]),
        ({"a b": {"group": "x", "description": "", "overlay": {}}}, [": variants.a b."]),
    ],
)
def test_every_problem_is_reported_before_anything_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, variants: dict[str, object], problems: list[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "config.yaml").symlink_to(ROOT / "config.yaml")
    path = tmp_path / "systematics.yaml"
    path.write_text(yaml.safe_dump({"base": [], "results": "results/s", "variants": variants}))
    with pytest.raises(ConfigError) as error:
        run(path, 1)
    assert len(error.value.problems) == len(problems)
    for line, start in zip(error.value.problems, problems, strict=True):
        assert start in line
    with pytest.raises(ConfigError, match="no such file"):
        run(tmp_path / "absent.yaml", 1)


def test_a_failed_run_is_reported_with_the_message_of_its_stage(tmp_path: Path) -> None:
    log = tmp_path / "log"
    log.write_text(
        "\x1b[31mError in rule smooth_model\nLogfile:\n=====\n22:01 INFO evaluation 3\n"
        "warmlens: chi2_red = 1.34 in F814W is above the gate\n=====\nExiting because a job failed\x1b[0m\n"
    )
    assert last_words(log) == "chi2_red = 1.34 in F814W is above the gate"
    log.write_text("Building DAG\nLockException: the folder is locked\n")
    assert last_words(log).startswith("LockException: the folder is locked (see ")


def test_table_and_figure_show_every_row(tmp_path: Path) -> None:
    numbers = {"bound_kev": 2.0, "mc_error_kev": 0.2, "prior_only_kev": 1.18, "n_accepted": 50, "n_samples": 250}
    scan = {"n_below": 120, "c0": 3.5, "min_delta_r": -17.0, "chi2_red": {"F814W": 1.01}, "mean_z2": 1.3}
    rows = [
        Row("base", "base", "", **numbers, **scan, null_n_below=100.0, null_mean_z2=1.0),
        Row("gated", "lens", "", FAILED, "chi2_red = 1.34 [F814W] above the gate"),
        Row("scan_only", "lens", "", **{**scan, "n_below": 300}),
        Row("other", "halos", "", shift_kev=-0.5, **{**numbers, "bound_kev": 1.5}),
    ]
    write_table(tmp_path, rows)
    text = (tmp_path / "systematics.csv").read_text().splitlines()
    assert [line.split(",")[0] for line in text] == ["name", "base", "gated", "scan_only", "other"]
    assert "chi2_red_F814W" in text[0]
    draw_table(tmp_path, rows)
    assert (tmp_path / "systematics.png").stat().st_size > 10_000
    with (tmp_path / "shown").open("w") as handle:
        print_table(rows, Console(file=handle, width=200))
    shown = (tmp_path / "shown").read_text()
    assert "gated failed: chi2_red = 1.34 [F814W] above the gate" in shown
    assert "1.50 +- 0.20" in shown
    assert "120 (100)" in shown
    assert "1.30 (1.00)" in shown
    assert os.linesep.join(shown.splitlines()).count("failed") == 2
