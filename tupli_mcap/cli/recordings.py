"""Commands on recordings: record, ls, info, episodes."""

from __future__ import annotations

import contextlib
import os
import sys
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from tupli_mcap.cli.options import FilterText, Json, Limit, filter_of, open_storage
from tupli_mcap.cli.output import (
    Column,
    bytes_of,
    counted,
    number,
    numbers,
    print_facts,
    print_json,
    print_table,
    short_ids,
    time_of,
    when,
)
from tupli_mcap.cli.sparklines import print_sketch
from tupli_mcap.cli.terminal import fail, say, step_progress, terminal_width
from tupli_mcap.errors import TupliError

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from tupli_mcap.recording.description import RecordingDescription, Spread
    from tupli_mcap.recording.write.options import CaptureEnv
    from tupli_mcap.schema import EpisodeHeader
    from tupli_mcap.wrappers.rollout import RolloutSummary

__all__ = ["print_episodes", "register"]

_ROOMY = 100  # columns of a terminal on which metadata and times fit side by side


class _Mode(StrEnum):
    x = "x"
    w = "w"
    a = "a"


class _Durability(StrEnum):
    os = "os"
    chunk = "chunk"
    step = "step"


class _Compression(StrEnum):
    zstd = "zstd"
    lz4 = "lz4"
    none = "none"


class _CaptureEnv(StrEnum):
    spec = "spec"
    pickle = "pickle"
    none = "none"

    @property
    def argument(self) -> CaptureEnv:
        """The same for `record_rollouts`."""
        return None if self is _CaptureEnv.none else "pickle" if self is _CaptureEnv.pickle else "spec"


def register(app: typer.Typer) -> None:
    """Add the commands to the application."""
    app.command("record")(_record)
    app.command("ls")(_ls)
    app.command("info")(_info)
    app.command("episodes")(_episodes)


def _check_policy(value: str | None) -> str | None:
    if value is not None and not all(value.partition(":")[::2]):
        raise typer.BadParameter(f"expected module:function, found {value!r}")
    return value


_EnvId = Annotated[str, typer.Argument(metavar="ENV_ID", help="As gymnasium.make takes it.")]
_Output = Annotated[Path, typer.Option("--output", "-o", metavar="FILE", help="The recording (.mcap).")]
_Steps = Annotated[int, typer.Option(min=1, help="Steps to record, in total.")]
_Seed = Annotated[int | None, typer.Option(min=0, help="Of the first reset and of random actions.")]
_NumEnvs = Annotated[int, typer.Option(min=1, help="Sub-environments side by side.")]
_Policy = Annotated[
    str | None,
    typer.Option(
        metavar="MODULE:FUNCTION",
        callback=_check_policy,
        help="Called with an observation, returns an action; random without it.",
    ),
]
_ModeOption = Annotated[
    _Mode,
    typer.Option(help="If the file exists: x refuses, w replaces, a appends (and makes a missing one)."),
]
_CompressionOption = Annotated[_Compression, typer.Option(help="Of the chunks.")]
_RecordInfo = Annotated[bool, typer.Option("--record-info", help="Record the infos of steps too.")]
_DurabilityOption = Annotated[
    _Durability, typer.Option(help="What a power loss leaves: step and chunk wait for the disk.")
]
_Live = Annotated[
    str | None,
    typer.Option(metavar="VIEWER", help="Show it meanwhile: rerun, foxglove, or the URL of a viewer."),
]
_Frames = Annotated[
    bool, typer.Option("--frames", help="Record what the environment renders (rgb_array) too.")
]
_Every = Annotated[int, typer.Option(min=1, help="With --frames: of every so many steps.")]
_CaptureEnvOption = Annotated[_CaptureEnv, typer.Option(help="What the file carries of the environment.")]
_MaxBytes = Annotated[
    int | None, typer.Option(min=1, help="Go on in FILE_0001.mcap, … once so much is in a file.")
]
_MaxSeconds = Annotated[
    float | None,
    typer.Option(min=0.001, help="The same after so many seconds; a running episode stays whole."),
]


def _record(
    env_id: _EnvId,
    output: _Output,
    steps: _Steps = 1000,
    seed: _Seed = None,
    num_envs: _NumEnvs = 1,
    policy: _Policy = None,
    mode: _ModeOption = _Mode.x,
    compression: _CompressionOption = _Compression.zstd,
    record_info: _RecordInfo = False,
    durability: _DurabilityOption = _Durability.os,
    live: _Live = None,
    frames: _Frames = False,
    every: _Every = 1,
    capture_env: _CaptureEnvOption = _CaptureEnv.spec,
    max_bytes: _MaxBytes = None,
    max_seconds: _MaxSeconds = None,
    as_json: Json = False,
) -> None:
    """Record rollouts of an environment.

    Modules (of a policy, or an ENV_ID such as my_envs:Maze-v0) are looked for in the current directory too,
    after the installed ones.
    Ctrl-C ends the recording early; what was recorded stays, and how much that is is said.
    """
    if every > 1 and not frames:
        raise typer.BadParameter("--every says of how many steps frames are recorded; give --frames too")
    if frames:  # no window is opened: pygame need not look for a screen
        os.environ.setdefault("SDL_VIDEODRIVER", "dummy")
    from tupli_mcap.wrappers.rollout import load_policy, record_rollouts

    if policy is not None or ":" in env_id:
        sys.path.append("")  # last: a file that happens to lie here replaces no installed module
    function = None if policy is None else load_policy(policy)
    with (
        _saying_what_is_safe(output, max_bytes or max_seconds, replaces=mode is _Mode.w),
        step_progress(steps) as progress,
    ):
        summary = record_rollouts(
            env_id, output, steps=steps, seed=seed, num_envs=num_envs, policy=function, mode=mode.value,
            compression=compression.value, record_info=record_info, durability=durability.value, live=live,
            frames=every if frames else False, capture_env=capture_env.argument, max_bytes=max_bytes,
            max_seconds=max_seconds, progress=progress,
        )  # fmt: skip
    _print_rollout(summary, as_json=as_json)


def _print_rollout(summary: RolloutSummary, *, as_json: bool) -> None:
    if as_json:
        paths = [str(path) for path in summary.paths]
        print_json({**summary._asdict(), "path": str(summary.path), "paths": paths})
        return
    last = "" if len(summary.paths) == 1 else f" to {summary.path.name}"
    facts = [
        counted(summary.episodes, "episode"),
        counted(summary.steps, "step"),
        *_mean_text(summary),
        f"{bytes_of(summary.size)} in {summary.seconds:.1f} s",
    ]
    say(f"{summary.paths[0]}{last}: {', '.join(facts)}")


@contextlib.contextmanager
def _saying_what_is_safe(output: Path, limit: float | None, *, replaces: bool) -> Iterator[None]:
    """Adds to Ctrl-C what the recording holds by now; with a limit, the files it went on in count too."""
    before = output.stat().st_ino if replaces and output.exists() else None
    try:
        yield
    except KeyboardInterrupt as err:
        held = _held(output, limit)
        if before is not None and output.exists() and output.stat().st_ino == before:
            held = f"{held}; this is the file that was there before"
        raise KeyboardInterrupt(held) from err


def _held(output: Path, limit: float | None) -> str:
    from tupli_mcap.recording import Recording
    from tupli_mcap.recording.file_series import series

    first, others = (output, {}) if limit is None else series(output)
    paths = [path for path in (first, *others.values()) if path.exists()]
    episodes = steps = 0
    try:
        for path in paths:
            with Recording(path) as recording:
                episodes += len(recording)
                steps += recording.num_steps
    except TupliError as err:
        return str(err)
    if not paths:
        return "nothing was recorded"
    files = f"{paths[0]} holds" if len(paths) == 1 else f"{paths[0]} to {paths[-1].name} hold"
    return f"{files} {counted(episodes, 'episode')}, {counted(steps, 'step')}"


def _mean_text(summary: RolloutSummary) -> list[str]:
    """The mean return, and what it leaves out; nothing where no episode was recorded."""
    from tupli_mcap.recording.description import nan_text

    odd = nan_text(summary.return_nan, summary.episodes)
    if summary.return_nan < summary.episodes:
        return [f"mean return {number(summary.return_mean)}{f' ({odd})' if odd else ''}"]
    return [f"return {odd}"] if odd else []


def _ls(
    paths: Annotated[
        list[Path] | None,
        typer.Argument(metavar="PATH", help="Files, directories, storages; here by default.", readable=False),
    ] = None,
    as_json: Json = False,
) -> None:
    """List recordings in files and directories.

    RETURN is the mean over episodes. STATE is complete; recording, while a writer is at work; or recovered:
    its writer was killed or failed, and all steps that were finished are there, if its journal is.
    Deleted episodes of a storage are not counted.
    """
    from tupli_mcap.recording.description import nan_text
    from tupli_mcap.storage.listing import list_recordings

    found = list(list_recordings(paths or [Path()]))
    good = [item for item in found if item.error is None]
    if as_json:
        print_json([item._asdict() for item in found])
    else:
        columns = (
            Column("RECORDING", shrink="start"),
            *(Column(title, "right") for title in ("EPISODES", "STEPS", "RETURN", "SIZE")),
            Column("STATE"),
            Column("NOTE ON RETURN", shrink="end"),
        )
        means = numbers([None if r.return_nan == r.episodes else r.return_mean for r in good])
        notes = [nan_text(r.return_nan, r.episodes) for r in good]
        rows = [
            (short_ids(r.path), number(r.episodes), number(r.steps), mean, bytes_of(r.size), r.state, note)
            for r, mean, note in zip(good, means, notes, strict=True)
        ]
        if good or not found:
            print_table(columns, rows, empty="no recordings")
    bad = [item for item in found if item.error is not None]
    for item in bad:
        fail(item.error or "")
    if bad:
        raise typer.Exit(1)


def _info(
    file: Annotated[str, typer.Argument(metavar="FILE", help="A recording: a path or a URL.")],
    as_json: Json = False,
) -> None:
    """Show what is in a recording.

    Spaces, benchmark, statistics, returns and lengths of episodes, how rewards, actions and states are
    distributed, channels and attachments. Of long recordings, only some steps are read; of URLs, none.
    """
    from dataclasses import asdict

    from tupli_mcap.recording import Recording
    from tupli_mcap.recording.description import describe

    with Recording(file) as recording:
        description = describe(recording)
        if not as_json:
            print_facts(_facts(description))
            print_sketch(recording)
    if as_json:
        channels = [channel._asdict() for channel in description.channels]
        print_json({**asdict(description), "channels": channels, **_spreads(description)})
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


def _episodes(
    path: Annotated[
        Path,
        typer.Argument(metavar="FILE|STORAGE", help="A recording, or a storage's directory.", readable=False),
    ],
    filter_text: FilterText = None,
    limit: Limit = None,
    as_json: Json = False,
) -> None:
    """List episodes of a recording or a storage.

    Filters compare keys of episodes (n_tuples, end, episode_return, seed, env, ended, metadata.<name>, ...) with
    = != > >= < <= in, and join with and, or, not. Times are "2026-11-23", "2026-11-23 03:31:07", "yesterday",
    "7d ago", ...: a text means all of the time that it names.
    """
    wanted = filter_of(filter_text)
    headers: Sequence[EpisodeHeader]
    if path.is_dir():
        with open_storage(path) as storage:
            headers = storage.list_episodes(wanted, limit=limit)
    else:
        from tupli_mcap.dataset import TupliDataset

        dataset = TupliDataset.from_files(path)
        headers = (dataset if wanted is None else dataset.with_episode_filter(wanted)).preview()[:limit]
    print_episodes(headers, as_json=as_json)


def print_episodes(headers: Sequence[EpisodeHeader], *, as_json: bool) -> None:
    """Print episodes as a table or as JSON."""
    if as_json:
        print_json([header.model_dump() for header in headers])
        return
    several = len({header.recording for header in headers}) > 1
    roomy = (terminal_width() or _ROOMY) >= _ROOMY
    several_envs = any(header.env for header in headers)
    returns = numbers([header.episode_return for header in headers])
    columns = (
        *([Column("ID")] if several else [Column("EPISODE", "right")]),
        *([Column("ENV", "right")] if several_envs else []),
        Column("STEPS", "right"),
        Column("RETURN", "right"),
        Column("END"),
        Column("SEED", "right"),
        *([Column("ENDED")] if roomy else []),
        Column("METADATA", shrink="end"),
    )
    rows = []
    for header, total in zip(headers, returns, strict=True):
        rows.append(
            (
                short_ids(header.id) if several else str(header.episode),
                *([str(header.env)] if several_envs else []),
                number(header.n_tuples),
                total,
                header.end,
                "" if header.seed is None else str(header.seed),
                *([when(header.created_at)] if roomy else []),
                ", ".join(f"{key}={_short(value)}" for key, value in header.metadata.items()),
            )
        )
    print_table(columns, rows, empty="no episodes")


def _short(value: object) -> str:
    if isinstance(value, float):
        return f"{value:.4g}"
    if isinstance(value, str):
        return value
    from tupli_mcap.jsonvalue import shown

    return shown(value)


def _spreads(description: RecordingDescription) -> dict[str, dict[str, float] | None]:
    named = {"lengths": description.lengths, "returns": description.returns}
    return {name: None if spread is None else spread._asdict() for name, spread in named.items()}


def _facts(d: RecordingDescription) -> list[tuple[str, str]]:
    states = {
        "complete": "complete",
        "recording": "a writer is at work on it",
        "recovered": "recovered: its writer did not finish it, what its chunks and its journal hold is here",
    }
    environment = d.environment or "none attached"
    ends = ", ".join(f"{count:,} {name}" for name, count in d.ends.items() if count)
    return [
        ("recording", d.name),
        ("state", states[d.state]),
        ("uuid", d.uuid),
        ("made", f"{time_of(d.created_ns)} by {d.library}"),
        *([("rollouts", f"{time_of(d.start_ns)} to {time_of(d.end_ns)}")] if d.episodes else []),
        ("environment", f"{environment}, {d.num_envs} sub-environments" if d.num_envs > 1 else environment),
        ("benchmark", d.benchmark_id or "none"),
        *([("signed by", f"{d.signed_by} (not checked)")] if d.signed_by else []),
        ("observation", d.observation_space or "not known before the first step"),
        ("action", d.action_space or "not known before the first step"),
        ("episodes", f"{d.episodes:,}{f' ({ends})' if ends else ''}"),
        ("steps", f"{d.steps:,}{_spread_text(d.lengths, d.episodes, ' an episode')}"),
        *([("return", _spread_text(d.returns, d.episodes).removeprefix(", "))] if d.returns else []),
        ("size", bytes_of(d.size) + (f", compressed {d.compression:.1f} : 1" if d.compression else "")),
    ]


def _spread_text(spread: Spread | None, episodes: int, of: str = "") -> str:
    if spread is None:
        return ""
    from tupli_mcap.recording.description import nan_text

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
