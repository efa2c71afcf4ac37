from __future__ import annotations

import io
import math
import re
from pathlib import Path

import pytest
from rich.markup import escape
from rich.table import Table
from rich.text import Text

from warmlens import text
from warmlens.text import Terminal, visible

from .reliability import Outcome, fault


def test_numbers_and_pairs() -> None:
    assert text.number(1.2345) == "1.23"
    assert text.number(None) == text.number(math.nan) == "none"
    assert text.pair(1.2, 0.05) == "1.20 +- 0.05"
    assert text.pair(1.2, None) == "1.20"
    assert text.percent(0.0455, 2) == "4.55%"


@pytest.mark.parametrize(
    ("value", "error", "expected"),
    [
        (1.634217, 0.0141, "1.634 +- 0.014"),
        (-2.03704747, 3.009e-5, "-2.037047 +- 0.000030"),
        (13.4, 250.0, "13 +- 250"),
        (1.957, 0.0, "1.957"),
        (1.957, math.nan, "1.957"),
    ],
)
def test_decimals_follow_the_error(value: float, error: float, expected: str) -> None:
    assert text.error_pair(value, error) == expected


def test_confidence_is_one_sided() -> None:
    assert [text.confidence({"level": level}) for level in (0.05, 0.0455, 0.02275)] == ["95%", "95.45%", "97.725%"]


def test_crossing() -> None:
    assert text.crossing({"m_kev": None, "mc_error_kev": None}) == "not within the prior"
    assert text.crossing({"m_kev": 2.0, "mc_error_kev": 0.1}) == "2.00 +- 0.10 keV"
    assert text.crossing({"m_kev": 2.0, "mc_error_kev": None}) == "2.00 keV"


def test_notes_leave_out_what_the_headline_says() -> None:
    headline = {"warnings": ["few"]}
    warnings = ["few", "indistinguishable from the prior: 1 against 1", "cut off"]
    bound = {"value_kev": 1.2, "mc_error_kev": 0.05, "prior_only_kev": 1.0, "ess": 33.4, "warnings": warnings}
    cells = {"value": "1.20 +- 0.05", "prior": "1.00", "ess": "33", "notes": ["cut off"]}
    assert text.bound_cells(bound, headline) == cells
    none = {"value": "none", "prior": "", "ess": "", "notes": ["cut off"]}
    assert text.bound_cells({"value_kev": None, "warnings": warnings}, headline) == none


def test_names_in_words() -> None:
    assert text.prior_name("flat_13_13.5") == "log₁₀ M_h uniform from 13 to 13.5"
    assert text.prior_name("normal_13.36_0.14") == "log₁₀ M_h normal, 13.36 +- 0.14"
    assert text.prior_name("uniform_inverse_m") == "uniform in 1 / m_TH"
    assert text.prior_name("another") == "another"
    assert text.summary_name("positions_below_-10") == "positions with ΔR below −10"
    assert text.summary_name("another") == "another"


def test_units_of_the_smooth_model() -> None:
    arcsec = ("lens_0.theta_E", "light_1.R_sersic", "quasar_2.x", "source_0.beta", "lens_1.ra_0")
    assert {text.parameter_unit(name) for name in arcsec} == {"arcsec"}
    assert {text.parameter_unit(name) for name in ("lens_0.e1", "light_0.n_sersic", "lens_3.coeffs_2")} == {""}


def test_durations() -> None:
    assert [text.duration(seconds) for seconds in (0.4, 69.0, 3600.0, 36061.0)] == [
        "0 s",
        "1 min 09 s",
        "1 h 00 min",
        "10 h 01 min",
    ]


def test_all_that_is_printed_goes_through_the_terminal() -> None:
    sources = [path for path in Path(text.__file__).parent.rglob("*.py") if path.name != "text.py"]
    consoles = [path.name for path in sources if re.search(r"\bConsole\(", path.read_text(encoding="utf-8"))]
    assert consoles == ["progress.py"], "which prints nothing of a file"


HOSTILE = "\x1b[2J\x1b]0;title\x07gone\rover\x9b31m\u202eback [bold]y \udcff"
SHOWN = r"\x1b[2J\x1b]0;title\x07gone\rover\x9b31m\u202eback [bold]y \udcff"


@fault("Machine", "a foreign artifact has control codes of a terminal", "in texts that are printed", quick=True)
def test_control_codes_do_not_reach_the_terminal(outcome: Outcome) -> None:
    assert visible(HOSTILE) == SHOWN
    assert visible("a\tb\nµ ☉ ≥ +- χ²") == "a\tb\nµ ☉ ≥ +- χ²"
    for tty in (False, True):
        terminal = Terminal(file=io.StringIO(), force_terminal=tty, width=300, color_system=None)
        table = Table("title", min_width=200)
        table.add_row(Text(HOSTILE, no_wrap=True))
        terminal.print(HOSTILE, markup=False)
        terminal.print(f"[bold red]WARNING[/] {escape(HOSTILE)}")
        terminal.print(table)
        written = terminal.file.getvalue()
        assert written.count(SHOWN.replace(r"\x07", "").replace(r"\r", "")) == 3, "rich leaves these out"
        assert not {"\x07", "\r", "\x9b", "\u202e", "\udcff"} & set(written)
        assert "\x1b[2J" not in written and "\x1b]0" not in written
    outcome.goes_on("they are spelled out", "nothing")
