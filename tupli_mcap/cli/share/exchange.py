"""Commands between this machine and a server: push, pull, publish, unpublish."""

from __future__ import annotations

import os
import re
import shlex
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, nullcontext
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, NamedTuple

import typer

from tupli_mcap.cli.options import (
    DEFAULT_STORAGE,
    DryRun,
    FilterText,
    Json,
    StoragePath,
    Url,
    filter_of,
    full_id,
    open_storage,
    server_at,
)
from tupli_mcap.cli.output import print_json, print_result
from tupli_mcap.cli.terminal import fail, say
from tupli_mcap.errors import RecordingError, TupliError, bytes_of, no_file, plural
from tupli_mcap.remote import copied, is_url, path_of, shown_name

if TYPE_CHECKING:
    from tupli_mcap.schema import BaseFilter
    from tupli_mcap.storage import TupliAPIClient, TupliStorage

Group = Annotated[str, typer.Option(metavar="GROUP", help="Who sees it: 'global' is everybody.")]
Published = Annotated[
    str | None,
    typer.Argument(
        metavar="[BENCHMARK_ID]", help="A benchmark's id; its first 4 digits are enough.", readable=False
    ),
]
_MOST_WAYS = 3  # of publishing what was sent: of more files, none is told by name
_FILTER = "--filter 'run.name = \"NAME\"'"
_EPISODE = re.compile(r"[0-9a-f]{32}-[0-9]+")


def push(
    sources: Annotated[
        list[str] | None, typer.Argument(metavar="DIR|FILE|URL", help="Storages, or recordings.")
    ] = None,
    benchmark: Annotated[
        str | None,
        typer.Option("--benchmark", metavar="BENCHMARK_ID", help="Only this benchmark of the storage."),
    ] = None,
    filter_text: FilterText = None,
    dry_run: DryRun = False,
    url: Url = None,
    as_json: Json = False,
) -> None:
    """Send storages or recordings to a server.

    Sends all benchmarks of a storage, with their artifacts and episodes, except what the
    server has already. Nobody else sees them until you publish them. If a recording cannot be
    sent, the others are, and the command exits with 1. Without DIR or FILE, it sends the
    recordings that could not be sent while they were recorded.
    """
    sources = sources or []
    files = {source for source in sources if is_url(source) or path_of(source).is_file()}
    if (files or not sources) and (filter_text is not None or benchmark is not None):
        raise typer.BadParameter("--filter and --benchmark go with the directory of a storage")
    for source in sources:
        if source not in files and not Path(source).is_dir():
            raise no_file(Path(source))
    chosen = filter_of(filter_text)
    sends_left = bool(sources) and not dry_run  # without sources, what is left is counted before it is sent
    with server_at(url, sends_left=sends_left) as client:
        if not sources:
            _push_waiting(client, dry_run=dry_run, as_json=as_json)
            return
        if chosen is not None:
            with ExitStack() as stack:
                _check_keys([stack.enter_context(open_storage(Path(each))) for each in sources], chosen)
        done, failed = list[_Pushed](), list[_Failed]()
        try:
            for source in sources:
                with _naming(source, failed) if len(sources) > 1 else nullcontext():
                    if source in files:
                        done.append(_push_file(client, source, dry_run=dry_run))
                    else:
                        done.append(_push_storage(client, source, benchmark, chosen, failed, dry_run=dry_run))
                    if not as_json:
                        say(done[-1].line)
        finally:
            for each in failed:
                fail(each.message)
        if as_json:
            print_json(_told(client.url, dry_run, done, failed))
        elif new := [] if dry_run else [each for each in done if each.episodes]:
            for line in _how_to_publish(new, client.url):
                say(line)
    if failed:
        raise typer.Exit(1)


class _Pushed(NamedTuple):
    """What was sent of a source, or would be; the line says so. `publish`: arguments of `publish` for what is new."""

    line: str
    benchmarks: list[str]
    recordings: list[str]
    episodes: int
    publish: list[str]


class _Failed(NamedTuple):
    """A recording, or a source as it was given, that was not copied."""

    path: str
    message: str


def _push_file(client: TupliAPIClient, source: str, *, dry_run: bool) -> _Pushed:
    from tupli_mcap.schema import FilterEQ, format_filter
    from tupli_mcap.storage.exchange import demand_room, push_recording

    demand = partial(demand_room, client, source)
    with copied(source, demand) if is_url(source) else nullcontext(Path(source)) as path:
        pushed = push_recording(client, path, name=source, dry_run=dry_run)
    what = f"{plural(pushed.episodes, 'episode')} of {shown_name(source)}"
    names = [pushed.name or shown_name(source)]
    if pushed.was_there:
        return _Pushed(f"already there: {what} at {client.url}", [], names, 0, [])
    it = format_filter(FilterEQ(key="recording", value=pushed.name))
    publish = pushed.benchmark_id[:8] or f"--filter {shlex.quote(it)}"
    return _Pushed(f"{_verb(dry_run)} {what} to {client.url}", [], names, pushed.episodes, [publish])


def _push_storage(
    client: TupliAPIClient,
    source: str,
    benchmark: str | None,
    chosen: BaseFilter | None,
    failed: list[_Failed],
    *,
    dry_run: bool,
) -> _Pushed:
    from tupli_mcap.schema import FilterEQ
    from tupli_mcap.storage import FileStorage
    from tupli_mcap.storage.exchange import copy_episodes

    refused: dict[str, TupliError] = {}
    everything = chosen is None and benchmark is None
    with warnings.catch_warnings(), FileStorage(source) as storage:
        if everything:  # what cannot be read is an error then
            warnings.filterwarnings("ignore", "skipped a recording: ")
        uri = None if benchmark is None else full_id(storage, benchmark)
        brought = copy_episodes(storage, client, chosen, benchmark_id=uri, dry_run=dry_run, refused=refused)
        ids, episodes = list(filter(None, brought)), sum(each.episodes for each in brought.values())
        among = None if uri is None else FilterEQ(key="benchmark_id", value=uri)
        if everything:
            refused |= {name: RecordingError(why) for name, why in storage.unreadable.items()}
        why = _why_not(episodes, refused, storage, _both(among, chosen))
    failed += [_failed(str(Path(source, name)), err) for name, err in refused.items()]
    what = _counts(episodes, ids)
    publish = [uri[:8] or _FILTER for uri, each in brought.items() if each.episodes]
    return _Pushed(f"{_verb(dry_run)} {what} to {client.url}{why}", ids, [], episodes, publish)


def _how_to_publish(done: Sequence[_Pushed], url: str) -> list[str]:
    """Says how others get to see what was sent."""
    from tupli_mcap.storage.api import last_server

    ways = sorted({way for each in done for way in each.publish})
    there = "" if url == (os.environ.get("TUPLI_MCAP_URL") or last_server()) else f" --url {url}"
    commands = [f"tupli-mcap publish {way}{there}" for way in ways]
    if len(ways) > _MOST_WAYS:
        ids = [way for way in ways if way[0] != "-"]
        commands = [f"tupli-mcap publish BENCHMARK_ID{there}, for each of {' '.join(ids)}"] if ids else []
        commands += [f"tupli-mcap publish {_FILTER}{there}"] if len(ids) < len(ways) else []
    return [f"to let others see it: {command}" for command in commands]


@contextmanager
def _naming(source: str, failed: list[_Failed]) -> Iterator[None]:
    """Notes an error in the block, which names the source then, so that the others are sent; raises one that these
    would meet too."""
    from tupli_mcap.storage.api.answers import is_of_all

    try:
        yield
    except TupliError as err:
        told = _failed(shown_name(source), err)
        if is_of_all(err):
            raise type(err)(told.message) from err
        failed.append(told)


def _failed(name: str, err: TupliError) -> _Failed:
    return _Failed(name, str(err) if name in str(err) else f"{name}: {err}")


def _verb(dry_run: bool) -> str:
    return "would send" if dry_run else "sent"


def _push_waiting(client: TupliAPIClient, *, dry_run: bool, as_json: bool) -> None:
    from tupli_mcap.storage.exchange import send_waiting

    waiting = send_waiting(client, dry_run=dry_run)
    size = bytes_of(sum(each.size for each in waiting))
    what = f"{plural(len(waiting), 'recording')}, {size},"
    line = f"{_verb(dry_run)} {what}" if waiting else "nothing waits to be sent"
    told = _told(client.url, dry_run, [])
    told |= {"recordings": [str(each.path) for each in waiting], "episodes": None}
    others = [
        f"{plural(n, 'recording')} of {name} wait for {url}; sign in as {name} to send them"
        for (url, name), n in client.waiting_elsewhere().items()
    ]
    print_result(told, f"{line} to {client.url}", *others, as_json=as_json)


def _check_keys(
    storages: Sequence[TupliStorage], wanted: BaseFilter, among: BaseFilter | None = None
) -> None:
    """Raises FilterError if a filter with a `not`, or one that none of the episodes (of `among`) matches, names
    metadata or parts of runs that none of them has."""
    from tupli_mcap.dataset.keys import check_metadata, negates

    both = wanted if among is None else among & wanted
    if negates(wanted) or not any(storage.count_episodes(both) for storage in storages):
        check_metadata(wanted, [header for each in storages for header in each.list_episodes(among)])


def _told(
    url: str, dry_run: bool, done: Sequence[_Pushed], failed: Sequence[_Failed] = ()
) -> dict[str, object]:
    return {
        "dry_run": dry_run,
        "url": url,
        "benchmarks": list(dict.fromkeys(uri for each in done for uri in each.benchmarks)),
        "recordings": [name for each in done for name in each.recordings],
        "episodes": sum(each.episodes for each in done),
        "errors": [each._asdict() for each in failed],
    }


def pull(
    item: Annotated[
        str | None,
        typer.Argument(
            metavar="[BENCHMARK_ID|EPISODE_ID]",
            help="A benchmark with its episodes (the first 4 digits of its id are enough), or one episode.",
            readable=False,
        ),
    ] = None,
    storage_path: StoragePath = DEFAULT_STORAGE,
    filter_text: FilterText = None,
    everything: Annotated[bool, typer.Option("--all", help="All that you may read.")] = False,
    dry_run: DryRun = False,
    url: Url = None,
    as_json: Json = False,
) -> None:
    """Fetch benchmarks and episodes from a server.

    A benchmark comes with all its episodes, or with those of the filter; --filter alone
    fetches matching episodes of all benchmarks. Only new episodes are fetched. Environments
    are not trusted, unless a key that you trust has signed them.
    """
    from tupli_mcap.schema import FilterEQ
    from tupli_mcap.storage import FileStorage
    from tupli_mcap.storage.exchange import copy_episodes

    if everything != (item is None and filter_text is None):
        raise typer.BadParameter("expected a BENCHMARK_ID, an EPISODE_ID or --filter, or --all alone")
    wanted = filter_of(filter_text)
    with server_at(url, sends_left=not dry_run) as client, FileStorage(storage_path) as storage:
        uri = among = None
        if item is not None and _EPISODE.fullmatch(item):
            among = _only(client, item)
        elif item is not None:
            uri = full_id(client, item)
            among = FilterEQ(key="benchmark_id", value=uri)
        if wanted is not None:
            _check_keys([client], wanted, among)
        chosen = _both(among, wanted)
        refused: dict[str, TupliError] = {}
        copied = copy_episodes(client, storage, chosen, benchmark_id=uri, dry_run=dry_run, refused=refused)
        ids = list(filter(None, copied))
        artifacts = sum(each.artifacts for each in copied.values())
        episodes = sum(each.episodes for each in copied.values())
        why = _why_not(episodes, refused, client, chosen)
    told = {"dry_run": dry_run, "benchmarks": ids, "storage": str(storage_path)}
    verb = "would fetch" if dry_run else "fetched"
    failed = [_failed(shown_name(name), err) for name, err in refused.items()]
    print_result(
        {**told, "artifacts": artifacts, "episodes": episodes, "errors": [each._asdict() for each in failed]},
        f"{verb} {_counts(episodes, ids)} into {storage_path}{why}",
        as_json=as_json,
    )
    for each in failed:
        fail(each.message)
    if failed:
        raise typer.Exit(1)


def _why_not(
    copied: int, refused: Mapping[str, TupliError], source: TupliStorage, chosen: BaseFilter | None
) -> str:
    """How many recordings were not copied, or else why no episode was; empty if all is well."""
    if refused:
        return f", but not those of {plural(len(refused), 'recording')}"
    if copied:
        return ""
    from tupli_mcap.storage import TupliAPIClient

    there = source.count_episodes(chosen)
    if not there and chosen is None:
        if isinstance(source, TupliAPIClient):
            return "; there is none that you may read"
        return "; the directory has no episodes: give one with recordings (.mcap), or record some (tupli-mcap record)"
    return f"; none of the {there:,} that match is new and can be copied" if there else "; no episode matches"


def _both(one: BaseFilter | None, other: BaseFilter | None) -> BaseFilter | None:
    return other if one is None else one if other is None else one & other


def _counts(episodes: int, benchmarks: Sequence[str]) -> str:
    """How many episodes, and of how many stored benchmarks, if they are of any."""
    of = f" of {plural(len(benchmarks), 'benchmark')}" if benchmarks else ""
    return f"{plural(episodes, 'episode')}{of}"


def _only(client: TupliAPIClient, episode: str) -> BaseFilter:
    """A filter for one episode of a server; NotFoundError if the server has none of this id."""
    from tupli_mcap.errors import NotFoundError
    from tupli_mcap.schema import FilterEQ

    it = FilterEQ(key="id", value=episode)
    if not client.count_episodes(it):
        raise NotFoundError(f"there is no episode with id {episode!r} at {client.url}")
    return it


def publish(
    benchmark: Published = None,
    group: Group = "global",
    filter_text: FilterText = None,
    dry_run: DryRun = False,
    url: Url = None,
    as_json: Json = False,
) -> None:
    """Let others see a benchmark or episodes on a server.

    Of a benchmark, they also see its artifacts, and your episodes of it (with --filter, only
    those that match); if it is somebody else's, only your episodes. --filter alone publishes
    your matching episodes, of any benchmark or none.
    """
    _turn(benchmark, group, filter_text, url, hide=False, dry_run=dry_run, as_json=as_json)


def unpublish(
    benchmark: Published = None,
    group: Group = "global",
    filter_text: FilterText = None,
    dry_run: DryRun = False,
    url: Url = None,
    as_json: Json = False,
) -> None:
    """Hide a benchmark or episodes on a server from others.

    Of a benchmark, it also hides your episodes; if it is somebody else's, only these. Its
    artifacts stay visible, as other benchmarks may need them. With --filter, it hides only your
    episodes that match.
    """
    _turn(benchmark, group, filter_text, url, hide=True, dry_run=dry_run, as_json=as_json)


def _turn(
    benchmark: str | None,
    group: str,
    filter_text: str | None,
    url: str | None,
    *,
    hide: bool,
    dry_run: bool,
    as_json: bool,
) -> None:
    """Publishes or hides a benchmark and the user's episodes of it, or those that match a filter."""
    from tupli_mcap.schema import FilterEQ
    from tupli_mcap.storage import exchange

    if benchmark is None and filter_text is None:
        raise typer.BadParameter("expected a BENCHMARK_ID or --filter")
    chosen = filter_of(filter_text)
    with server_at(url, sends_left=not dry_run) as client:
        uri = None if benchmark is None else full_id(client, benchmark)
        if chosen is not None:
            own = FilterEQ(key="created_by", value=client.whoami().username)
            _check_keys(
                [client], chosen, own if uri is None else own & FilterEQ(key="benchmark_id", value=uri)
            )
        if uri is not None:
            shared = exchange.share_benchmark(client, uri, group, chosen, published=not hide, dry_run=dry_run)
            count = plural(shared.episodes, "episode")
            both = f"{uri[:8]} and {count} of yours" if hide else f"{uri[:8]} with {count}"
            what = both if shared.benchmark else f"{count} of {uri[:8]}"
        elif chosen is not None:
            shared = exchange.share_own(client, group, chosen, published=not hide, dry_run=dry_run)
            what = plural(shared.episodes, "episode")
    would, did, where = ("hide", "hid", "from") if hide else ("publish", "published", "in")
    told = {"dry_run": dry_run, "benchmark": uri, "group": group, "episodes": shared.episodes}
    line = f"{f'would {would}' if dry_run else did} {what} {where} {group}"
    print_result(told, line, as_json=as_json)
