"""Commands that make pictures: render (of an environment), plot (of numbers)."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from tupli_mcap.cli.options import (
    Episodes,
    FilterText,
    Force,
    Json,
    Sources,
    check_extras,
    filter_of,
    hinting,
)
from tupli_mcap.cli.output import number, print_json, print_result
from tupli_mcap.cli.terminal import fail, say, step_progress
from tupli_mcap.errors import RecordingError, bytes_of, plural
from tupli_mcap.remote import is_url

if TYPE_CHECKING:
    from tupli_mcap.recording import Episode, Recording
    from tupli_mcap.reexecute import RenderReport
    from tupli_mcap.schema import BaseFilter

_MOST_NAMES = 5


_Output = Annotated[Path, typer.Option("--output", "-o", metavar="FILE", help="A new .mcap, .mp4 or .gif.")]
_Every = Annotated[int, typer.Option(min=1, help="Only every n-th step, and the last one.")]
_Width = Annotated[int | None, typer.Option(min=1, max=1 << 14, help="Width of the frames, in pixels.")]
_Camera = Annotated[
    str | None,
    typer.Option(
        metavar="NAME",
        help="Which recorded pictures, if there are several: a camera, or an image of the states, such as wrist.",
    ),
]
_Fps = Annotated[
    float | None,
    typer.Option(
        "--fps",
        metavar="N",
        help="Recorded pictures a second, such as 50 for a loop of 50 Hz; by default, of the environment, or 30.",
    ),
]
_FrameFormat = Annotated[
    Literal["png", "jpeg"], typer.Option("--format", help="Format of the frames in a .mcap; png is exact.")
]
_Trust = Annotated[
    bool, typer.Option("--trust", help="Rebuild the environment even if that runs code from the file.")
]
_Rerun = Annotated[
    bool, typer.Option("--rerun", help="Run the episodes again, even if they were recorded with pictures.")
]


def render(
    paths: Sources,
    output: _Output,
    episodes: Episodes = "best",
    filter_text: FilterText = None,
    every: _Every = 1,
    width: _Width = None,
    camera: _Camera = None,
    fps: _Fps = None,
    frame_format: _FrameFormat = "png",
    trust: _Trust = False,
    rerun: _Rerun = False,
    force: Force = False,
    as_json: Json = False,
) -> None:
    """Make a film of episodes, or a copy with frames.

    An .mp4 or a .gif shows the pictures in the recording: frames, or an image of the states.
    Nothing is executed.

    If the recording has no pictures, or with --rerun, or for an .mcap, the environment is
    rebuilt and runs the episodes again. Every step is compared with the recording, bit for
    bit. The frames go into a copy of the recording (as /camera/render), an MP4, or a GIF.

    Of several recordings, best and worst are searched in all; other episodes have to be of one
    recording.

    Where the environment behaves differently, rendering stops: the command writes the frames
    before that step, names the difference, and exits with 1. It also exits with 1 if an
    episode cannot be run again.
    """
    check_extras(paths, **({"video": "av"} if output.suffix.lower() == ".mp4" else {"frames": "PIL"}))
    from tupli_mcap.reexecute import film, has_pictures, render

    # nothing is shown on a screen: pygame must not look for one
    os.environ.setdefault("SDL_VIDEODRIVER", "dummy")
    wanted = filter_of(filter_text)
    with (
        hinting(paths, wanted),
        _chosen(paths, "best" if episodes is None else episodes, wanted) as (recording, chosen),
        step_progress(sum(map(len, chosen)), "rendering") as progress,
    ):
        which = _which(recording, chosen)
        recorded = output.suffix.lower() != ".mcap" and not rerun
        if recorded and (camera is not None or all(map(has_pictures, chosen))):
            made = film(chosen, output, camera=camera, fps=fps, every=every, width=width, overwrite=force)
            told = {"path": output, "frames": made.pictures, "recorded": True, "ok": True}
            line = f"{output}: {plural(made.pictures, 'recorded picture')}"
            print_result(told, line, which, as_json=as_json)
            return
        if option := "--camera" if camera is not None else "--fps" if fps is not None else "":
            raise typer.BadParameter(f"{option} is for recorded pictures; leave it out to run episodes again")
        report = render(
            recording,
            output,
            episodes=chosen,
            every=every,
            width=width,
            frame_format=frame_format,
            trust=trust,
            overwrite=force,
            progress=progress,
        )
    _tell(report, which, as_json=as_json)


def _which(recording: Recording, chosen: Sequence[Episode]) -> str:
    """The recording and the numbers and returns of episodes: `run.mcap: episode 7, return 120`."""
    shown = [f"episode {one.number}, return {number(one.return_)}" for one in chosen[:_MOST_NAMES]]
    more = f"; and {len(chosen) - _MOST_NAMES} more" if len(chosen) > _MOST_NAMES else ""
    return f"{recording.name}: {'; '.join(shown)}{more}"


def _tell(report: RenderReport, which: str, *, as_json: bool) -> None:
    """Prints what was rendered; exits with 1 if not all of it could be."""
    if as_json:
        print_json(_plain(report))
    else:
        _print(report, which)
    if not report.ok:
        raise typer.Exit(1)


@contextlib.contextmanager
def _chosen(
    paths: Sequence[str], episodes: str, wanted: BaseFilter | None
) -> Iterator[tuple[Recording, list[Episode]]]:
    """The chosen episodes and their recording. RecordingError if they are of several."""
    from tupli_mcap.dataset.chosen import chosen_among

    with chosen_among(paths, episodes, wanted) as found:
        if len(found) > 1:
            names = ", ".join(Path(item.recording.name).name for item in found[:_MOST_NAMES])
            raise RecordingError(
                f"expected episodes of one recording to render, found episodes of {len(found)} "
                f"({names}{', …' if len(found) > _MOST_NAMES else ''}); give the path of one of them, or choose one "
                "episode (--episodes best), or write those you want into one file first (tupli-mcap filter)"
            )
        (item,) = found
        yield item.recording, [item.recording.episodes[at] for at in item.positions]


def _plain(report: RenderReport) -> dict[str, object]:
    divergence = report.divergence
    return {
        **report._asdict(),
        "divergence": None if divergence is None else divergence.model_dump(),
        "skipped": [skipped.model_dump() for skipped in report.skipped],
        "frames": report.frames,
        "recorded": False,
        "ok": report.ok,
    }


def _print(report: RenderReport, which: str) -> None:
    if report.path is not None:
        rendered = sum(1 for episode in report.episodes if episode.frames)
        say(
            f"{report.path}: {plural(report.frames, 'frame')} of {plural(rendered, 'episode')}, "
            f"{report.width} x {report.height}, {report.fps:.4g} a second, "
            f"{bytes_of(report.path.stat().st_size)} in {report.seconds:.1f} s"
        )
        say(which)
    if report.signature_left_out:
        say("the copy has no signature: the recording was signed without these frames")
    for skipped in report.skipped:
        fail(
            f"{plural(skipped.episodes, 'episode')} cannot be run again, the first is {skipped.first}: "
            f"{skipped.reason}"
        )
    if report.divergence is not None:
        kept = (
            "nothing was written"
            if report.path is None
            else "the one before it is kept"
            if report.frames == 1
            else f"the {number(report.frames)} before it are kept"
        )
        hint = f". {report.divergence.hint}" if report.divergence.hint else ""
        fail(f"{report.divergence}; no frames from there on, {kept}{hint}")


_Drawing = Annotated[
    Path | None,
    typer.Option(
        "--output",
        "-o",
        metavar="FILE",
        help="A .png, .svg, .pdf or .html; by default, FILE's name with .png.",
    ),
]
_Shown = Annotated[
    str,
    typer.Option(
        "--episodes",
        "--episode",
        "-e",
        metavar="WHICH",
        help="Up to four episodes whose steps are shown: numbers such as 3,7-9, or best, worst, first, last.",
    ),
]
_Axis = Annotated[
    Literal["steps", "episodes", "time"] | None,
    typer.Option(
        "--x", help="The horizontal axis; by default, episodes for one recording, steps for several."
    ),
]


def _stem_of(source: str) -> str:
    """The name of a file or a directory, or of a file at a URL without its query; `report` for a server."""
    from tupli_mcap.recording.about.run import file_name

    name = file_name(source) if is_url(source) else Path(source).resolve().name
    return Path(name).stem or "report"


def plot(
    paths: Sources,
    output: _Drawing = None,
    episode: _Shown = "best",
    x: _Axis = None,
    filter_text: FilterText = None,
    force: Force = False,
    as_json: Json = False,
) -> None:
    """Draw a report of recordings as a picture or a page.

    It shows returns, lengths, success, numbers in infos and metadata, states, actions,
    rewards, and one or more episodes step by step. Several recordings are compared. Runs whose names
    and settings differ only by their seeds are drawn as one: a thin line for each, and their
    mean with its 95% interval (percentile bootstrap) as far as all of them go. Of more than 32
    lines, those whose names differ only by numbers are one, too, or else all of an
    environment. The extension of the output sets its format; an .html needs no network.
    Nothing in a file is executed. Needs the extra `plot` (matplotlib).
    """
    check_extras(paths, plot="matplotlib")
    from tupli_mcap.plots import check_goal, report

    goal = output or Path(f"{_stem_of(paths[0]) if len(paths) == 1 else 'report'}.png")
    check_goal(goal, overwrite=force)
    with hinting(paths, wanted := filter_of(filter_text)):
        made = report(paths, episode=episode, episode_filter=wanted, x=x)
    made.save(goal, overwrite=force)
    size = goal.stat().st_size
    episodes, steps = (
        sum(counts) for counts in zip(*((len(m.rows), m.steps) for m in made.measured), strict=True)
    )
    told = {"path": goal, "size": size, "recordings": len(made.measured), "episodes": episodes}
    print_result(
        {**told, "steps": steps, "notes": made.notes},
        f"{goal}: {plural(episodes, 'episode')}, {plural(steps, 'step')}, {bytes_of(size)}",
        as_json=as_json,
    )
