"""Commands between this machine and a server: push, pull, publish, unpublish."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from tupli_mcap.cli.options import DEFAULT_STORAGE, FilterText, Json, filter_of, full_id, local_path
from tupli_mcap.cli.output import counted, print_json
from tupli_mcap.cli.share.account import Url
from tupli_mcap.cli.terminal import say

__all__ = ["publish", "pull", "push", "unpublish"]

Benchmark = Annotated[str, typer.Argument(metavar="BENCHMARK_ID", help="A benchmark (4 digits may do).")]
Group = Annotated[str, typer.Option(metavar="GROUP", help="Who sees it: 'global' is everybody.")]


def push(
    source: Annotated[
        Path, typer.Argument(metavar="DIR|FILE", parser=local_path, help="A storage or a recording.")
    ],
    benchmark: Annotated[
        str | None, typer.Option("--benchmark", metavar="BENCHMARK_ID", help="Only this one of the storage.")
    ] = None,
    filter_text: FilterText = None,
    url: Url = None,
    as_json: Json = False,
) -> None:
    """Send a storage or a recording to a server.

    All benchmarks of a storage are sent, with their artifacts and episodes.
    What the server has already is not sent again. Nobody else sees it before it is published.
    """
    from tupli_mcap.storage import FileStorage, TupliAPIClient
    from tupli_mcap.storage.exchange import copy_benchmark, push_recording

    with TupliAPIClient(url) as client:
        if source.is_file():
            if filter_text is not None or benchmark is not None:
                raise typer.BadParameter("a filter and a benchmark go with a storage, not with a file")
            name = push_recording(client, source)
            if as_json:
                print_json({"url": client.url, "benchmarks": [], "recordings": [name], "episodes": None})
            else:
                say(f"sent {source} to {client.url}")
            return
        with FileStorage(source) as storage:
            ids = [header.id for header in storage.list_benchmarks()]
            if benchmark is not None:
                ids = [full_id(storage, benchmark)]
            copied = {uri: copy_benchmark(storage, client, uri, filter_of(filter_text)) for uri in ids}
        episodes = sum(each.episodes for each in copied.values())
        if as_json:
            print_json(
                {"url": client.url, "benchmarks": list(copied), "recordings": [], "episodes": episodes}
            )
        else:
            say(f"sent {counted(episodes, 'episode')} of {counted(len(ids), 'benchmark')} to {client.url}")


def pull(
    benchmark: Benchmark,
    storage_path: Annotated[
        Path,
        typer.Option(
            "--storage", envvar="TUPLI_MCAP_STORAGE", help="Where to.", parser=local_path, readable=False
        ),
    ] = DEFAULT_STORAGE,
    filter_text: FilterText = None,
    url: Url = None,
    as_json: Json = False,
) -> None:
    """Fetch a benchmark with its episodes from a server.

    Its environment is as untrusted as a file from a stranger. Fetched again, only what is new comes.
    """
    from tupli_mcap.storage import FileStorage, TupliAPIClient
    from tupli_mcap.storage.exchange import copy_benchmark

    with TupliAPIClient(url) as client, FileStorage(storage_path) as storage:
        uri = full_id(client, benchmark)
        copied = copy_benchmark(client, storage, uri, filter_of(filter_text))
    if as_json:
        print_json({"benchmark": uri, "storage": str(storage_path), **copied._asdict()})
    else:
        say(f"fetched {counted(copied.episodes, 'episode')} of {uri[:8]} into {storage_path}")


def publish(benchmark: Benchmark, group: Group = "global", url: Url = None, as_json: Json = False) -> None:
    """Let others see a benchmark on a server.

    They see its artifacts, and your episodes of it, too.
    """
    from tupli_mcap.storage import TupliAPIClient
    from tupli_mcap.storage.exchange import publish_benchmark

    with TupliAPIClient(url) as client:
        uri = full_id(client, benchmark)
        episodes = publish_benchmark(client, uri, group)
        line = f"published {uri[:8]} with {counted(episodes, 'episode')} in {group}"
        _tell(uri, group, episodes, line, as_json=as_json)


def unpublish(
    benchmark: Benchmark,
    group: Group = "global",
    url: Url = None,
    as_json: Json = False,
) -> None:
    """Take a benchmark away from others.

    Your episodes of it go too; its artifacts stay, as other benchmarks may need them.
    """
    from tupli_mcap.storage import TupliAPIClient
    from tupli_mcap.storage.exchange import unpublish_benchmark

    with TupliAPIClient(url) as client:
        uri = full_id(client, benchmark)
        episodes = unpublish_benchmark(client, uri, group)
        _tell(uri, group, episodes, f"{group} does not see {uri[:8]} any more", as_json=as_json)


def _tell(uri: str, group: str, episodes: int, line: str, *, as_json: bool) -> None:
    if as_json:
        print_json({"benchmark": uri, "group": group, "episodes": episodes})
    else:
        say(line)
