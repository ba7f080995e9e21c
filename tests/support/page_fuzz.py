"""Gets a server's pages and sends their forms with texts of all kinds, as a browser of a signed-in user."""

from __future__ import annotations

import inspect
import random
import re
from collections.abc import Iterator, Mapping, Sequence
from typing import Any
from urllib.parse import quote

import httpx
from fastapi.routing import APIRoute

from tupli_mcap.page.routes import PAGES as OF_ALL
from tupli_mcap.server.pages import PAGES as OF_SERVERS

__all__ = ["MARK", "Browser", "page_routes", "wrong"]

MARK = "\"'><img src=fuzz onerror=alert(1)>{{7*7}}"
"""A text that may be on no page as it is."""
FULL = 507  # "you keep as much as you may"
_CODE = re.compile(r'name="code" value="([0-9a-f]{64})"')
_NAMED_OTHERWISE = {"number": "page", "following": "next", "uris": "uri", "show": "view"}
_NO_FIELDS = {"request", "visit", "shelf"}
_TEXTS: Sequence[str] = (
    MARK, "", " ", "0", "-1", "1e400", "99999999999999999999", "true", "null", "\x00", "a\r\nSet-Cookie: x=y",
    "\ud800", "\u202e", "../../etc/passwd", "%", "%00", "a" * 5000, "(" * 40, "steps >= 0", "steps >",
    'metadata.a == "', "-return", "metadata.score", "global", "admin", "$$GUEST$$", "//evil.example", "{}", "[1]",
)  # fmt: skip


def page_routes() -> list[APIRoute]:
    """The routes of all pages."""
    return [
        route for router in (*OF_ALL, *OF_SERVERS) for route in router.routes if isinstance(route, APIRoute)
    ]


class Browser:
    """A browser, of a signed-in user or of a guest."""

    def __init__(self, url: str, name: str = "") -> None:
        self.client = httpx.Client(base_url=url, headers={"Accept": "text/html"}, timeout=120)
        self.code = ""
        if name:
            self.client.post("/sign-in", data={"username": name, "password": f"{name}'s password"})
            found = _CODE.search(self.client.get("/account").text)
            self.code = found[1] if found else ""

    def __enter__(self) -> Browser:
        return self

    def __exit__(self, *_: object) -> None:
        self.client.close()

    def ask(self, route: APIRoute, names: Mapping[str, Sequence[Any]], rng: random.Random) -> httpx.Response:
        """The answer of a route to random values of its fields."""

        def drawn(name: str) -> str:
            known = [
                str(each) for key in (name, _NAMED_OTHERWISE.get(name)) for each in names.get(key or "", ())
            ]
            return rng.choice(known if known and rng.random() < 0.6 else _TEXTS)

        fields = [name for name in inspect.signature(route.endpoint).parameters if name not in _NO_FIELDS]
        path = re.sub(r"{(\w+)(:path)?}", lambda found: _quoted(drawn(found[1])), route.path)
        told = {
            _NAMED_OTHERWISE.get(name, name): drawn(name).encode("utf-8", "surrogatepass")
            for name in fields
            if f"{{{name}" not in route.path and rng.random() < 0.9
        }
        if route.methods == {"POST"}:
            code = {"code": self.code.encode()} if rng.random() < 0.95 else {}
            body = "&".join(f"{name}={quote(value)}" for name, value in {**told, **code}.items())
            form = {"Content-Type": "application/x-www-form-urlencoded"}
            return self.client.post(path, content=body, headers=form)
        query = "&".join(f"{name}={quote(value)}" for name, value in told.items())
        wanted = {"Accept": "application/json"} if rng.random() < 0.1 else {}
        return self.client.get(f"{path}?{query}", headers=wanted)


def _quoted(text: str) -> str:
    return quote(text.encode("utf-8", "surrogatepass"), safe="") or "%20"


def wrong(answer: httpx.Response) -> Iterator[str]:
    """What is wrong with an answer of a page."""
    if answer.status_code >= 500 and answer.status_code != FULL:
        yield f"{answer.status_code}"
    if "html" in answer.headers.get("content-type", ""):
        if "<img src=fuzz" in answer.text:
            yield "a text is on the page as it is"
        if "Content-Security-Policy" not in answer.headers:
            yield "no Content-Security-Policy"
    if "x" in answer.cookies or "evil.example" in answer.headers.get("location", "").partition("?")[0]:
        yield "a text got into the headers"
