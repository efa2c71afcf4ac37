"""The report of a campaign and the page of a sample, as files and in a browser."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from warmlens.artifacts.file import open_artifact
from warmlens.artifacts.names import FIGURES
from warmlens.report import campaign_page
from warmlens.report.campaign_page import report_html, write_report
from warmlens.report.collect import read_report
from warmlens.report.provenance import read_provenance
from warmlens.report.sample import read_sample

from .browser import chromium, opened, problems
from .conftest import Project
from .damage import with_other_content

HOSTILE = '"><img src=x onerror="document.title=1"><script>document.title=1</script>'


@pytest.fixture(scope="session")
def browser() -> Iterator[Any]:
    """A headless Chromium."""
    with chromium() as found:
        yield found


@pytest.fixture(scope="session")
def report(finished: Project) -> Path:
    """Report that the campaign itself wrote."""
    return finished.results / "report.html"


@pytest.fixture(scope="session")
def sample(finished: Project, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Page of a sample."""
    output = tmp_path_factory.mktemp("sample") / "sample.html"
    done = finished.warmlens("show", "results/tiny", "3", "--output", str(output))
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip() == str(output)
    return output


def test_report_says_what_the_numbers_say(finished: Project, report: Path) -> None:
    html = report.read_text()
    numbers = json.loads((finished.results / "abc.json").read_text())
    bound = numbers["bounds"][numbers["headline"]]
    assert f"{bound['value_kev']:.2f} ± {bound['mc_error_kev']:.2f}" in html
    assert numbers["verdict"] == "not usable", "4 accepted samples"
    verdict = "Not usable: this bound may be wrong, do not quote it."
    assert html.index(verdict) < html.index('class="headline"'), "the verdict comes first"
    assert html.count("<figure id=") == len(FIGURES)
    assert "is not there" not in html, "every figure is drawn"
    assert "The chain is whole" in html
    assert html.count("<code>warmlens show results/tiny") == numbers["n_accepted"]
    assert report.stat().st_size < 15e6


def test_provenance_lists_every_artifact(finished: Project) -> None:
    campaign = read_report(finished.results)
    provenance = read_provenance(finished.results, campaign["config"])
    digests = {name: header.digest for name, header in provenance.artifacts.items()}
    assert digests == finished.digests()
    assert not provenance.missing
    assert all(cost["peak_mib"] is not None for cost in provenance.costs)
    html = report_html(campaign, provenance)
    assert all(f'title="{digest}"' in html for digest in digests.values())


def test_broken_chain_missing_files_and_figures_are_shown(copy_of: Callable[[], Project]) -> None:
    project = copy_of()
    (project.results / "figures/psf.png").unlink()
    with_other_content(project.results / "summaries/chunk-0000000-0000007.h5")
    html = write_report(project.results).read_text()
    assert "The chain is broken</span>: abc.h5: its input summaries/" in html
    assert "figures/psf.png is not there. Make it with <code>snakemake " in html
    shown = project.warmlens("show", "results/tiny", "3")
    assert shown.returncode == 1
    assert "has changed since; `warmlens resume results/tiny` makes it again" in shown.stderr
    (project.results / "mocks/chunk-0000000-0000007.h5").unlink()
    assert (
        "1 artifacts of the campaign are no longer there: mocks/chunk-"
        in write_report(project.results).read_text()
    )
    (project.results / "abc.h5").unlink()
    told = project.warmlens("report", "results/tiny")
    assert told.returncode == 1
    assert "results/tiny/abc.h5: no such artifact; make it with: snakemake --cores all" in told.stderr


def test_the_command_of_the_report_makes_the_same_campaign(copy_of: Callable[[], Project]) -> None:
    """Snakemake finds nothing to do: the recorded configuration is the whole of it."""
    project = copy_of()
    (project.folder / "overlay-0.yaml").write_text((project.results / "config.json").read_text())
    assert project.planned() == {}


def test_sample_holds_what_the_artifacts_hold(finished: Project) -> None:
    record = read_sample(finished.results, 10)  # row 3 of the second chunk
    with open_artifact(finished.results / "mocks/chunk-0000007-0000014.h5", "mocks") as artifact:
        assert (record.mocks["F814W"] == artifact["F814W/image"][3]).all()
    with open_artifact(finished.results / "abc.h5", "abc") as artifact:
        assert record.m_th_kev == artifact["table/m_th_kev"][10]
        assert record.verdict["accepted"] == artifact["table/accepted"][10]
        distances = artifact.array("table/distance_correlation")
    assert record.verdict["ranks"]["correlation"] == 1 + (distances < distances[10]).sum()
    assert [stage["status"] for stage in record.stages] == ["done"] * 5
    assert record.stages[2]["seed_keys"] == ("1131/mocks/10/F814W", "1131/mocks/10/F555W")


def test_sample_out_of_range(finished: Project) -> None:
    shown = finished.warmlens("show", "results/tiny", "14")
    assert shown.returncode == 1
    assert "has no sample 14; its samples are 0 to 13" in shown.stderr


class TestInABrowser:
    """What a reader sees."""

    def test_nothing_is_wrong_with_the_report(self, browser: Any, report: Path) -> None:
        assert problems(browser, report) == []

    def test_nothing_is_wrong_with_the_page_of_a_sample(self, browser: Any, sample: Path) -> None:
        assert problems(browser, sample) == []

    def test_a_poor_page_is_found_out(self, browser: Any, tmp_path: Path) -> None:
        page = tmp_path / "poor.html"
        page.write_text(
            '<html><body><main><a href="#nowhere">x</a><p id="a"></p><p id="a"></p><img src="gone.png" alt="gone">'
            '<div style="width: 1500px">wide</div></main><script>console.log(1); undefined.x</script></body>'
        )
        found = problems(browser, page)
        for wrong in (
            "console log",
            "error:",
            "request:",
            "overflow",
            "wide",
            "dead #nowhere",
            "blank gone",
            "twins a",
        ):
            assert sum(wrong in text for text in found) >= 2, (wrong, found)

    def test_table_is_sorted_by_a_click_and_by_the_keyboard(self, browser: Any, report: Path) -> None:
        with opened(browser, report) as (page, heard):
            table = page.locator("#accepted-table")
            head = table.locator("th[aria-sort]").nth(1)
            before = _column(table, 1)
            head.locator("button").click()
            assert _column(table, 1) == sorted(before) != before
            assert head.get_attribute("aria-sort") == "ascending"
            page.keyboard.press("Enter")  # the heading has the focus
            assert _column(table, 1) == sorted(before, reverse=True)
            assert head.get_attribute("aria-sort") == "descending"
            table.locator("th[aria-sort]").nth(0).locator("button").click()
            assert head.get_attribute("aria-sort") == "none"
            assert _column(table, 0) == sorted(_column(table, 0))
            assert heard == []

    def test_table_is_filtered(self, browser: Any, report: Path) -> None:
        with opened(browser, report) as (page, heard):
            table = page.locator("#accepted-table")
            values = sorted(_column(table, 1))
            page.get_by_label("m_TH at least [keV]").fill(f"{values[1]}")
            page.get_by_label("m_TH at most [keV]").fill(f"{values[-2]}")
            shown = [float(row.locator("td").nth(1).get_attribute("data-value")) for row in _visible(table)]
            assert sorted(shown) == values[1:-1]
            assert (
                page.locator("form.filter output").inner_text() == f"{len(shown)} of {len(values)} samples shown"
            )
            page.get_by_label("m_TH at least [keV]").fill("")
            page.get_by_label("m_TH at most [keV]").fill("")
            assert len(_visible(table)) == len(values)
            assert heard == []

    def test_figure_is_enlarged_and_closed(self, browser: Any, report: Path) -> None:
        with opened(browser, report) as (page, heard):
            page.locator("button.zoom").first.click()
            dialog = page.locator("dialog[open]")
            assert dialog.locator("img").bounding_box()["width"] > 1000
            page.keyboard.press("Escape")
            assert dialog.count() == 0
            assert heard == []

    def test_hostile_text_stays_text(
        self, browser: Any, finished: Project, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr(campaign_page, "CAPTIONS", dict.fromkeys(FIGURES, HOSTILE))
        campaign = read_report(finished.results)
        campaign["meta"] |= {"warnings": [HOSTILE], "acceptance": HOSTILE}
        sample = {"sample_id": 0, "m_th_kev": 1.0, "log10_m_halo_msun": 13.0}
        campaign["failed"] = [{**sample, "stage": HOSTILE, "message": HOSTILE}]
        campaign["reproduction"] |= {"config_yaml": HOSTILE, "command": HOSTILE}
        page = tmp_path / "hostile.html"
        page.write_text(report_html(campaign, read_provenance(finished.results, campaign["config"])))
        assert problems(browser, page) == []
        with opened(browser, page) as (shown, _):
            assert shown.title() != "1"
            assert shown.locator("ul.warnings li").first.inner_text() == HOSTILE


def _column(table: Any, place: int) -> list[float]:
    cells = table.locator(f"tbody tr td:nth-child({place + 1})")
    return [float(cells.nth(i).get_attribute("data-value")) for i in range(cells.count())]


def _visible(table: Any) -> list[Any]:
    return [row for row in table.locator("tbody tr").all() if row.is_visible()]
