"""Checks the pages that were built: they load nothing from other hosts, and every link within the site leads somewhere.

Run as `python docs/_ext/built.py DIRECTORY`; exits with 1 and says what is wrong.
"""

from __future__ import annotations

import re
import sys
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit

_LOADING = {"script": "src", "img": "src", "iframe": "src", "video": "src", "source": "src", "link": "href"}
_STYLE = re.compile(r"""(?:url\(|@import)\s*["']?((?:https?:)?//[^"')\s]+)""")


class _Page(HTMLParser):
    """What a page loads, where it links to, and what can be linked to in it."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.loaded: list[str] = []
        self.links: list[str] = []
        self.anchors: set[str] = {""}
        text = path.read_text(encoding="utf-8")
        self.feed(text)
        self.loaded += _STYLE.findall(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        given = {name: value or "" for name, value in attrs}
        self.anchors |= {given[name] for name in ("id", "name") if name in given}
        if tag == "a" and "href" in given:
            self.links.append(given["href"])
        if address := given.get(_LOADING.get(tag, "")):
            self.loaded.append(address)


def problems(root: Path) -> list[str]:
    """A line for each thing that is wrong with the site in a directory."""
    pages = {path.resolve(): _Page(path) for path in sorted(root.rglob("*.html"))}
    found = [] if pages else [f"{root}: no page"]
    for path, page in pages.items():
        name = path.relative_to(root.resolve())
        found += [f"{name}: loads {url}" for url in page.loaded if urlsplit(url).netloc]
        for link in page.links:
            parts = urlsplit(link)
            if parts.scheme or parts.netloc:
                continue
            target = (path.parent / unquote(parts.path)).resolve() if parts.path else path
            if not target.exists():
                found.append(f"{name}: links to {link}, which is not there")
            elif target in pages and unquote(parts.fragment) not in pages[target].anchors:
                found.append(f"{name}: links to {link}, which has no such place")
    for path in sorted(root.rglob("*.css")):
        found += [
            f"{path.relative_to(root)}: loads {url}"
            for url in _STYLE.findall(path.read_text(encoding="utf-8"))
        ]
    return found


if __name__ == "__main__":
    lines = problems(Path(sys.argv[1]))
    print("\n".join(lines), end="\n" if lines else "", file=sys.stderr)
    sys.exit(bool(lines))
