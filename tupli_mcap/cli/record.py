"""The command record: records rollouts of an environment."""

from __future__ import annotations

import contextlib
import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from tupli_mcap.cli.options import Json, check_extras, check_function, load_function, pair_of
from tupli_mcap.cli.output import number, print_json
from tupli_mcap.cli.terminal import say, step_progress
from tupli_mcap.errors import TupliError, bytes_of, plural

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from tupli_mcap.wrappers.rollout import RolloutSummary


_EnvId = Annotated[
    str, typer.Argument(metavar="ENV_ID", help="The id for gymnasium.make, such as CartPole-v1.")
]
_Output = Annotated[
    str,
    typer.Option(
        "--output", "-o", metavar="FILE|DIR/", help="The new recording (.mcap), or a directory for it."
    ),
]
_Steps = Annotated[
    int | None,
    typer.Option(
        min=1,
        help="How many steps to record, in all sub-environments together (up to --num-envs minus 1 more); "
        "by default 1000 if --episodes is not given.",
    ),
]
_Episodes = Annotated[
    int | None, typer.Option(min=1, help="How many episodes to record: the rollout ends with the last one.")
]
_Seed = Annotated[int | None, typer.Option(min=0, help="Seed of the first reset and of random actions.")]
_NumEnvs = Annotated[int, typer.Option(min=1, help="How many sub-environments to step together.")]
_Policy = Annotated[
    str | None,
    typer.Option(
        metavar="MODULE:FUNCTION",
        callback=check_function,
        help="A function that maps an observation to an action; by default, actions are random.",
    ),
]
_Mode = Annotated[
    Literal["x", "w", "a"],
    typer.Option(help="If the file exists, x refuses, w replaces it, a appends to it."),
]
_Compression = Annotated[Literal["zstd", "lz4", "none"], typer.Option(help="How chunks are compressed.")]
_RecordInfo = Annotated[bool, typer.Option("--record-info", help="Also record the info dict of each step.")]
_Durability = Annotated[
    Literal["os", "chunk", "step"],
    typer.Option(
        help="When to wait for the disk, for power losses: never (os), at each chunk, or each step."
    ),
]
_Live = Annotated[
    str | None,
    typer.Option(
        metavar="VIEWER", help="Show the rollout during recording in rerun, foxglove, or the viewer at a URL."
    ),
]
_Frames = Annotated[
    bool, typer.Option("--frames", help="Also record the frames that the environment renders (rgb_array).")
]
_Every = Annotated[int, typer.Option(min=1, help="With --frames: only every n-th step.")]
_CaptureEnv = Annotated[
    Literal["spec", "pickle", "none"],
    typer.Option(help="What to store of the environment: its spec, its pickle instead (code), or none."),
]
_MaxBytes = Annotated[
    int | None, typer.Option(min=1, help="Continue in FILE_0001.mcap, … after this many bytes.")
]
_MaxSeconds = Annotated[
    float | None,
    typer.Option(min=0.001, help="Continue in a new file after this many seconds, when the episode is over."),
]

_Name = Annotated[str | None, typer.Option(metavar="NAME", help="The name of the run.")]
_Set = Annotated[
    list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help="Metadata of the run. Repeatable.")
]
_Tag = Annotated[
    list[str] | None, typer.Option("--tag", metavar="WORD", help="A tag of the run. Repeatable.")
]
_Split = Annotated[str, typer.Option("--split", metavar="WORD", help="What the run is for: train, eval, …")]
_Capture = Annotated[
    Literal["all", "versions", "none"],
    typer.Option(
        "--capture",
        help="What to store about this process: command, commit, host and versions (all), versions only, or none.",
    ),
]


def record(
    env_id: _EnvId,
    output: _Output,
    steps: _Steps = None,
    episodes: _Episodes = None,
    seed: _Seed = None,
    num_envs: _NumEnvs = 1,
    policy: _Policy = None,
    mode: _Mode = "x",
    compression: _Compression = "zstd",
    record_info: _RecordInfo = False,
    durability: _Durability = "os",
    live: _Live = None,
    frames: _Frames = False,
    every: _Every = 1,
    capture_env: _CaptureEnv = "spec",
    max_bytes: _MaxBytes = None,
    max_seconds: _MaxSeconds = None,
    name: _Name = None,
    settings: _Set = None,
    tags: _Tag = None,
    run_split: _Split = "",
    capture: _Capture = "all",
    as_json: Json = False,
) -> None:
    """Record rollouts of an environment.

    The module of a policy, or of an ENV_ID such as my_envs:Maze-v0, may be in the current
    directory. Ctrl-C ends the recording early: the file keeps all steps until then, and the
    command says how many.
    """
    if every > 1 and not frames:
        raise typer.BadParameter("--every thins out frames; give --frames too")
    if frames:  # nothing is shown on a screen: pygame must not look for one
        os.environ.setdefault("SDL_VIDEODRIVER", "dummy")
    if frames and live is not None:
        from tupli_mcap.viewer.live.target import parse_target

        kind = parse_target(live).kind
        check_extras(frames="PIL", **{kind: kind})
    from tupli_mcap.wrappers.rollout import STEPS, record_rollouts

    if ":" in env_id:
        sys.path.append("")  # last, so that a file in this directory replaces no installed module
    function = None if policy is None else load_function(policy, "policy")
    with (
        _saying_what_is_safe(Path(output), replaces=mode == "w"),
        step_progress(steps if steps or episodes else STEPS) as progress,
    ):
        summary = record_rollouts(
            env_id, output, steps=steps, episodes=episodes, seed=seed, num_envs=num_envs, policy=function, mode=mode,
            compression=compression, record_info=record_info, durability=durability, live=live,
            frames=every if frames else False, capture_env=None if capture_env == "none" else capture_env,
            max_bytes=max_bytes, max_seconds=max_seconds, name=name, metadata=dict(map(pair_of, settings or ())),
            tags=tags or (), split=run_split, capture=capture, progress=progress,
        )  # fmt: skip
    _print_rollout(summary, as_json=as_json)


def _print_rollout(summary: RolloutSummary, *, as_json: bool) -> None:
    if as_json:
        told = {**summary._asdict(), "return": summary.return_mean}
        del told["return_mean"]
        print_json(told)
        return
    last = "" if len(summary.paths) == 1 else f" to {summary.path.name}"
    facts = [
        plural(summary.episodes, "episode"),
        plural(summary.steps, "step"),
        *_mean_text(summary),
        f"{bytes_of(summary.size)} in {summary.seconds:.1f} s",
    ]
    say(f"{summary.paths[0]}{last}: {', '.join(facts)}")


@contextlib.contextmanager
def _saying_what_is_safe(output: Path, *, replaces: bool) -> Iterator[None]:
    """Makes of a KeyboardInterrupt with the files so far, as `record_rollouts` raises it, one that says how much they
    hold."""
    before = output.stat().st_ino if replaces and output.exists() else None
    try:
        yield
    except KeyboardInterrupt as err:
        held = _held([path for path in err.args if isinstance(path, Path) and path.exists()])
        if before is not None and output.exists() and output.stat().st_ino == before:
            held = f"{held}; this is the earlier file, which was not replaced"
        raise KeyboardInterrupt(held) from err


def _held(paths: Sequence[Path]) -> str:
    from tupli_mcap.recording import Recording

    episodes = steps = 0
    try:
        for path in paths:
            with Recording(path) as recording:
                episodes += len(recording)
                steps += recording.n_steps
    except TupliError as err:
        return str(err)
    if not paths:
        return "nothing was recorded"
    files = f"{paths[0]} holds" if len(paths) == 1 else f"{paths[0]} to {paths[-1].name} hold"
    return f"{files} {plural(episodes, 'episode')}, {plural(steps, 'step')}"


def _mean_text(summary: RolloutSummary) -> list[str]:
    """The mean return, and how many NaN it leaves out; empty if no episode was recorded."""
    from tupli_mcap.recording.describe.description import nan_text

    odd = nan_text(summary.return_nan, summary.episodes)
    if summary.return_nan < summary.episodes:
        return [f"mean return {number(summary.return_mean)}{f' ({odd})' if odd else ''}"]
    return [f"return {odd}"] if odd else []
