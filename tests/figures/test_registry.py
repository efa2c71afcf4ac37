"""What all figures have in common: names, captions, inputs, files."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import matplotlib as mpl
import matplotlib.pyplot as plt
import pandas as pd
import pytest
from matplotlib.figure import Figure
from typer.testing import CliRunner

from warmlens.artifacts.atomic import ArtifactError
from warmlens.artifacts.names import CONFIG, FIGURES
from warmlens.campaign.derived import NEEDED, figure_inputs
from warmlens.campaign.files import stage_files
from warmlens.cli.main import app
from warmlens.config.model import Config
from warmlens.figures import CAPTIONS, registry
from warmlens.figures.inputs import find_inputs
from warmlens.figures.recipe import Recipe

from ..reliability import Outcome, fault

OF_A_USER = {
    **{"text.usetex": True, "axes.facecolor": "red", "savefig.bbox": "tight", "savefig.facecolor": "blue"},
    **{"axes.spines.top": False, "legend.loc": "lower left", "image.aspect": "auto", "lines.marker": "o"},
    **{"font.size": 30.0, "figure.dpi": 30.0, "savefig.dpi": 40.0, "axes.grid": True, "path.sketch": (1, 9, 2)},
}
PAPER = {str(number) for number in range(1, 9)}


def test_every_figure_has_a_caption_a_recipe_and_its_inputs() -> None:
    assert set(CAPTIONS) == {*FIGURES, *PAPER}
    assert set(registry.FROM_ARTIFACTS) | set(registry.FROM_CONFIG) == {*FIGURES, *PAPER}
    assert set(NEEDED) == set(registry.FROM_ARTIFACTS) - {"6", "7"}
    assert all(text.endswith(".") and len(text) > 60 for text in CAPTIONS.values())


@pytest.mark.parametrize("name", [*FIGURES, *sorted(PAPER - {"1", "2", "8"})])
def test_every_figure_is_drawn_and_has_its_data(table_of: Callable[[str], pd.DataFrame], name: str) -> None:
    table = table_of(name)
    assert len(table) > 0
    assert not table.columns.str.contains("Unnamed").any()
    assert table.notna().any(axis=1).all()


def test_inputs_are_those_of_the_layout(campaign: Config) -> None:
    assert figure_inputs(campaign, "mocks") == {
        stage: stage_files(campaign, stage)[0] for stage in ("observation", "smooth_model", "mocks")
    }
    inputs = find_inputs("4", [Path(campaign.results)])
    assert inputs["summaries/1"] == stage_files(campaign, "summaries")[1]
    assert len(inputs) == 3


def test_a_missing_artifact_is_named_with_the_command_that_makes_it(campaign: Config, tmp_path: Path) -> None:
    shutil.copy(Path(campaign.results) / CONFIG, tmp_path)
    with pytest.raises(ArtifactError) as caught:
        registry.write_from_results("posterior", [tmp_path], tmp_path / "posterior.png")
    message = str(caught.value)
    assert message.startswith(f"{tmp_path}/abc.h5: no such artifact")
    # folders as the workflow calls them
    assert message.endswith(
        "make it with: snakemake --cores all --workflow-profile workflow/profiles/local "
        f"--configfile {campaign.results}/{CONFIG} -- {campaign.results}/abc.h5"
    )
    assert [path.name for path in tmp_path.iterdir()] == [CONFIG]


def test_what_cannot_be_drawn_is_refused(campaign: Config, tmp_path: Path) -> None:
    results = Path(campaign.results)
    with pytest.raises(ArtifactError, match=r"no figure 'posteriors'; the figures are smooth_model, .*, 8$"):
        registry.write_from_artifacts("posteriors", {}, tmp_path / "a.png")
    with pytest.raises(ArtifactError, match=r"needs the artifact 'abc'; give --artifact abc=PATH, or --results"):
        registry.write_from_artifacts("posterior", {"observation": results}, tmp_path / "a.png")
    with pytest.raises(ArtifactError, match="shows one campaign; give one --results, not 2"):
        registry.write_from_results("posterior", [results, results], tmp_path / "a.png")
    with pytest.raises(ValueError, match=r"a\.jpg must end in \.png, \.pdf or \.svg"):
        registry.write_from_results("posterior", [results], tmp_path / "a.jpg")
    assert not list(tmp_path.iterdir())


def test_the_command_line_takes_results_or_artifacts(campaign: Config, tmp_path: Path) -> None:
    abc = stage_files(campaign, "abc")[0]
    ways = (["convergence", "--results", campaign.results], ["convergence", "--artifact", f"abc={abc}"])
    for number, arguments in enumerate(ways):
        done = CliRunner().invoke(app, ["figure", *arguments, "--output", str(tmp_path / f"{number}.png")])
        assert done.exit_code == 0, done.output
    assert (tmp_path / "0.csv").read_text() == (tmp_path / "1.csv").read_text()


def _read(source: list[float]) -> pd.DataFrame:
    return pd.DataFrame({"a": source})


def test_a_figure_that_fails_leaves_nothing(tmp_path: Path) -> None:
    def fail(data: pd.DataFrame) -> Figure:
        raise ValueError("cannot")

    with pytest.raises(ValueError, match="cannot"):
        Recipe(_read, fail, pd.DataFrame).write([1.0], tmp_path / "a.png")
    assert not list(tmp_path.iterdir())


def _draw(data: pd.DataFrame) -> Figure:
    figure, axes = plt.subplots()
    axes.plot(data["a"], label="keV")
    axes.imshow([[0.0, 1.0], [2.0, 3.0]])
    axes.legend()
    return figure


@fault("Machine", "a matplotlibrc of the user", "fonts, colours, sizes, resolution, LaTeX", quick=True)
def test_a_matplotlibrc_changes_no_picture(tmp_path: Path, outcome: Outcome) -> None:
    Recipe(_read, _draw, pd.DataFrame).write([1.0, 2.0], tmp_path / "a.png")
    with mpl.rc_context():
        mpl.rcParams.update(OF_A_USER)
        Recipe(_read, _draw, pd.DataFrame).write([1.0, 2.0], tmp_path / "b.png")
        assert {key: mpl.rcParams[key] for key in OF_A_USER} == OF_A_USER, "given back"
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()
    outcome.goes_on("the same pictures, byte for byte", "nothing")


def test_picture_and_data_lie_beside_each_other(tmp_path: Path) -> None:
    Recipe(_read, lambda data: Figure(), pd.DataFrame).write([1.0, 1.0 / 3.0], tmp_path / "a.pdf")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.csv", "a.pdf"]
    assert (tmp_path / "a.pdf").read_bytes().startswith(b"%PDF")
    assert (tmp_path / "a.csv").read_text() == "a\n1\n0.333333\n"
