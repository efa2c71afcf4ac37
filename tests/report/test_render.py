from __future__ import annotations

import struct

import jinja2
import pytest

from warmlens.artifacts.atomic import ArtifactError
from warmlens.report.render import environment, headings, picture, render, scientific, typeset

HOSTILE = "<script>alert(1)</script>"


def test_every_value_is_escaped() -> None:
    shown = environment().from_string("{{ value }}|{{ value | typeset }}|{{ value | summary_name }}")
    assert "<script>" not in shown.render(value=HOSTILE)
    assert shown.render(value=HOSTILE).count("&lt;script&gt;") == 3


def test_a_value_that_is_not_there_is_an_error() -> None:
    with pytest.raises(jinja2.UndefinedError):
        environment().from_string("{{ meta.bounds }}").render(meta={})


def test_symbols_get_their_signs_and_names_of_keys_stay() -> None:
    assert typeset("m_TH > 1 +- 2") == "<var>m</var><sub>TH</sub> &gt; 1 ± 2"
    assert "<var>R</var><sub>sens</sub>" in typeset("ΔR and R_sens.")
    for plain in ("smooth_model.source.n_max: 50", "dark_matter.m_th_kev", "n_max=3", "log10_m_halo_msun"):
        assert "<sub>" not in typeset(plain)


@pytest.mark.parametrize(
    ("value", "digits", "expected"),
    [
        (2.4321e13, 2, "2.43&nbsp;×&nbsp;10<sup>13</sup>"),
        (1.19e-4, 2, "1.19&nbsp;×&nbsp;10<sup>−4</sup>"),
        (1e8, 0, "10<sup>8</sup>"),
        (4.168, 2, "4.17"),
        (0.0, 2, "0"),
    ],
)
def test_powers_of_ten(value: float, digits: int, expected: str) -> None:
    assert scientific(value, digits) == expected


def test_a_picture_is_a_data_uri_of_its_size() -> None:
    png = b"\x89PNG\r\n\x1a\n" + struct.pack(">I4sII", 13, b"IHDR", 2160, 960) + b"rest"
    shown = picture(png, "what it shows")
    assert shown["source"].startswith("data:image/png;base64,iVBORw0KGgo")
    assert (shown["width"], shown["height"]) == (936, 416)
    with pytest.raises(ArtifactError, match=r"figures/x.png: not a PNG picture"):
        picture(b"GIF89a", "", "figures/x.png")


def test_contents_are_the_headings_of_the_sections() -> None:
    page = '<section id="a"><h2>A &amp; B</h2>\n<h3>no</h3></section><section id="b-c">\n<h2>C</h2></section>'
    assert headings(page) == [("a", "A &amp; B"), ("b-c", "C")]


def test_the_policy_allows_the_page_its_own_script_alone() -> None:
    html = render("base.html.j2")
    policy = html.partition('Content-Security-Policy" content="')[2].partition('"')[0]
    assert "default-src &#39;none&#39;" in policy
    assert "unsafe-inline" not in policy
    assert policy.count("sha256-") == 2
