"""The command info: shows what is in a recording, or in several, such as those of a directory."""

from __future__ import annotations

import math
from collections import Counter
from typing import TYPE_CHECKING

from tupli_mcap.cli.options import (
    Episodes,
    FilterText,
    Json,
    Sources,
    chosen_ids_of,
    dataset_of,
    filter_of,
    hinting,
    matching_in,
)
from tupli_mcap.cli.output import (
    Column,
    number,
    numbers,
    pairs_of,
    print_facts,
    print_json,
    print_table,
    print_wrapped,
    short_ids,
    time_of,
    when,
)
from tupli_mcap.cli.terminal import can_print, say, terminal_width
from tupli_mcap.errors import RecordingError, bytes_of, plural
from tupli_mcap.remote import is_server, is_url, path_of, shown_name

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from typing import Any

    from tupli_mcap.dataset import Dataset
    from tupli_mcap.recording import Recording
    from tupli_mcap.recording.describe.description import RecordingDescription, Spread
    from tupli_mcap.recording.describe.series import Series
    from tupli_mcap.schema import BaseFilter

BLOCKS = "▁▂▃▄▅▆▇█"
PLAIN = ".:-=+*#@"  # where blocks cannot be printed
_WIDEST, _NARROWEST = 40, 8
_OTHERS = 44  # columns of a line that are not blocks
_LONGEST_NAME = 24


def _dataset(sources: Sequence[str], episodes: str | None, wanted: BaseFilter | None) -> Dataset:
    """The chosen episodes of several recordings. RecordingError for a directory without any."""
    from tupli_mcap.storage.listing import recordings_at

    for source in sources:
        if not is_url(source) and not recordings_at(source):
            raise RecordingError(f"{source} is a directory; expected a recording (.mcap) in it, found none")
    dataset = dataset_of(sources)
    if (ids := chosen_ids_of(sources, episodes, wanted)) is not None:
        return dataset[[header.id in ids for header in dataset.headers]]
    return dataset if wanted is None else matching_in(dataset, wanted)


def _info_keys(dataset: Dataset) -> list[str]:
    """The keys of infos in its recordings, each of which gets a share of the sample."""
    from tupli_mcap.dataset.chosen import subjects_of
    from tupli_mcap.progress import progress
    from tupli_mcap.recording.describe.description import info_keys
    from tupli_mcap.recording.describe.series import MOST_INFOS

    subjects, found = list(subjects_of(dataset, None)), set[str]()
    with progress(len(subjects), "reading infos") as bar:
        for subject in subjects:
            bar.advance(1)
            with subject.open() as recording:
                found.update(info_keys(recording, subject.choose(recording), MOST_INFOS // len(subjects)))
    return sorted(found)


def _print_many(
    sources: Sequence[str], episodes: str | None, wanted: BaseFilter | None, *, as_json: bool
) -> None:
    """Prints facts about the recordings of a directory, a server, or several of those, or about the chosen episodes."""
    from tupli_mcap.messages.episodes import END_NAMES
    from tupli_mcap.recording.about.success import success_of, success_text
    from tupli_mcap.recording.describe.description import spread_of

    dataset, names = _dataset(sources, episodes, wanted), [*map(shown_name, sources)]
    are_here = not any(map(is_url, sources))  # elsewhere, nothing is opened
    headers = dataset.headers
    said = [found for header in headers if (found := success_of(header.metadata)) is not None]
    ends = dict.fromkeys(END_NAMES, 0)
    for header in headers:
        ends[header.end] = ends.get(header.end, 0) + 1
    seeds = {header.seed for header in headers} - {None}
    recordings = len({header.recording for header in headers})
    run_names: dict[object, str] = {}  # by id; that of the first file, where the run has none of its own
    for header in headers:
        name = str(header.run.get("name", ""))
        run_names.setdefault(header.run.get("id") or name, name)
    runs = list(dict.fromkeys(run_names.values()))
    environments = sorted(
        {str(header.run["environment"]) for header in headers if header.run.get("environment")}
    )
    keys = sorted({key for header in headers for key in header.metadata})
    settings = sorted({key for header in headers for key in header.run.get("metadata", {})})
    infos = _info_keys(dataset) if are_here else []
    lengths, returns = spread_of(dataset.lengths), spread_of(dataset.returns)
    rate = sum(said) / len(said) if said else None
    if as_json:
        print_json(
            {
                "path": names[0] if len(names) == 1 else None, "paths": names, "recordings": recordings,
                "runs": runs, "environments": environments, "episodes": len(headers), "ends": ends,
                "steps": dataset.n_steps, "lengths": lengths, "returns": returns, "success": rate,
                "success_known": len(said), "seeds": len(seeds), "metadata_keys": keys, "info_keys": infos,
                "setting_keys": settings, "made_of": dataset.made_of if are_here else None,
            }
        )  # fmt: skip
        return
    ended = ", ".join(f"{count:,} {name}" for name, count in ends.items() if count)
    lines = {
        _kind(sources): _some(names),
        "recordings": number(recordings),
        "runs": _some(runs),
        "settings": _some(settings),
        "environments": _some(environments),
        "episodes": number(len(headers)) + (f" ({ended})" if ended else ""),
        "steps": number(dataset.n_steps) + _spread_text(lengths, len(headers), " an episode"),
        "return": _spread_text(returns, len(headers)).removeprefix(", "),
        "success": "" if rate is None else success_text(rate, len(said), len(headers)),
        "seeds": f"{number(len(seeds))} different" if seeds else "",
        "metadata": _some(keys),
        "infos": _some(infos),
    }
    print_facts(lines.items())


def _kind(sources: Sequence[str]) -> str:
    if len(sources) > 1:
        return "sources"
    if is_server(sources[0]):
        return "server"
    return "directory" if not is_url(sources[0]) and path_of(sources[0]).is_dir() else "pattern"


def _some(names: Sequence[str]) -> str:
    return ", ".join(names[:8]) + (f" and {number(len(names) - 8)} more" if len(names) > 8 else "")


def info(
    paths: Sources, episodes: Episodes = None, filter_text: FilterText = None, as_json: Json = False
) -> None:
    """Show what is in a recording, or in several together.

    For a recording: its run, spaces, benchmark, returns and lengths of episodes,
    distributions of rewards, actions, states and infos, channels and attachments.
    Distributions and keys of infos of a long recording come from a sample of its steps; for
    a URL, they are left out. For several recordings: their runs, environments, episodes, and
    the keys of settings, metadata and infos. --episodes and --filter choose episodes; channels,
    attachments and size are those of the whole file.
    """
    import numpy as np

    from tupli_mcap.dataset.which import candidates, named_positions
    from tupli_mcap.recording import Recording
    from tupli_mcap.recording.describe.description import describe
    from tupli_mcap.storage.listing import is_of_several

    wanted = filter_of(filter_text)
    if len(paths) > 1 or is_of_several(paths[0]):
        _print_many(paths, episodes, wanted, as_json=as_json)
        return
    with Recording(paths[0]) as recording:
        if episodes is None and wanted is None:
            positions = candidates(recording)  # without deleted episodes
        else:
            which = "all" if episodes is None else episodes
            with hinting(paths, wanted):
                positions = np.array(sorted(named_positions(recording, which, wanted)))
        description = describe(recording, positions)
        deleted = len(recording) - len(candidates(recording))
        if not as_json:
            print_facts(_facts(description, deleted))
            _print_series(recording, positions, description.steps)
    if as_json:
        print_json({**_json_of(description), "deleted": deleted})
        return
    if description.channels:
        say("")
        _print_channels(description)
    if description.attachments:
        say("")
        print_table(
            (Column("ATTACHMENT", shrink="end"), Column("TYPE"), Column("SIZE", "right")),
            [(short_ids(a["name"]), a["media_type"], bytes_of(a["size"])) for a in description.attachments],
            empty="",
        )


def _json_of(description: RecordingDescription) -> dict[str, Any]:
    from tupli_mcap.schema.times import iso_utc

    facts = {"path": description.name, **vars(description)}
    del facts["name"]
    for name, key in (("created_ns", "created_at"), ("start_ns", "started"), ("end_ns", "ended")):
        time_ns = facts.pop(name)
        facts[key] = iso_utc(time_ns) if time_ns else None
    return facts


def _runs_facts(runs: Sequence[Mapping[str, Any]]) -> list[tuple[str, str]]:
    """Several runs: `ppo-seed1 (eval, 12 episodes, lr=0.001), …`, and the settings that all of them have."""
    first, *others = [run["metadata"] for run in runs] or [{}]
    same = [key for key in first if all(key in other and other[key] == first[key] for other in others)]

    def text_of(run: Mapping[str, Any]) -> str:
        own = {key: value for key, value in run["metadata"].items() if key not in same}
        facts = [run["split"], plural(run["episodes"], "episode"), pairs_of(own)]
        return f"{run['name']} ({', '.join(filter(None, facts))})"

    settings = pairs_of({key: first[key] for key in same})
    return [("runs", _some([text_of(run) for run in runs])), ("settings", settings)]


def _facts(d: RecordingDescription, deleted: int) -> list[tuple[str, str]]:
    from tupli_mcap.recording.about.success import success_text

    states = {
        "complete": "complete",
        "recording": "a process is writing to it",
        "unfinished": "unfinished: its writer did not finish it; all steps of its chunks and its journal are shown",
        "incomplete": "incomplete: its writer did not finish it and its journal is missing; the steps of its chunks "
        "are shown",
    }
    environment = d.environment or "none attached"
    ends = ", ".join(f"{count:,} {name}" for name, count in d.ends.items() if count)
    return [
        ("recording", d.name),
        *(_run_facts(d.run) if len(d.runs) == 1 else _runs_facts(d.runs)),
        ("state", states[d.state]),
        ("uuid", d.uuid),
        ("made", f"{time_of(d.created_ns)} by {d.library}"),
        ("rollouts", _times_text(d.start_ns, d.end_ns) if d.episodes else ""),
        ("environment", f"{environment}, {d.num_envs} sub-environments" if d.num_envs > 1 else environment),
        ("benchmark", d.benchmark_id or "none"),
        ("signed by", f"{d.signed_by} (not checked)" if d.signed_by else ""),
        *_space_facts("observation", d.observation),
        *_space_facts("action", d.action),
        ("episodes", f"{d.episodes:,}{f' ({ends})' if ends else ''}"),
        ("deleted", f"{plural(deleted, 'episode')}; see tupli-mcap restore, compact" if deleted else ""),
        (
            "left out",
            f"{plural(d.left_out, 'episode')}: deleted, lost, or not chosen for this file"
            if d.left_out
            else "",
        ),
        ("steps", f"{d.steps:,}{_spread_text(d.lengths, d.episodes, ' an episode')}"),
        ("return", _spread_text(d.returns, d.episodes).removeprefix(", ")),
        ("made of", "" if d.made_of is None else _made_of_text(d.made_of)),
        ("success", "" if d.success is None else success_text(d.success, d.success_known, d.episodes)),
        ("seeds", f"{number(d.seeds)} different" if d.seeds else ""),
        ("metadata", ", ".join(d.metadata_keys)),
        ("annotated", _annotations_text(d.annotations) if d.annotations else ""),
        ("infos", _some(d.info_keys)),
        ("frames", _frames_text(d)),
        ("size", bytes_of(d.size) + (f", compressed {d.compression:.1f} : 1" if d.compression else "")),
    ]


def _times_text(start_ns: int, end_ns: int) -> str:
    start, end = time_of(start_ns), time_of(end_ns)
    return start if start == end else f"{start} to {end}"


def _annotations_text(annotations: Sequence[dict[str, Any]]) -> str:
    last = annotations[-1]
    times = "once" if len(annotations) == 1 else f"{len(annotations):,} times, last"
    return f"{times} by {last['by'] or 'somebody'}, {when(last['at'])}: {plural(last['episodes'], 'episode')}"


def _frames_text(d: RecordingDescription) -> str:
    """How many pictures the cameras have: `102 of render`."""
    from tupli_mcap.messages.topics import parse

    counts: Counter[str] = Counter()
    for channel in d.channels:
        if (topic := parse(channel.topic)) is not None and topic.kind == "camera":
            counts[topic.name] += channel.messages
    return ", ".join(f"{number(count)} of {camera}" for camera, count in counts.items())


def _space_facts(name: str, lines: Sequence[str]) -> list[tuple[str, str]]:
    first, *others = lines or ["not known before the first step"]
    return [(name, first), *(("", line) for line in others)]


def _made_of_text(made_of: dict[str, Any]) -> str:
    facts = [f"{made_of['function']!s:.200}"] if made_of.get("function") else []
    facts += [f"({made_of['query']!s:.200})"] if made_of.get("query") else []
    if isinstance(steps := made_of.get("steps"), dict):  # of a trim
        facts.append(f"to steps {_trims_text(steps)}")
    names = [
        f"{one.get('name', '')} (sha256 {one.get('sha256', '')!s:.12})" if isinstance(one, dict) else ""
        for one in made_of["sources"]
    ]
    listed = ", ".join(names[:5]) + (f" and {len(names) - 5} more" if len(names) > 5 else "")
    return f"{listed} by {made_of.get('how', '')!s:.40}{''.join(f' {fact}' for fact in facts)}"


def _trims_text(trims: dict[str, Any]) -> str:
    """Which steps of which episodes a trim kept: `10:36 of episode 0; 10:46 of episodes 1, 2`."""
    alike: dict[str, list[str]] = {}
    for episode, kept in trims.items():
        span = ":".join(map(str, kept)) if isinstance(kept, list) else str(kept)
        alike.setdefault(span[:40], []).append(f"{episode!s:.20}")
    shown = list(alike.items())[:3]
    texts = [
        f"{span} of {'episode' if len(those) == 1 else 'episodes'} {_some(those)}" for span, those in shown
    ]
    others = len(trims) - sum(len(those) for _, those in shown)
    return "; ".join([*texts, *([f"others of {number(others)} more"] if others else [])])


def _run_facts(run: dict[str, Any]) -> list[tuple[str, str]]:
    """The facts about the run that no other line shows."""
    git = run.get("git", {})
    facts = {
        "run": run.get("name", ""),
        "split": run.get("split", ""),
        "tags": ", ".join(run.get("tags", ())),
        "settings": pairs_of(run.get("metadata", {})),
        "command": " ".join(run.get("command", ())),
        "commit": f"{git.get('commit', '')!s:.12}{', with changes' if git.get('dirty') is True else ''}"
        if git
        else "",
        "host": run.get("host", ""),
        "versions": ", ".join(f"{name} {version}" for name, version in run.get("versions", {}).items()),
    }
    return list(facts.items())


def _spread_text(spread: Spread | None, episodes: int, of: str = "") -> str:
    if spread is None:
        return ""
    from tupli_mcap.recording.describe.description import nan_text

    odd = nan_text(spread.nan, episodes)
    if spread.nan == episodes:
        return f", {odd}"
    return (
        f", mean {number(spread.mean)}{of}, std {number(spread.std)}, "
        f"from {number(spread.min)} to {number(spread.max)}{f'; {odd}' if odd else ''}"
    )


def _print_channels(d: RecordingDescription) -> None:
    columns = (
        Column("CHANNEL", shrink="end"),
        Column("SCHEMA"),
        *(Column(title, "right") for title in ("MESSAGES", "SIZE", "STORED")),
    )
    rows = [(c.topic, c.schema, number(c.messages), bytes_of(c.size), bytes_of(c.stored)) for c in d.channels]
    print_table(columns, rows, empty="")


# --- series of numbers as lines of blocks ---


def sparkline(values: Sequence[float], *, zero_based: bool = False, blocks: str = BLOCKS) -> str:
    """Draws each number as one character: the larger, the higher; a space for NaN.

    zero_based: levels start at 0, which is drawn as a space; else at the smallest number.
    """
    finite = [value for value in values if math.isfinite(value)]
    if not finite:
        return ""
    low, high = (0.0 if zero_based else min(finite)), max(finite)
    line = ""
    for value in values:
        if not math.isfinite(value) or (zero_based and value <= 0):
            line += " "
        elif high > low:
            part = (value / 2 - low / 2) / (high / 2 - low / 2)  # a difference of huge numbers may overflow
            line += blocks[min(int(part * len(blocks)), len(blocks) - 1)]
        else:
            line += blocks[len(blocks) // 2]
    return line


def _print_series(recording: Recording, positions: Any, steps: int) -> None:
    """Prints returns and lengths over episodes, and distributions of rewards, actions and states."""
    from tupli_mcap.recording.describe.series import sketch

    room = (terminal_width() or _WIDEST + _OTHERS) - _OTHERS
    summary = sketch(recording, max(_NARROWEST, min(_WIDEST, room)), positions)
    if not summary.courses:
        return
    say("")
    each = max(series.each for series in summary.courses)
    order = f"FIRST TO LAST, MEANS OF UP TO {each}" if each > 1 else "FIRST TO LAST"
    _print_sparklines("EPISODES", order, summary.courses, zero_based=False)
    if summary.distributions:
        say("")
        _print_sparklines("STEPS", "LEAST TO MOST", summary.distributions, zero_based=True)
        told = "" if summary.sampled == steps else f"{number(summary.sampled)} steps sampled"
        hidden = plural(summary.hidden, "more dimension") if summary.hidden else ""
        if told or hidden:
            say(", ".join(filter(None, (hidden, told))))
        if summary.infos_hidden:
            print_wrapped(f"infos that are not shown: {_some(summary.infos_hidden)}", "", "")
        odd = [f"{number(one.odd)} of {one.name}" for one in summary.distributions if one.odd]
        if odd:
            print_wrapped(f"not finite, left out: {', '.join(odd)}", "", "")
    if summary.error:
        say(f"distributions cannot be shown: {summary.error}")


def _print_sparklines(title: str, spark: str, series: Sequence[Series], *, zero_based: bool) -> None:
    blocks = BLOCKS if can_print(BLOCKS) else PLAIN
    columns = (Column(title, shrink="end"), Column(spark), Column("LEAST", "right"), Column("MOST", "right"))
    names = [
        one.name if len(one.name) <= _LONGEST_NAME else f"{one.name[:8]}...{one.name[-13:]}" for one in series
    ]
    lines = [sparkline(one.values, zero_based=zero_based, blocks=blocks) for one in series]
    least, most = (
        numbers([None if math.isnan(end) else end for end in ends], 3)
        for ends in ([one.least for one in series], [one.most for one in series])
    )
    print_table(columns, list(zip(names, lines, least, most, strict=True)), empty="")
