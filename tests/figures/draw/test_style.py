from __future__ import annotations

import matplotlib as mpl

from warmlens.figures.draw.style import house_style


def test_style_holds_inside_and_is_undone_outside():
    mpl.rcParams["font.family"] = ["monospace"]
    with house_style():
        assert mpl.rcParams["figure.constrained_layout.use"]
        assert mpl.rcParams["font.family"] == ["serif"]
        assert mpl.rcParams["image.origin"] == "lower"
    assert mpl.rcParams["font.family"] == ["monospace"]
    mpl.rcParams["font.family"] = mpl.rcParamsDefault["font.family"]


def test_the_font_of_the_style_is_one_that_matplotlib_brings(recwarn):
    with house_style():
        font = mpl.font_manager.findfont(mpl.font_manager.FontProperties(family="serif"))
    assert "STIX" in font
    assert not recwarn.list
