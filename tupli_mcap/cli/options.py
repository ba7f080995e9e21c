"""Options that several commands share."""

from __future__ import annotations

import importlib
import math
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from tupli_mcap.errors import (
    FilterError,
    Gathered,
    NotFoundError,
    RecordingError,
    StorageError,
    TupliError,
    brief,
    missing_extra,
    warn,
)
from tupli_mcap.remote import is_server, is_url, path_of, shown, shown_name

if TYPE_CHECKING:
    from tupli_mcap.dataset import Dataset
    from tupli_mcap.schema import BaseFilter
    from tupli_mcap.storage import FileStorage, TupliAPIClient, TupliStorage


def local_path(text: str | Path) -> Path:
    """A path, for commands that take no URL. BadParameter for a URL, RecordingError for an empty text. Typer passes
    defaults through it, too."""
    if isinstance(text, str) and is_url(text):
        fetch = "fetch episodes with tupli-mcap pull" if is_server(text) else "download the file"
        raise typer.BadParameter(
            f"expected a path, found {shown(text)}; {fetch}, or save a part of it: tupli_mcap.open(url).save(path)"
        )
    return path_of(text)


File = Annotated[Path, typer.Argument(metavar="FILE", help="A recording.", parser=local_path)]
Sources = Annotated[
    list[str], typer.Argument(metavar="PATH|URL", help="Recordings, directories, patterns, storages, URLs.")
]
Json = Annotated[bool, typer.Option("--json", help="Print JSON instead.")]
Output = Annotated[Path, typer.Option("--output", "-o", metavar="FILE", help="The new recording (.mcap).")]
Force = Annotated[bool, typer.Option("--force", help="Replace the output if it exists.")]
DryRun = Annotated[bool, typer.Option("--dry-run", help="Only say what would be done.")]
Episodes = Annotated[
    str | None,
    typer.Option(
        "--episodes",
        "--episode",
        "-e",
        metavar="WHICH",
        help="Numbers such as 3,7-9 (of a range, those that exist), or best, worst, first, last, all.",
    ),
]
Sort = Annotated[
    str | None,
    typer.Option(metavar="KEY", help="Sort by a column, such as return; -KEY puts the largest first."),
]
ColumnNames = Annotated[
    str | None, typer.Option("--columns", metavar="A,B,…", help="The columns to show, such as steps,return.")
]
Limit = Annotated[int | None, typer.Option("--limit", "-n", min=0, help="Print at most this many episodes.")]
FilterText = Annotated[
    str | None,
    typer.Option("--filter", metavar="FILTER", help="Which episodes, such as 'return > 100 and success'."),
]
StoragePath = Annotated[
    Path,
    typer.Option(
        "--storage",
        envvar="TUPLI_MCAP_STORAGE",
        metavar="DIR",
        help="The storage's directory.",
        parser=local_path,
        readable=False,
    ),
]
Benchmark = Annotated[
    str, typer.Argument(metavar="BENCHMARK_ID", help="A benchmark's id; its first 4 digits are enough.")
]
Url = Annotated[
    str | None,
    typer.Option(
        envvar="TUPLI_MCAP_URL",
        metavar="URL",
        help="The server; by default, that of the last login, or this machine.",
        readable=False,
    ),
]
DEFAULT_STORAGE = Path("_local_storage")
AnyStorage = Annotated[
    str | None,
    typer.Option(
        "--storage",
        "--url",
        envvar=["TUPLI_MCAP_STORAGE", "TUPLI_MCAP_URL"],
        metavar="PATH|URL",
        help="The storage's directory, or a server; by default, _local_storage, or else the server of the last login.",
    ),
]
_SHORTEST_ID = 4


def check_function(value: str | None) -> str | None:
    """What `FunctionName` takes. BadParameter if it is something else."""
    if value is not None and not all(value.partition(":")[::2]):
        raise typer.BadParameter(f"expected module:function, found {value!r}")
    return value


FunctionName = Annotated[
    str,
    typer.Option(
        "--function",
        metavar="MODULE:FUNCTION",
        callback=check_function,
        help="The function; its module may be in the current directory.",
    ),
]


def load_function(name: str, what: str) -> Callable[..., Any]:
    """The function that "module:function" names; its module, which may be in the current directory, is imported.

    `what`: what the function is, for errors. RecordingError if there is no such module or function, or importing it
    failed.
    """
    sys.path.append("")  # last, so that a file in this directory replaces no installed module
    module, _, function = name.partition(":")
    try:
        value: Any = importlib.import_module(module)
        for part in function.split("."):
            value = getattr(value, part)
    except (Exception, SystemExit) as err:  # the module's own code may raise anything
        raise RecordingError(f"the {what} {name!r} cannot be imported: {brief(err)}") from err
    if not callable(value):
        raise RecordingError(f"the {what} {name!r} must be a function, found {type(value).__name__}")
    found: Callable[..., Any] = value
    return found


def check_extras(sources: Sequence[str] = (), **needed: str) -> None:
    """MissingExtraError if more than one extra is missing, of those whose modules are `needed`, and that of URLs; what
    needs one says so itself."""
    for source in filter(is_url, sources):
        needed["remote"] = "httpx" if is_server(source) else "obstore"
    missing = [extra for extra, module in needed.items() if find_spec(module) is None]
    if len(missing) > 1:
        raise missing_extra(f"this command needs the extras {' and '.join(missing)}", ",".join(missing))


def dataset_of(sources: Sequence[str]) -> Dataset:
    """The episodes of paths and URLs; also of one storage or server."""
    from tupli_mcap import open as open_dataset

    return open_dataset(sources[0] if len(sources) == 1 else sources)


def recordings_of(sources: Sequence[str]) -> list[str]:
    """The recordings that paths and URLs name; those of directories and patterns in their order by name. BadParameter
    for a server, RecordingError if there is no such file."""
    from tupli_mcap.storage.listing import recordings_at

    for source in filter(is_server, sources):
        raise typer.BadParameter(
            f"expected recordings, found the server {shown(source)}; fetch them with tupli-mcap pull, or write its "
            f"episodes into one file: tupli-mcap filter {shown(source)} --filter FILTER -o FILE"
        )
    return [file for source in sources for file in recordings_at(source)]


def filter_of(text: str | None) -> BaseFilter | None:
    """The filter that an option's text describes; None without a text. FilterError if it is no filter."""
    if text is None:  # spares the import of the schema
        return None
    from tupli_mcap.schema import parse_filter

    return parse_filter(text)


def check_there(sources: Sequence[str], wanted: BaseFilter) -> None:
    """Raises FilterError if the filter, which matched nothing, names a key of metadata or runs that no episode has;
    warns of a text that none has there."""
    if len(sources) > 1 and any(map(is_server, sources)):  # no dataset has all of them
        return
    if found := sources if is_server(sources[0]) else recordings_of(sources):
        there = dataset_of(found)
        len(there)  # lists it once: the filter and what it may mean are then looked up in the list
        matching_in(there, wanted)


@contextmanager
def hinting(sources: Sequence[str], wanted: BaseFilter | None) -> Iterator[None]:
    """If the block fails because no episode matches the filter, says before its error what the filter may mean, or
    raises a FilterError instead; see `check_there`."""
    try:
        yield
    except FilterError:
        raise
    except TupliError as err:
        if wanted is not None:
            try:
                check_there(sources, wanted)
            except FilterError:
                raise
            except TupliError:  # what the block has met, too
                raise err from None
        raise


def matching_in(dataset: Dataset, wanted: BaseFilter) -> Dataset:
    """The episodes that match. If there is none, a warning or a FilterError says what the filter may mean."""
    from tupli_mcap.dataset.keys import unlike_any

    found = dataset.filter(wanted)
    if not len(found) and (meant := unlike_any(wanted, dataset.headers)):
        warn(meant)
    return found


def chosen_in(
    places: Sequence[Path], episodes: str | None, filter_text: str | None, gathered: Gathered
) -> dict[tuple[str, str], list[int]]:
    """The numbers of the episodes to change, as `numbers_in` returns them. RecordingError if there is none, FilterError
    if no episode has what the filter names."""
    from tupli_mcap.dataset.which import numbers_in

    wanted = filter_of(filter_text)
    found = numbers_in(places, episodes, wanted, gathered)
    if not found:
        with hinting(list(map(str, places)), wanted):
            gathered.raise_all()
        raise none_in(list(map(str, places)), filter_text)
    return found


def none_in(places: Sequence[str], filter_text: str | None) -> RecordingError:
    """The error that no episode is there, or matches; raises FilterError if no episode has what the filter names."""
    wanted = filter_of(filter_text)
    if wanted is not None:
        check_there(places, wanted)
    why = "" if wanted is None else f" that matches {filter_text}"
    return RecordingError(f"there is no episode{why} in {', '.join(map(shown_name, places))}")


def pair_of(text: str) -> tuple[str, Any]:
    """Splits KEY=VALUE. An empty value is None, True and False are bools, JSON is read as such, all else is text; so is
    a number that is too large for a float."""
    from tupli_mcap import jsonvalue
    from tupli_mcap.errors import FormatError

    key, sign, value = text.partition("=")
    if not sign or not key:
        raise typer.BadParameter(f"expected KEY=VALUE, found {text!r}")
    if not value:
        return key, None
    if value in ("True", "False"):
        return key, value == "True"
    try:
        found = jsonvalue.loads(value)
    except (FormatError, ValueError, RecursionError):
        return key, value
    return key, value if isinstance(found, float) and math.isinf(found) else found


def open_storage(path: Path, *, create: bool = False) -> FileStorage:
    """The storage in a directory; StorageError if the directory is missing, unless `create` makes it."""
    from tupli_mcap.storage import FileStorage

    if not create and not path.is_dir():
        raise StorageError(
            f"there is no storage at {str(path)!r}; give its directory with --storage or "
            "in TUPLI_MCAP_STORAGE"
        )
    return FileStorage(path)


def any_storage(place: str | None) -> TupliStorage:
    """The storage in an existing directory, or on a server; by default, the usual directory, or else the server of the
    last login."""
    from tupli_mcap.storage.api import last_server

    if place is None:
        place = "" if DEFAULT_STORAGE.is_dir() else last_server()
        place = place or str(DEFAULT_STORAGE)
    return server_at(place) if is_url(place) else open_storage(path_of(place))


def server_at(url: str | None, *, sends_left: bool = True) -> TupliAPIClient:
    """The storage on a server; see `Url`. sends_left: whether it sends what earlier programs could not send."""
    from tupli_mcap.storage import TupliAPIClient  # takes long to import

    return TupliAPIClient(url, sends_left=sends_left)


def full_id(storage: TupliStorage, text: str) -> str:
    """The benchmark id that starts with `text`, for ids as tables shorten them; `text` itself if none does.
    NotFoundError if several do."""
    if len(text) < _SHORTEST_ID or len(text) >= 64 or not set(text) <= set("0123456789abcdef"):
        return text
    found = [header.id for header in storage.list_benchmarks() if header.id.startswith(text)]
    if len(found) > 1:
        raise NotFoundError(f"{len(found)} benchmarks have an id that starts with {text!r}; give more digits")
    return found[0] if found else text


def chosen_ids_of(sources: Sequence[str], which: str | None, wanted: BaseFilter | None) -> set[str] | None:
    """The ids of the episodes that --episodes names; None without it."""
    if which is None:
        return None
    from tupli_mcap.dataset.chosen import chosen_from

    with hinting(sources, wanted), chosen_from(sources, which, wanted) as chosen:
        return {item.recording.episodes[at].id for item in chosen for at in item.positions}
