"""The state of the server, for its administrators and for container orchestration."""

from __future__ import annotations

from fastapi import APIRouter, Request, Response
from prometheus_client import CONTENT_TYPE_LATEST

from tupli_mcap.schema import Right
from tupli_mcap.server.people.tokens import SignInError
from tupli_mcap.server.routes.callers import AnyCaller, Served
from tupli_mcap.server.traffic.metrics import Metrics
from tupli_mcap.server.wire import REFUSALS

router = APIRouter(tags=["operation"], responses=REFUSALS)


@router.head("/health", include_in_schema=False)
@router.get("/health")
def health() -> dict[str, str]:
    """Answers if the process is alive; if it does not answer, restart it."""
    return {"status": "ok"}


@router.head("/ready", include_in_schema=False)
@router.get("/ready")
def ready(library: Served) -> dict[str, str]:
    """Whether the server reaches its database, and its directory or bucket; 503 if not: send no requests then."""
    library.reach()
    return {"status": "ok"}


@router.get("/metrics", response_class=Response)
def metrics(library: Served, caller: AnyCaller, request: Request) -> Response:
    """Numbers for Prometheus. Without open metrics, they need a token with the right `role_management`."""
    if not library.settings.open_metrics:
        if caller.is_guest:
            raise SignInError("guests are shown no metrics")
        caller.demand(Right.ROLE_MANAGEMENT)
    counted: Metrics = request.app.state.metrics
    with library.database.reading() as connection:
        return Response(counted.text(connection), media_type=CONTENT_TYPE_LATEST)
