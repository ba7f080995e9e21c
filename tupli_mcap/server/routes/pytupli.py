"""The routes of PyTupli's server, for its unchanged client: the same functions under other names.

Unlike the routes of `/v1`, they answer 403 both for unknown items and for those that may not be read. An admin gets
404.
"""

from __future__ import annotations

import contextlib
import json
from collections.abc import Generator, Iterator
from typing import Annotated, Any

from fastapi import APIRouter, Body, Depends, File, Form, Request, Response
from fastapi.responses import StreamingResponse
from fastapi.security import HTTPAuthorizationCredentials, HTTPBearer
from pydantic import TypeAdapter, ValidationError
from sqlalchemy import Select, select

from tupli_mcap import jsonvalue
from tupli_mcap.errors import FilterError, NotFoundError
from tupli_mcap.page.copies import in_pieces
from tupli_mcap.schema import (
    ArtifactMetadataItem,
    BaseFilter,
    Benchmark,
    BenchmarkHeader,
    BenchmarkQuery,
    Episode,
    EpisodeHeader,
    FilterEQ,
    GroupMembershipQuery,
    GroupWithMembers,
    Right,
    UserOut,
)
from tupli_mcap.server.library import Library
from tupli_mcap.server.people import accounts
from tupli_mcap.server.people.access import Caller, DeniedError, as_told
from tupli_mcap.server.people.accounts import ConflictError
from tupli_mcap.server.people.limits import Turns
from tupli_mcap.server.routes.accounts import (
    Credentials,
    create_group,
    create_role,
    create_user,
    delete_role,
    delete_user,
    list_groups,
    list_roles,
    memberships,
)
from tupli_mcap.server.routes.bodies import BODY, body_of
from tupli_mcap.server.routes.callers import Address, Person, Reader, Served, Writer
from tupli_mcap.server.stored import episodes
from tupli_mcap.server.stored.items import Kind, artifact_key
from tupli_mcap.server.tables import AUDIT, CLAIM
from tupli_mcap.server.wire import REFUSALS_OF_PYTUPLI, AskedFilter, answer, artifact_metadata, demand_short
from tupli_mcap.storage.base import is_episode_id, no_such
from tupli_mcap.storage.catalog.order import After
from tupli_mcap.storage.texts import escape_text, first_defect

router = APIRouter(tags=["PyTupli's routes"], responses=REFUSALS_OF_PYTUPLI)
_DENIED = "You do not have sufficient permissions for this operation."
_LONGEST_HEADER = 60_000  # requests and nginx take 64 KiB, with all of the others
_BEARER = HTTPBearer(auto_error=False)
_FILTER: TypeAdapter[BaseFilter] = TypeAdapter(AskedFilter)
_Filter = Annotated[dict[str, Any] | None, Body()]


@contextlib.contextmanager
def _hidden(caller: Caller, text: str) -> Iterator[None]:
    """Reveals only to an admin that an item does not exist."""
    try:
        yield
    except NotFoundError as err:
        if caller.may(Right.ROLE_MANAGEMENT):
            raise NotFoundError(text) from err
        raise DeniedError(_DENIED) from err


@contextlib.contextmanager
def _deleting(library: Library, caller: Caller, kind: str, uri: str) -> Iterator[None]:
    """Deleting a missing item is no error for an admin, nor for the user who deleted it, or who has stored the
    recording of an episode. All others get DeniedError."""
    try:
        yield
    except NotFoundError:
        done: Select[Any] = select(AUDIT.c.number).where(
            AUDIT.c.user == caller.name,
            AUDIT.c.action == f"delete_{kind}",
            AUDIT.c.target.startswith(f"{escape_text(uri)} of ", autoescape=True),
        )
        if is_episode_id(uri):
            uuid = uri.rpartition("-")[0]
            done = select(CLAIM.c.rank).where(CLAIM.c.uuid == uuid, CLAIM.c.created_by == caller.name)
        with library.database.reading() as connection:
            known = connection.execute(done.limit(1)).first()
        if known is None and not caller.may(Right.ROLE_MANAGEMENT):
            raise DeniedError(_DENIED) from None


# --- those of `/v1` that are the same ---

router.post("/access/users/create")(create_user)
router.delete("/access/users/delete")(delete_user)
router.post("/access/groups/create")(create_group)
router.get("/access/groups/list")(list_groups)
router.post("/access/roles/create")(create_role)
router.get("/access/roles/list")(list_roles)
router.delete("/access/roles/delete")(delete_role)

# --- users ---


@router.get("/access/users/list")
def list_users(library: Served, caller: Reader) -> list[UserOut]:
    """All users."""
    caller.demand(Right.USER_READ)
    with library.database.reading() as connection:
        users = accounts.list_users(connection, caller)
    return [UserOut(username=name, memberships=memberships(held)) for name, held in users.items()]


@router.put("/access/users/change-password")
def change_password(library: Served, caller: Person, told: Credentials) -> None:
    """Changes a password, and ends all that was signed in with the old one."""
    library.change_password(caller, told.username, told.password, old=None)


@router.post("/access/users/token")
def sign_in(library: Served, address: Address, told: Credentials) -> dict[str, Any]:
    """Signs in."""
    pair = library.sign_in(told.username, told.password, address)
    return {name: {"token": pair[name], "token_type": "bearer"} for name in ("access_token", "refresh_token")}


@router.post("/access/users/refresh-token")
def refresh(
    library: Served, credentials: Annotated[HTTPAuthorizationCredentials | None, Depends(_BEARER)]
) -> dict[str, str]:
    """Another access token for a refresh token. `access_token` is where PyTupli's client looks for it."""
    if credentials is None:
        raise DeniedError(_DENIED)
    with library.database.reading() as connection:
        token = library.tokens.access_for(connection, credentials.credentials)
    return {"token": token, "token_type": "bearer", "access_token": token}


# --- groups ---


def _group(library: Library, caller: Caller, name: str) -> GroupWithMembers:
    with library.database.reading() as connection:
        return accounts.members_of(connection, caller, name)


@router.get("/access/groups/read", response_model_exclude={"roles"})
def read_group(library: Served, caller: Reader, group_name: str) -> GroupWithMembers:
    """A group and the names of its members."""
    with _hidden(caller, "Group not found"):
        return _group(library, caller, group_name)


@router.delete("/access/groups/delete")
def delete_group(library: Served, caller: Writer, group_name: str) -> None:
    """Deletes a group."""
    is_admin = caller.may(Right.ROLE_MANAGEMENT)  # for whom an unknown one is deleted already
    unknown = contextlib.suppress(NotFoundError) if is_admin else _hidden(caller, "Group not found")
    with unknown, library.database.writing() as connection:
        accounts.delete_group(connection, caller, group_name)


@router.post("/access/groups/add-members", response_model_exclude={"roles"})
def add_members(library: Served, caller: Writer, told: GroupMembershipQuery) -> GroupWithMembers:
    """Gives users roles in a group."""
    members = [(member.user, member.roles or ["member"]) for member in told.members]
    with library.database.writing() as connection:
        accounts.add_members(connection, caller, told.group_name, members)
    return _group(library, caller, told.group_name)


@router.post("/access/groups/remove-members", response_model_exclude={"roles"})
def remove_members(library: Served, caller: Writer, told: GroupMembershipQuery) -> GroupWithMembers:
    """Takes users out of a group."""
    with library.database.writing() as connection:
        users = [member.user for member in told.members]
        accounts.remove_members(connection, caller, told.group_name, users)
    return _group(library, caller, told.group_name)


# --- benchmarks and artifacts ---


def _publish(
    library: Library, caller: Caller, kind: Kind, uri: str, group: str, *, published: bool = True
) -> None:
    change = library.items.publish if published else library.items.unpublish
    with _hidden(caller, f"{kind.title()} not found"), library.database.writing() as connection:
        change(connection, caller, kind, uri, group)


@router.post("/benchmarks/create", response_model=BenchmarkHeader)
def store_benchmark(library: Served, caller: Writer, told: BenchmarkQuery) -> Response:
    """Stores a benchmark that the caller does not have yet."""
    demand_short(told.metadata)
    own = FilterEQ(key="hash", value=told.hash) & FilterEQ(key="created_by", value=caller.name)
    with library.database.writing() as connection:
        if library.items.list_benchmarks(connection, caller, own):
            raise ConflictError("Benchmark already exists")
        return answer(library.items.store_benchmark(connection, caller, told))


@router.get("/benchmarks/load", response_model=Benchmark)
def load_benchmark(library: Served, caller: Reader, benchmark_id: str) -> Response:
    """A benchmark with its environment as text."""
    with _hidden(caller, "Benchmark not found"), library.database.reading() as connection:
        return answer(library.items.load_benchmark(connection, caller, benchmark_id))


@router.post("/benchmarks/list", response_model=list[BenchmarkHeader])
def list_benchmarks(library: Served, caller: Reader, told: _Filter = None) -> Response:
    """The benchmarks that match a filter."""
    with library.database.reading() as connection:
        return answer(library.items.list_benchmarks(connection, caller, _filter(told)))


@router.put("/benchmarks/publish")
def publish_benchmark(library: Served, caller: Writer, benchmark_id: str, publish_in: str) -> None:
    """Lets a group see a benchmark."""
    _publish(library, caller, "benchmark", benchmark_id, publish_in)


@router.put("/benchmarks/unpublish")
def unpublish_benchmark(library: Served, caller: Writer, benchmark_id: str, unpublish_from: str) -> None:
    """Takes a benchmark away from a group."""
    _publish(library, caller, "benchmark", benchmark_id, unpublish_from, published=False)


@router.delete("/benchmarks/delete")
def delete_benchmark(library: Served, caller: Writer, benchmark_id: str) -> None:
    """Deletes a benchmark; its episodes and artifacts stay."""
    with _deleting(library, caller, "benchmark", benchmark_id), library.database.writing() as connection:
        library.items.delete_benchmark(connection, caller, benchmark_id)


@router.post("/artifacts/upload", response_model=ArtifactMetadataItem)
def store_artifact(
    library: Served, caller: Writer, data: Annotated[bytes, File()], metadata: Annotated[str, Form()]
) -> Response:
    """Stores bytes."""
    return answer(library.store_artifact(caller, data, artifact_metadata(metadata)))


@router.get("/artifacts/download", response_class=Response, responses=BODY)
def load_artifact(library: Served, caller: Reader, request: Request, artifact_id: str) -> Response:
    """The bytes of an artifact; what is known of it is JSON in `X-Metadata`, or its id alone if that would be long."""
    with _hidden(caller, "Artifact does not exist"), library.database.reading() as connection:
        item = library.items.load_artifact(connection, caller, artifact_id)
    told = json.dumps(item.model_dump(), default=str)  # in ASCII
    if len(told) > _LONGEST_HEADER:
        told = json.dumps({"id": item.id})
    return body_of(library, request, artifact_key(item.id), digest=item.id, headers={"X-Metadata": told})


@router.post("/artifacts/list", response_model=list[ArtifactMetadataItem])
def list_artifacts(library: Served, caller: Reader, told: _Filter = None) -> Response:
    """The artifacts that match a filter."""
    with library.database.reading() as connection:
        return answer(library.items.list_artifacts(connection, caller, _filter(told)))


@router.put("/artifacts/publish")
def publish_artifact(library: Served, caller: Writer, artifact_id: str, publish_in: str) -> None:
    """Lets a group see an artifact."""
    _publish(library, caller, "artifact", artifact_id, publish_in)


@router.put("/artifacts/unpublish")
def unpublish_artifact(library: Served, caller: Writer, artifact_id: str, unpublish_from: str) -> None:
    """Takes an artifact away from a group."""
    _publish(library, caller, "artifact", artifact_id, unpublish_from, published=False)


@router.delete("/artifacts/delete")
def delete_artifact(library: Served, caller: Writer, artifact_id: str) -> None:
    """Deletes an artifact, needed or not, as PyTupli does."""
    with _deleting(library, caller, "artifact", artifact_id):
        library.delete_artifact(caller, artifact_id, force=True)


# --- episodes ---


@router.post("/episodes/record", response_model=EpisodeHeader)
def record_episode(library: Served, caller: Writer, told: Episode) -> Response:
    """Stores an episode, as a recording of its own."""
    with _hidden(caller, "Benchmark id doesn't exist"):
        name = library.record(caller, told)
    with library.database.reading() as connection:
        (header,) = episodes.find_episodes(connection, caller, FilterEQ(key="recording", value=name))
    return answer(header)


@router.post("/episodes/list", response_model=list[EpisodeHeader])
def list_episodes(
    library: Served, caller: Reader, address: Address, request: Request, told: _Filter = None
) -> StreamingResponse:
    """The episodes that match a filter, with their tuples if `include_tuples` says so."""
    pages = _pages(library, caller, _filter(told))
    if (told or {}).get("include_tuples"):
        items = (item.model_dump() for page in pages for item in library.with_tuples(page))
        texts = (jsonvalue.dumps_plain(item) for item in items)
    else:
        texts = (jsonvalue.dumps([dict(header) for header in page])[1:-1] for page in pages if page)
    made = in_pieces(_list_of(texts), "application/json")
    turns: Turns = request.app.state.turns
    made.body_iterator = turns.each(caller, address, made.body_iterator)
    return made


def _pages(library: Library, caller: Caller, wanted: BaseFilter | None) -> Iterator[list[EpisodeHeader]]:
    """The episodes that match a filter, each page in a transaction of its own."""
    most, after = library.settings.max_page, None
    while True:
        with library.database.reading() as connection:
            found = episodes.find_episodes(connection, caller, wanted, limit=most, after=after)
            page = as_told(connection, caller, list(found))
        yield page
        if len(page) < most:
            return
        after = After(page[-1].recording, page[-1].episode)


def _list_of(texts: Iterator[str]) -> Generator[bytes]:
    """A JSON list; each text has one or more of its items."""
    yield b"[" + next(texts, "").encode()
    for text in texts:
        yield b"," + text.encode()
    yield b"]"


@router.put("/episodes/publish")
def publish_episode(library: Served, caller: Writer, episode_id: str, publish_in: str) -> None:
    """Lets a group see an episode."""
    with _hidden(caller, "Episode not found"), library.database.writing() as connection:
        episodes.publish_one(connection, caller, episode_id, publish_in)


@router.put("/episodes/unpublish")
def unpublish_episode(library: Served, caller: Writer, episode_id: str, unpublish_from: str) -> None:
    """Takes an episode away from a group."""
    with _hidden(caller, "Episode not found"), library.database.writing() as connection:
        episodes.publish_one(connection, caller, episode_id, unpublish_from, published=False)


@router.delete("/episodes/delete")
def delete_episode(library: Served, caller: Writer, episode_id: str) -> None:
    """Deletes an episode."""
    with _deleting(library, caller, "episode", episode_id):
        if not library.delete_episodes(caller, FilterEQ(key="id", value=episode_id)):
            raise no_such("episode", episode_id)


def _filter(told: dict[str, Any] | None) -> BaseFilter | None:
    """A filter of PyTupli's: a combination without parts is true of everything, and fields that it does not know do not
    count."""
    try:
        found = _FILTER.validate_python(_known(told or {}, 0))
    except ValidationError as err:
        raise FilterError(f"expected a filter: {first_defect(err)}") from err
    return None if found.key is None and not found.filters else found


def _known(told: Any, depth: int) -> dict[str, Any]:
    parts = (told.get("filters") or []) if isinstance(told, dict) else None
    if not isinstance(parts, list) or depth > 32:
        raise FilterError("expected a filter: an object with type, and key and value, or a list of filters")
    compared = {name: told[name] for name in ("key", "value") if told.get(name) is not None}
    return {
        "type": told.get("type", "OR"),
        "filters": [_known(part, depth + 1) for part in parts],
        **compared,
    }
