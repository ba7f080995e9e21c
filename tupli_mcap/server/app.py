"""The server as an ASGI application."""

from __future__ import annotations

from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager

from fastapi import FastAPI, Request, Response
from fastapi.responses import JSONResponse
from starlette.middleware.gzip import GZipMiddleware

import tupli_mcap
from tupli_mcap.page.directory import OpenedRecordings
from tupli_mcap.page.routes import PAGES
from tupli_mcap.server import pages
from tupli_mcap.server.library import Library
from tupli_mcap.server.pages.session import shelf_of
from tupli_mcap.server.routes import accounts, episodes, foxglove, items, pytupli, query, recordings, viewers
from tupli_mcap.server.wire import Error, tell_errors, told

__all__ = ["create_app"]

# Recordings are compressed already. A page may repeat what a stranger's link says beside what only its reader may see;
# the size of both compressed would tell the one from the other.
_AS_THEY_ARE = ("application/octet-stream", "text/html", "font/*", "image/*", "video/*")
_REFUSALS = {status: {"model": Error} for status in (400, 401, 403, 404, 409)}


def create_app(library: Library) -> FastAPI:
    """The application that serves a library, and closes it when it ends."""

    @asynccontextmanager
    async def lifespan(app: FastAPI) -> AsyncIterator[None]:
        yield
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
    app.add_middleware(GZipMiddleware, compresslevel=3, exclude_content_types=_AS_THEY_ARE)
    for routes in (accounts, items, episodes, query, recordings, viewers, foxglove, pytupli):
        app.include_router(routes.router, responses=_REFUSALS)  # type: ignore[arg-type]
    tell_errors(app)
    app.state.shelf_of, app.state.kept, app.state.told = shelf_of, OpenedRecordings(), told
    for router in (*pages.PAGES, *PAGES):
        app.include_router(router)

    @app.get("/health")
    def health() -> dict[str, str]:
        """Whether the server answers and its database does."""
        with library.database.reading() as connection:
            connection.exec_driver_sql("SELECT 1")
        return {"status": "ok"}

    @app.middleware("http")
    async def limit_bodies(request: Request, call_next: Callable[[Request], Awaitable[Response]]) -> Response:
        said = request.headers.get("content-length", "0")
        if request.method != "PATCH":
            unsaid = "transfer-encoding" in request.headers
            if unsaid or not said.isdigit() or int(said) > library.settings.max_body:
                detail = (
                    f"expected a body of at most {library.settings.max_body} bytes, with its Content-Length"
                )
                return JSONResponse({"detail": detail, "error": "StorageError"}, 413)
        return await call_next(request)

    return app
