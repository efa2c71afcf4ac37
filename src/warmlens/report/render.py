"""From values to one self-contained HTML file: templates, escaping, pictures as data URIs."""

from __future__ import annotations

import base64
import hashlib
import math
import re
import struct
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from warmlens import __version__, text
from warmlens.artifacts.atomic import ArtifactError, atomic_path

_SYMBOL = re.compile(
    r"(?<![\w.])(m|M|R|v|n|χ²|Σ|Δα)_(TH|h|sens|pert|smooth|sub|max|bound|red|x|y)(?![\w.=]*[\w=])"
)
_PIXELS_PER_INCH, _SHOWN_PER_INCH = 300, 130  # of the figures as they are saved, and on the page
_PLAIN = (0.01, 1000.0)  # numbers that are written without a power of ten
_PNG = b"\x89PNG\r\n\x1a\n"
_INLINE = ("page.css", "page.js")


@cache
def environment() -> Environment:
    """Return the templates of the package; every value is escaped, and a missing one is an error."""
    templates = Environment(
        loader=PackageLoader("warmlens.report"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    templates.filters |= {
        "number": lambda value, digits=2: signed(text.number(value, digits)),
        "plain": lambda value: signed(f"{value:.6g}"),
        "pair": lambda value, error, digits=2: typeset(signed(text.pair(value, error, digits))),
        "error_pair": lambda value, error: typeset(signed(text.error_pair(value, error))),
        "confidence": text.confidence,
        "percent": text.percent,
        "crossing": lambda fall: typeset(text.crossing(fall)),
        "summary_name": lambda name: typeset(text.summary_name(name)),
        "duration": text.duration,
        "headings": headings,
        "typeset": typeset,
        "scientific": scientific,
    }
    return templates


def typeset(message: str) -> Markup:
    """Escape a message of the terminal; set ± and the field's symbols with their subscripts."""
    escaped = str(Markup.escape(message.replace("+-", "±").replace("chi2_red", "χ²_red")))
    return Markup(_SYMBOL.sub(r"<var>\1</var><sub>\2</sub>", escaped))


def headings(html: str) -> list[tuple[str, Markup]]:
    """Return the identifier and the title of every section of a page."""
    return [(name, Markup(title)) for name, title in re.findall(r'<section id="(.*?)">\s*<h2>(.*?)</h2>', html)]


def signed(value: str) -> str:
    """Return a number with a minus sign instead of a hyphen."""
    return f"−{value[1:]}" if value.startswith("-") else value


def scientific(value: float, digits: int = 2) -> Markup:
    """Write a positive number with a power of ten, unless it is near 1; without digits omit a mantissa of 1."""
    if not value > 0.0 or math.isinf(value) or _PLAIN[0] <= value < _PLAIN[1]:
        return Markup.escape(f"{value:.{digits + 1}g}")
    mantissa, _, exponent = f"{value:.{digits}e}".partition("e")
    if not digits and mantissa == "1":
        return Markup("10<sup>{}</sup>").format(signed(str(int(exponent))))
    return Markup("{}&nbsp;×&nbsp;10<sup>{}</sup>").format(mantissa, signed(str(int(exponent))))


def picture(png: bytes, alt: str, what: str = "picture") -> dict[str, Any]:
    """Return what a template needs of a PNG: source, size on the page [CSS pixels] and description.

    Raises
    ------
    ArtifactError
        If it is not a PNG; `what` names it in the message.
    """
    if not png.startswith(_PNG) or len(png) < 24:
        raise ArtifactError(f"{what}: not a PNG picture; delete it and run the campaign again")
    scale = _SHOWN_PER_INCH / _PIXELS_PER_INCH
    width, height = (round(scale * side) for side in struct.unpack(">II", png[16:24]))
    source = f"data:image/png;base64,{base64.b64encode(png).decode()}"
    return {"source": source, "width": width, "height": height, "alt": alt}


def render(template: str, **values: Any) -> str:
    """Render a page with style and script in it; its content security policy lets it load and run nothing else."""
    style, script = (
        files("warmlens.report").joinpath("templates", name).read_text(encoding="utf-8") for name in _INLINE
    )
    return (
        environment()
        .get_template(template)
        .render(
            style=Markup(style),
            script=Markup(script),
            policy=f"default-src 'none'; img-src data:; style-src {_hash(style)}; script-src {_hash(script)}",
            package_version=__version__,
            **values,
        )
    )


def _hash(content: str) -> str:
    return f"'sha256-{base64.b64encode(hashlib.sha256(content.encode()).digest()).decode()}'"


def write_page(path: Path, html: str) -> None:
    """Write a page, whole or not at all."""
    with atomic_path(path, len(html)) as temporary:
        temporary.write_text(html, encoding="utf-8")
