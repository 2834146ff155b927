"""What holds of every page, told by reading it as a browser would."""

import base64
import gzip
import re
from dataclasses import dataclass, field
from html.parser import HTMLParser

SPEAKS_OF_OUTSIDE = re.compile(
    r"""(?:src|href|action|data|poster)\s*=\s*["']?\s*(?:https?:)?//|url\(\s*["']?(?!#|data:)"""
)


@dataclass
class Seen(HTMLParser):
    """Elements of a page; `refuse` is what no page may hold."""

    ids: list[str] = field(default_factory=list)
    links: list[str] = field(default_factory=list)
    pictures: list[dict[str, str | None]] = field(default_factory=list)
    addresses: list[str] = field(default_factory=list)
    drawings: int = 0

    def __post_init__(self) -> None:
        super().__init__()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        reported = dict(attrs)
        self.ids += [reported["id"] or ""] if "id" in reported else []
        if tag == "div" and "still" in (reported.get("class") or "").split():
            self.pictures.append(reported)
        self.drawings += tag == "svg"
        for name in ("src", "href"):
            if name in reported:
                (self.links if tag == "a" else self.addresses).append(reported[name] or "")


def check_page(text: str, *, has_pictures: bool = True) -> Seen:
    """Hold a page against what is promised of every page, and return what it holds."""
    seen = Seen()
    seen.feed(text)
    assert len(set(seen.ids)) == len(seen.ids)
    assert all(link.startswith("#") and link[1:] in seen.ids for link in seen.links)
    assert all(address.startswith("data:") for address in seen.addresses)
    assert bool(seen.pictures) == has_pictures
    for picture in seen.pictures:
        assert picture["role"] == "img"
        assert len((picture["aria-label"] or "").split()) > 5, picture["aria-label"]
    assert seen.drawings >= len(seen.pictures)
    # A colour that the style sheet does not name would be black on dark paper; entries of a legend name their own.
    named = {*re.findall(r"(--[\w-]+):", text), *(() if has_pictures else ("--mark",))}
    assert set(re.findall(r"var\((--[\w-]+)\)", text)) <= named
    assert all(f'id="{name}"' in text for name in re.findall(r"url\(#([^)]*)\)", text))
    assert SPEAKS_OF_OUTSIDE.search(text) is None
    assert len(text.encode()) < 3e6
    return seen


def unpacked(text: str, key: str) -> str:
    """Return what a page carries packed under an id."""
    (packed,) = re.findall(rf'<script type="text/plain" id="{key}">([^<]*)</script>', text)
    return gzip.decompress(base64.b64decode(packed)).decode()
