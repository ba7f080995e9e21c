"""`Episode` and its steps: columns are read on access, steps on iteration."""

from __future__ import annotations

import html
import os
from collections.abc import Callable, Iterator, Sequence
from functools import cached_property
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple, overload

import numpy as np

from tupli_mcap import jsonvalue
from tupli_mcap.arrays import ShortList, short_repr
from tupli_mcap.errors import RecordingError, SaysWhatIsMeant, by_words, plural
from tupli_mcap.messages.episodes import END_NAMES, EpisodeStart
from tupli_mcap.recording.about.success import success_of
from tupli_mcap.recording.columns.fields import FIVE, GymnasiumNames
from tupli_mcap.schema import F, RLTuple
from tupli_mcap.schema.models import StepNames

if TYPE_CHECKING:
    from tupli_mcap.dataset import Dataset
    from tupli_mcap.recording.about.annotations import Annotation
    from tupli_mcap.recording.about.run import Run
    from tupli_mcap.recording.columns.read import Columns
    from tupli_mcap.recording.frames import Frames
    from tupli_mcap.recording.recording import Recording
    from tupli_mcap.reexecute import Film
    from tupli_mcap.schema import EpisodeHeader


class _Step(NamedTuple):
    state: Any
    action: Any
    reward: Any
    terminal: bool
    timeout: bool
    info: dict[str, Any] | None = None


class Step(_Step, StepNames, SaysWhatIsMeant):
    """One step: `state` is the observation the action was chosen on; `info` is None where none was recorded.

    Attributes:
        env: the sub-environment that took the step, 0 for a single one; not part of the tuple.
    """

    env: int = 0
    _elsewhere: ClassVar = by_words(
        {
            "time times": "episode.times has those of all steps",
            "next_state next_observation next_obs": "episode.next_states has those of all steps",
            "frame frames image": "episode.frames has those of all steps",
        }
    )

    def __repr__(self) -> str:
        return f"Step({', '.join(f'{name}={short_repr(value)}' for name, value in self._asdict().items())})"


class Episode(GymnasiumNames):
    """One episode of a recording.

        episode = dataset[0]
        print(episode.states.shape, episode.rewards.sum(), episode.end, episode[-1].action)

    A column is an array of shape (steps, *leaf shape), or a list for a leaf of variable size, nested as the space is.
    The first access decodes the chunks that hold the episode, and keeps the columns; the caller may change them.
    Pictures among the states are decoded with `states`, all of the episode; `dataset[3:4].read(["state.joints"])` reads
    a part of the states. Not thread-safe.

    Raises:
        FormatError: on access, if a chunk of the episode is damaged.
    """

    _elsewhere: ClassVar = by_words(
        {
            **{
                name: f"a dataset has it, of one episode too: dataset[3:4].{name}()"
                for name in ("plot", "save", "stats", "to_arrow", "to_pandas", "transitions")
            },
            "total_reward score": "return_ is the sum of its rewards",
            "images pictures": "states has those in observations, frames those of a camera",
            "duration timestamps": "times has the wall clock of each step (ns)",
            "path": "recording.name is the file",
            "render replay show": "view() shows it, video() makes a film of it",
            "env_id environment": "run.environment is the id of its environment",
            "tag note": "annotate(key=value) notes something about it",
            "tags": "run.tags has those of its run, metadata what was noted about it",
        }
    )

    def __init__(self, recording: Recording, position: int) -> None:
        self._recording = recording
        self._position = position
        self._row = recording.index[position]
        self.listed: EpisodeHeader | None = None
        """The dataset's entry of this episode; its metadata follow later annotations."""
        self.alone: Callable[[], Dataset] | None = None
        """Makes a dataset of this episode only, if it comes from a dataset."""

    def __len__(self) -> int:
        return int(self._row["length"])

    @overload
    def __getitem__(self, steps: int | np.integer[Any]) -> Step: ...
    @overload
    def __getitem__(self, steps: slice) -> Columns: ...
    def __getitem__(self, steps: int | np.integer[Any] | slice) -> Step | Columns:
        """One step, or the columns (without `next_states`) of consecutive steps; only their rows are copied.

        Raises:
            IndexError: there is no such step.
            RecordingError: `steps` is neither a number nor a slice of consecutive steps.
        """
        if isinstance(steps, int | np.integer) and not isinstance(steps, bool):
            return self._step(int(steps))
        if not isinstance(steps, slice):
            columns = "; its columns are attributes: episode.rewards" * isinstance(steps, str)
            raise RecordingError(f"expected a step's number or a slice, found {steps!r:.80}{columns}")
        start, stop, stride = steps.indices(len(self))
        if stride != 1:
            raise RecordingError(
                f"expected consecutive steps, found a stride of {stride}; slice the columns instead"
            )
        return self._recording.read_steps(self._position, start, max(start, stop))

    def _step(self, number: int) -> Step:
        if not -len(self) <= number < len(self):
            raise IndexError(f"expected a step from 0 to {len(self) - 1}, found {number}")
        number %= len(self)
        infos = None if self.infos is None else self.infos[number : number + 1]
        return next(self._steps(self[number : number + 1], infos))

    def __eq__(self, other: object) -> bool:
        """Whether it is the same episode of the same recording, opened in any way."""
        return isinstance(other, Episode) and self.id == other.id

    def __hash__(self) -> int:
        return hash(self.id)

    @property
    def id(self) -> str:
        """The recording's UUID and the episode's number: the same in every storage that holds it."""
        return f"{self._recording.uuid}-{self.number}"

    @property
    def recording(self) -> Recording:
        """The recording it is in."""
        return self._recording

    @property
    def number(self) -> int:
        """The episode's number in its recording, counted from 0."""
        return int(self._row["episode"])

    @property
    def env(self) -> int:
        """The sub-environment, 0 for a single one."""
        return int(self._row["env"])

    @property
    def n_steps(self) -> int:
        """The number of its steps: `len(episode)`."""
        return len(self)

    @property
    def return_(self) -> float:
        """Sum of the rewards."""
        return float(self._row["return"])

    @property
    def end(self) -> str:
        """ "terminal", "timeout" or "interrupted"."""
        return END_NAMES[self._row["end"]]

    @property
    def start_time(self) -> int:
        """Wall clock of the reset (ns)."""
        return int(self._row["start_time"])

    @property
    def end_time(self) -> int:
        """Wall clock of the end (ns)."""
        return int(self._row["end_time"])

    @property
    def run(self) -> Run:
        """Its run."""
        return self._recording.run_of(self._position)

    @cached_property
    def metadata(self) -> dict[str, Any]:
        """The metadata: what the metadata callback last returned, with annotations applied."""
        return self._recording.episode_metadata(self._position)

    @property
    def success(self) -> bool | None:
        """Whether it succeeded: `success` or `is_success` of its metadata, if that is true, false, 0 or 1; else
        None."""
        return success_of(self.metadata)

    def annotate(self, **values: Any) -> None:
        """Adds metadata to the episode, in its file: `annotate(success=True, note="gripper slipped")`.

        Values take precedence over the metadata that were recorded; None removes a key. `undo_annotation` takes them
        back. `Dataset.annotate` does this for many episodes at once.

        Raises:
            RecordingError: as `Recording.annotate`.
        """
        self._recording.annotate_numbers([self.number], values)
        self._read_metadata_again()

    def undo_annotation(self) -> Annotation:
        """Takes the last annotation of its recording back, from all its episodes, and returns it.

        Raises:
            RecordingError: the recording has no annotation, or cannot be changed.
        """
        last = self._recording.undo_annotation()
        self._read_metadata_again()
        return last

    def _read_metadata_again(self) -> None:
        self.__dict__.pop("metadata", None)
        if self.listed is not None:
            self.listed.metadata = self.metadata

    def delete(self, *, dry_run: bool = False) -> int:
        """Deletes the episode where it is stored; returns 1, or 0 if it was deleted before. `dry_run` only returns it.
        See `Dataset.delete`.

        To delete many, `dataset.filter(function).delete()` is quicker.
        """
        alone = self._recording.filter(F("id") == self.id) if self.alone is None else self.alone()
        return alone.delete(dry_run=dry_run)

    @cached_property
    def start(self) -> EpisodeStart:
        """The `/episode_start` message."""
        return self._recording.episode_start(self._position)

    @property
    def seed(self) -> int | None:
        """The seed passed to `reset`, else the one the environment drew in an unseeded first reset, else None."""
        return self.start.seed_number

    @property
    def options(self) -> Any:
        """The options passed to `reset`."""
        return self._told("options", self.start.options) if self.start.options else None

    @property
    def reset_info(self) -> dict[str, Any]:
        """The info `reset` returned."""
        info: dict[str, Any] = self._told("reset_info", self.start.reset_info)
        return info

    def _told(self, name: str, text: str) -> Any:
        return jsonvalue.loads_at(f"{self._recording.name}: {name} of episode {self.number}", text)

    @cached_property
    def _columns(self) -> Columns:
        """Columns that were read together; pictures lie apart and may not fit into memory, so `states` adds them."""
        layout = self._recording.layout
        return self._recording.read(FIVE[1:] if layout.images else FIVE, episodes=[self._position])

    @property
    def states(self) -> Any:
        """The observation that each action was chosen on: (steps, *leaf shape), in the recorded dtypes."""
        if self._columns.states is None:
            self._columns.states = self._recording.read(["states"], episodes=[self._position]).states
        return self._columns.states

    @property
    def all_states(self) -> Any:
        """The states, followed by the final state if it is known: then (steps + 1, *leaf shape)."""
        if self._row["final_row"] < 0:
            return self.states
        layout, finals = self._recording.layout, self._recording.final_states([self._position])
        columns = [(leaf.get(self.states), leaf.get(finals)) for leaf in layout.state]
        return layout.nest_state(
            [
                states + last if isinstance(states, list) else np.concatenate([states, last])
                for states, last in columns
            ]
        )

    @property
    def actions(self) -> Any:
        """The action of each step: (steps, *leaf shape), in the recorded dtypes."""
        return self._columns.actions

    @property
    def rewards(self) -> Any:
        """The reward of each step: float64 (steps,), or in shape and dtype as the reward space says."""
        return self._columns.rewards

    @property
    def terminals(self) -> Any:
        """Whether the environment ended with the step: bool (steps,)."""
        return self._columns.terminals

    @property
    def timeouts(self) -> Any:
        """Whether the episode was truncated with the step: bool (steps,)."""
        return self._columns.timeouts

    @cached_property
    def times(self) -> Any:
        """Wall clock when each step returned: int64 (steps,), ns."""
        return self._recording.read(episodes=[self._position], fields=["times"]).times

    @cached_property
    def next_states(self) -> Any:
        """The state after each step, as `states`; after the last step, the final state, or its own state if unknown."""
        return self._recording.read(episodes=[self._position], fields=["next_states"]).next_states

    @cached_property
    def final_state(self) -> Any:
        """The observation after the last step; None if it is not known (imported episodes, for example)."""
        return self._recording.final_state(self._position)

    @property
    def final_observation(self) -> Any:
        """`final_state`."""
        return self.final_state

    @cached_property
    def infos(self) -> list[dict[str, Any] | None] | None:
        """The recorded info of each step (None for a step without one); None if the recording has no infos."""
        return self._recording.infos(self._position)

    @property
    def tuples(self) -> list[RLTuple]:
        """The steps as PyTupli's tuples; the info is empty if none was recorded."""
        return ShortList(RLTuple.from_env_step(*step[:5], step.info or {}) for step in self)

    @property
    def position(self) -> int:
        """Its index in `recording.episodes`: its number, unless episodes were removed from the recording."""
        return self._position

    def view(self, *, save: str | os.PathLike[str] | None = None, **options: Any) -> Any:
        """Shows the episode in the Rerun viewer, as `Dataset.view`."""
        from tupli_mcap import viewer

        return viewer.view(self._recording, [self.number], save=save, **options)

    def to_rerun(self, stream: Any = None) -> Any:
        """Sends the episode and a blueprint to a `rerun.RecordingStream`, by default a new one; returns the stream.

        Steps are numbered from 0, so give each episode its own stream; `tupli_mcap.viewer.send` sends several episodes
        to one stream, one after the other.

        Raises:
            MissingExtraError: rerun-sdk is not installed.
        """
        from tupli_mcap import viewer

        return viewer.send(self._recording, stream, [self.number])

    def video(
        self,
        target: str | os.PathLike[str] | None = None,
        *,
        camera: str | None = None,
        fps: float | None = None,
        every: int = 1,
        width: int | None = None,
        overwrite: bool = False,
    ) -> Film:
        """A film of recorded pictures (frames, or an image of the states), which a notebook shows; nothing is executed.

        `episode.video("best.mp4")` also writes it. See `tupli_mcap.reexecute.film` for the arguments and errors.
        """
        from tupli_mcap.reexecute import film

        return film([self], target, camera=camera, fps=fps, every=every, width=width, overwrite=overwrite)

    @cached_property
    def frames(self) -> Frames:
        """The recorded pictures of the camera "render", or else of the first one; empty if none were recorded.
        `frames.steps` says which states they show."""
        return self._recording.frames(self._position)

    def __iter__(self) -> Iterator[Step]:
        self._columns.states = self.states
        return self._steps(self._columns, self.infos)

    def _steps(self, columns: Columns, infos: Sequence[dict[str, Any] | None] | None) -> Iterator[Step]:
        layout = self._recording.layout
        state = item_getter(layout.observation_space, columns.states)
        action = item_getter(layout.action_space, columns.actions)
        reward = reward_getter(layout.reward_space, columns.rewards)
        for i in range(len(columns)):
            step = Step(
                state(i),
                action(i),
                reward(i),
                bool(columns.terminals[i]),
                bool(columns.timeouts[i]),
                None if infos is None else infos[i],
            )
            step.env = self.env
            yield step

    def __repr__(self) -> str:
        return f"<Episode {self.number}: {plural(len(self), 'step')}, return {self.return_:g}, {self.end}>"

    def _repr_html_(self) -> str:
        facts = {
            "steps": f"{len(self):,}",
            "return": f"{self.return_:g}",
            "end": self.end,
            "seed": self.seed,
            "run": self.run.name,
            "metadata": ", ".join(f"{key}: {value!r:.80}" for key, value in self.metadata.items()),
            "recording": self._recording.name,
        }
        rows = "".join(
            f"<tr><th>{key}</th><td>{html.escape(str(value))}</td></tr>" for key, value in facts.items()
        )
        return f"<p>Episode {self.number}</p><table>{rows}</table>"


def reward_getter(space: Any, column: Any) -> Any:
    """A function from a step's index to its reward: a Python number if it is a scalar."""
    if isinstance(column, np.ndarray):
        return lambda i: column[i].item() if column.ndim == 1 else column[i]
    return item_getter(space, column)


def item_getter(space: Any, columns: Any) -> Any:
    """A function from a step's index to its value, with the type of the space's own samples."""
    from gymnasium import spaces

    if type(space) is spaces.Dict:
        parts = {key: item_getter(sub, columns[key]) for key, sub in space.spaces.items()}
        return lambda i: {key: part(i) for key, part in parts.items()}
    if type(space) is spaces.Tuple:
        items = [item_getter(sub, column) for sub, column in zip(space.spaces, columns, strict=True)]
        return lambda i: tuple(item(i) for item in items)
    if type(space) is spaces.Box and space.shape == () and columns.dtype.kind == "f":
        return lambda i: np.asarray(
            columns[i]
        )  # what Gymnasium samples here is an array, of integers a scalar
    return lambda i: columns[i]


class Episodes(Sequence[Episode]):
    """The episodes of a recording, in the order of their numbers; lazy."""

    def __init__(self, recording: Recording, positions: range | None = None) -> None:
        self._recording = recording
        self._positions = range(len(recording.index)) if positions is None else positions

    def __len__(self) -> int:
        return len(self._positions)

    @overload
    def __getitem__(self, i: int | np.integer[Any]) -> Episode: ...
    @overload
    def __getitem__(self, i: slice) -> Episodes: ...
    def __getitem__(self, i: int | np.integer[Any] | slice) -> Episode | Episodes:
        if isinstance(i, slice):
            return Episodes(self._recording, self._positions[i])
        try:
            return Episode(self._recording, self._positions[i])
        except TypeError as err:
            raise RecordingError(
                f"expected an episode's number or a slice, found {i!r:.80}; recording[[4, 2]] takes a list or a mask"
            ) from err
        except IndexError as err:
            raise IndexError(f"expected an episode from 0 to {len(self) - 1}, found {i}") from err

    def __repr__(self) -> str:
        return f"<{plural(len(self), 'episode')} of {self._recording.name}>"
