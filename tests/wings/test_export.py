"""The exported page: whole, offline, and with our words in it."""

import socket

import pytest

from fastrod.errors import InputError
from fastrod_viewer.export import external_references, legend, wrap

PAGE = (
    "<!doctype html><html><head><title>Viser</title><script>const "
    "a='https://example.org/x.js'</script></head><body><p>3D</p></body></html>"
)
PLOT = '<svg viewBox="0 0 9 9"><defs><path id="residual-a"/></defs><use href="#residual-a"/></svg>'


def test_words_stand_in_the_page_as_text() -> None:
    given = {"subtitle": "run & model", "facts": [("rms", "0.5 mm"), ("<b>", "x")], "note": '"noted"'}
    given |= {"legend_html": legend([("#c00", "tip <measured>")]), "plot_svg": PLOT}
    page = wrap(PAGE, title="a < b", **given)
    assert "<title>a &lt; b</title>" in page
    for words in ("run &amp; model", "tip &lt;measured&gt;", "--c: #c00", "0.5 mm", "&lt;b&gt;", PLOT):
        assert words in page
    assert "&quot;noted&quot;" in page
    parts = ["<style>", "</head>", "<p>3D</p>", 'class="fr-over"', "</body>"]
    assert sorted(parts, key=page.index) == parts
    assert external_references(page) == []
    assert "pointer-events: none" in page


def test_what_is_not_given_takes_no_room() -> None:
    page = wrap(PAGE, title="bare")
    body = page[page.index("</head>") :]
    assert "<details" not in body
    assert "<table" not in body
    assert "fr-legend" not in body


def test_a_title_may_look_like_a_pattern() -> None:
    assert r"<title>C:\1 \g&lt;0&gt;</title>" in wrap(PAGE, title=r"C:\1 \g<0>")


@pytest.mark.parametrize(
    ("html", "address"),
    [
        ('<script src="https://a.org/x.js"></script>', "https://a.org/x.js"),
        ('<link rel="stylesheet" href="//a.org/x.css">', "//a.org/x.css"),
        ("<style>body { background: url('http://a.org/x.png') }</style>", "http://a.org/x.png"),
        ("<style>@import 'https://a.org/x.css';</style>", "https://a.org/x.css"),
        ('<p style="background: url(//a.org/x.png)">', "//a.org/x.png"),
        ('<svg><image xlink:href="HTTPS://a.org/x.png"/></svg>', "HTTPS://a.org/x.png"),
        ('<img srcset="https://a.org/x.png 2x">', "https://a.org/x.png"),
        ('<rect fill="url(https://a.org/x.svg#g)"/>', "https://a.org/x.svg#g"),
    ],
)
def test_addresses_outside_of_the_page_are_found(html: str, address: str) -> None:
    assert external_references(html) == [address]


@pytest.mark.parametrize(
    "html",
    [
        "<script>fetch('https://a.org'); '<img src=\"https://a.org/x.png\">'</script>",
        "<svg xmlns='http://www.w3.org/2000/svg'><use href='#a'/><rect fill='url(#g)'/></svg>",
        "<link href=\"data:image/svg+xml,%3Csvg xmlns='http://www.w3.org/2000/svg'%3E\">",
        "<p>see https://a.org</p>",
        "<a href='other.html'>beside</a>",
    ],
)
def test_what_loads_nothing_is_no_reference(html: str) -> None:
    assert external_references(html) == []


def test_a_page_that_would_load_something_is_refused() -> None:
    with pytest.raises(InputError, match=r"would load 'https://a.org/x.png'"):
        wrap(PAGE, title="t", legend_html='<img src="https://a.org/x.png">')
    with pytest.raises(InputError, match="is not a page"):
        wrap("<p>no head</p>", title="t")


@pytest.fixture
def viser_page() -> str:
    viser = pytest.importorskip("viser", reason="viser is not installed: pip install 'fastrod[viewer]'")
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    server = viser.ViserServer(host="127.0.0.1", port=port, verbose=False)
    try:
        server.scene.add_icosphere("/tip", radius=0.01)
        serializer = server.get_scene_serializer()
        serializer.insert_sleep(0.1)
        page: str = serializer.as_html()
    finally:
        server.stop()
    return page


def test_visers_own_page_is_wrapped_and_stays_whole(viser_page: str) -> None:
    page = wrap(viser_page, title="demo", facts=[("rms", "0.5 mm")], plot_svg=PLOT)
    assert "<title>demo</title>" in page
    assert "<title>Viser</title>" not in page
    assert page.count("</body>") == 1
    assert external_references(page) == []
    own = viser_page[viser_page.index("<title>Viser</title>") : viser_page.index("</head>")]
    added = page.replace(own.removeprefix("<title>Viser</title>"), "")
    for scheme in ("http://", "https://"):
        assert scheme not in added[added.index("<style>") :]
