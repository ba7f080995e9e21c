"""Helpers of pages with forms: after an error, a page is shown again with the message."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Mapping
from typing import Any

from fastapi import Request, Response
from fastapi.responses import RedirectResponse

from tupli_mcap.errors import TupliError
from tupli_mcap.page.answers import page
from tupli_mcap.server.pages.session import Visit, shelf_of
from tupli_mcap.server.wire import told


def form_page(
    request: Request,
    visit: Visit,
    template: str,
    facts: Mapping[str, Any],
    *,
    wrong: str = "",
    status: int = 200,
    sent: Mapping[str, str] | None = None,
    **more: Any,
) -> Response:
    """A page with forms for a signed-in user. wrong: why the last form was refused. sent: what was in it."""
    shown: dict[str, Any] = {
        "shelf": shelf_of(request, visit),
        "code": visit.code,
        "wrong": wrong,
        "sent": defaultdict(str, sent or {}),
        "me": visit.caller,
    }
    response = page(request, template, facts, status=status, **shown, **more)
    response.headers["Cache-Control"] = "no-store"
    return response


def tried(change: Callable[[], None], again: Callable[[str, int], Response], address: str) -> Response:
    """Makes a change, and redirects to an address; if the change is refused, shows the page `again`."""
    try:
        change()
    except TupliError as err:
        status, text = told(err)
        return again(text, status)
    return done(address)


def done(address: str) -> Response:
    """Redirects to another page, which the browser fetches with GET."""
    return RedirectResponse(address, 303)
