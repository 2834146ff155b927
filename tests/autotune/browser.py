"""What tests ask of a real browser: Debian's Chromium, without a window."""

import os
import shutil
from dataclasses import dataclass, field
from typing import Any

import pytest

# The share of a figure's pixels that are drawn on, which have another colour than most: what the engine draws lies on
# canvases inside of shadow roots.
PAINTED = """key => {
  const canvases = [];
  const walk = node => {
    if (node.tagName === 'CANVAS') canvases.push(node);
    for (const child of [...(node.shadowRoot ? node.shadowRoot.children : []), ...node.children]) walk(child);
  };
  walk(document.getElementById(key));
  let painted = 0, all = 0;
  for (const canvas of canvases.filter(each => each.width > 0 && each.height > 0)) {
    const pixels = new Uint32Array(canvas.getContext('2d').getImageData(0, 0, canvas.width, canvas.height).data.buffer);
    const counts = new Map();
    for (const pixel of pixels) counts.set(pixel, (counts.get(pixel) || 0) + 1);
    counts.delete(0);
    all += pixels.length;
    const opaque = [...counts.values()];
    painted += opaque.reduce((sum, count) => sum + count, 0) - Math.max(0, ...opaque);
  }
  return all ? painted / all : 0;
}"""


def chromium() -> str:
    """Where Chromium is; in CI it must be there."""
    found = shutil.which("chromium")
    if found is None:
        if os.environ.get("CI") == "true":
            pytest.fail("Chromium must be there in CI; install Debian's package chromium.")
        pytest.skip("needs Debian's chromium")
    return found


@dataclass
class Visit:
    """One opened page, and what it asked for and complained of."""

    browser: Any
    url: str
    width: int
    scheme: str
    requests: list[str] = field(default_factory=list)
    complaints: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.page = self.browser.new_page(viewport={"width": self.width, "height": 900}, color_scheme=self.scheme)
        self.page.on("request", lambda asked: self.requests.append(asked.url))
        self.page.on("pageerror", lambda error: self.complaints.append(str(error)))
        self.page.on(
            "console", lambda reported: self.complaints.extend([reported.text] if reported.type == "error" else [])
        )
        self.page.goto(self.url)

    def check(self) -> None:
        """Nothing overflows, nobody else was asked, nothing was complained of."""
        assert self.page.evaluate("document.documentElement.scrollWidth") <= self.width
        assert all(each.startswith((self.url, "data:", "blob:")) for each in self.requests), self.requests
        assert self.complaints == []
