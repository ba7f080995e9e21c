"""The server as an ASGI application."""

from __future__ import annotations

import asyncio
import contextlib
import functools
from collections.abc import AsyncIterator

from fastapi import FastAPI
from starlette.concurrency import run_in_threadpool
from starlette.middleware.gzip import GZipMiddleware

import tupli_mcap
from tupli_mcap.errors import TupliError
from tupli_mcap.page.directory import OpenedRecordings
from tupli_mcap.page.routes import PAGES
from tupli_mcap.server import pages
from tupli_mcap.server.library import Library
from tupli_mcap.server.pages.session import shown
from tupli_mcap.server.people.limits import Turns
from tupli_mcap.server.people.tokens import SignInError
from tupli_mcap.server.routes import accounts, episodes, items, operation, pytupli, query, recordings, viewers
from tupli_mcap.server.traffic.gate import Gate
from tupli_mcap.server.traffic.logs import LOG
from tupli_mcap.server.traffic.metrics import Metrics
from tupli_mcap.server.wire import tell_errors, told

# Recordings are compressed already. A page may hold text from a stranger's link beside private content: compressed, its
# size would reveal whether the two are alike (the BREACH attack).
_AS_THEY_ARE = ("application/octet-stream", "text/html", "font/*", "image/*", "video/*")


def create_app(library: Library) -> FastAPI:
    """The application that serves a library, cleans it up now and then, and closes it at its end."""

    @contextlib.asynccontextmanager
    async def lifespan(app: FastAPI) -> AsyncIterator[None]:
        upkeep = asyncio.create_task(_look_after(library))
        yield
        upkeep.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await upkeep
        library.close()

    app = FastAPI(
        title="tupli-mcap",
        version=tupli_mcap.__version__,
        description="Benchmarks, artifacts and recordings of reinforcement-learning episodes.",
        lifespan=lifespan,
        docs_url=None,  # its pages load scripts from foreign hosts
        redoc_url=None,
    )
    app.state.library = library
    app.state.metrics = Metrics()
    app.state.turns = Turns(library.settings.max_requests)
    app.add_middleware(GZipMiddleware, compresslevel=3, exclude_content_types=_AS_THEY_ARE)
    tell_errors(app)
    app.state.shown, app.state.kept, app.state.told = shown, OpenedRecordings(), told
    of_programs = (
        each.router for each in (operation, accounts, items, episodes, query, recordings, viewers, pytupli)
    )
    for router in (*of_programs, *pages.PAGES, *PAGES):
        app.router.routes += router.routes  # as they are: `include_router` would make each of them again
    known = functools.partial(_is_known, library)
    app.add_middleware(Gate, settings=library.settings, metrics=app.state.metrics, known=known)
    return app


def _is_known(library: Library, token: str) -> bool:
    with contextlib.suppress(SignInError), library.database.reading() as connection:
        library.tokens.caller(connection, token)
        return True
    return False


async def _look_after(library: Library) -> None:
    """Now and then, deletes what is not needed any more."""
    while True:
        await asyncio.sleep(library.settings.upkeep_seconds)
        try:
            await run_in_threadpool(library.look_after)
        except TupliError as err:
            LOG.warning("upkeep", extra={"error": str(err)})
