"""One page that opens from disk, without a network: viser's own player with a title, a legend, figures and a
residual plot over it."""

from __future__ import annotations

import re
from collections.abc import Sequence
from html import escape
from html.parser import HTMLParser
from importlib.resources import files

from fastrod.errors import InputError

_LOADS = (
    "src",
    "srcset",
    "href",
    "xlink:href",
    "poster",
    "data",
    "action",
    "formaction",
    "background",
    "manifest",
)
_OUTWARD = re.compile(r"^\s*(https?:)?//", re.IGNORECASE)
_URL = re.compile(
    r"""url\(\s*['"]?\s*((?:https?:)?//[^'")\s]*)|@import\s+['"]\s*((?:https?:)?//[^'"]*)""", re.IGNORECASE
)

_CSS = (files("fastrod_viewer") / "export.css").read_text(encoding="utf-8")
_FOLD = "document.querySelectorAll('.fr-over details').forEach(d=>{if(innerWidth<=700)d.open=false})"
"""On a phone the robot has the screen, and figures and plot wait behind their headings."""
_ABOVE_PLAYER = "52px"
"""Room for viser's own play button and slider, which lie along the bottom of a page with more than one
moment."""


def wrap(
    viser_html: str,
    *,
    title: str,
    subtitle: str = "",
    legend_html: str = "",
    plot_svg: str | None = None,
    facts: Sequence[tuple[str, str]] = (),
    note: str = "",
) -> str:
    """Return `viser_html`, from a viser serializer's `as_html`, with our own words over it; the middle stays
    free for the mouse that rotates the view. `legend_html` (see `legend`) and `plot_svg` are put in as they
    are, all else as text.

    Raises `InputError` where `viser_html` is no whole page, or where what is added would load something from
    elsewhere.
    """
    head, body = viser_html.find("</head>"), viser_html.rfind("</body>")
    if not 0 <= head < body:
        raise InputError(
            "viser_html is not a page: it has no </head> followed by </body>; give what a "
            "viser serializer's as_html returns."
        )
    panel = _panel(title, subtitle, legend_html, facts, note) + _plot(plot_svg)
    style = f"<style>{_CSS.replace('BOTTOM', _ABOVE_PLAYER)}</style>"
    added = f'<div class="fr-over">{panel}</div><script>{_FOLD}</script>'
    if outward := external_references(style + added):
        raise InputError(
            f"the exported page would load {outward[0]!r}; a page that opens offline refers to "
            "nothing outside of itself."
        )
    named = re.sub(
        r"<title>.*?</title>",
        lambda _: f"<title>{escape(title)}</title>",
        viser_html[:head],
        count=1,
        flags=re.DOTALL,
    )
    return named + style + viser_html[head:body] + added + viser_html[body:]


def legend(entries: Sequence[tuple[str, str]]) -> str:
    """The legend of (CSS colour, label) pairs, for `wrap`."""
    return "".join(
        f'<span><i style="--c: {escape(colour)}"></i>{escape(label)}</span>' for colour, label in entries
    )


def external_references(html: str) -> list[str]:
    """Addresses beyond the page that its elements, attributes and styles point to, scripts left out; empty
    for a page that is whole."""
    reader = _References()
    reader.feed(html)
    reader.close()
    return reader.found


def _panel(title: str, subtitle: str, legend_html: str, facts: Sequence[tuple[str, str]], note: str) -> str:
    rows = "".join(f"<tr><th>{escape(name)}</th><td>{escape(value)}</td></tr>" for name, value in facts)
    table = f'<table class="fr-facts">{rows}</table>' if rows else ""
    small = f'<p class="fr-note">{escape(note)}</p>' if note else ""
    more = (
        f'<details class="fr-more" open><summary>Figures</summary>{table}{small}</details>'
        if table
        else small
    )
    return (
        f'<div class="fr-card fr-top"><h1>{escape(title)}</h1>'
        + (f"<p>{escape(subtitle)}</p>" if subtitle else "")
        + (f'<div class="fr-legend">{legend_html}</div>' if legend_html else "")
        + f"{more}</div>"
    )


def _plot(plot_svg: str | None) -> str:
    if plot_svg is None:
        return ""
    return (
        '<details class="fr-card fr-plot" open><summary>Tip error over time</summary><div '
        f'class="fr-scroll">{plot_svg}</div></details>'
    )


class _References(HTMLParser):
    """Collects what an element would load, or lead to, from elsewhere."""

    def __init__(self) -> None:
        super().__init__(convert_charrefs=True)
        self.found: list[str] = []
        self._style = False

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self._style = tag == "style"
        for name, value in attrs:
            if value is None:
                continue
            if name in _LOADS:
                sources = value.split(",") if name == "srcset" else [value]
                self.found += [source.strip().split()[0] for source in sources if _OUTWARD.match(source)]
            elif name == "style" or "url(" in value:
                self.found += _in_css(value)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.handle_starttag(tag, attrs)
        self._style = False

    def handle_endtag(self, tag: str) -> None:
        if tag == "style":
            self._style = False

    def handle_data(self, data: str) -> None:
        if self._style:
            self.found += _in_css(data)


def _in_css(text: str) -> list[str]:
    return [one or other for one, other in _URL.findall(text)]
