"""The methods that a recording shares with the dataset of its episodes."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Literal, cast

from tupli_mcap.arrays import Array
from tupli_mcap.errors import SaysWhatIsMeant, by_words

if TYPE_CHECKING:
    import pandas as pd
    import pyarrow as pa

    from tupli_mcap.dataset import Dataset
    from tupli_mcap.dataset.columns.load import TupleFilter
    from tupli_mcap.dataset.columns.statistics import FieldStatistics
    from tupli_mcap.dataset.columns.tables import Level
    from tupli_mcap.dataset.dataset import Test
    from tupli_mcap.dataset.items import DeltaWindows, Transitions, Unit, Windows
    from tupli_mcap.recording.episode import Episode
    from tupli_mcap.schema import BaseFilter, EpisodeHeader, F


class EpisodeViews(SaysWhatIsMeant):
    """What shows episodes, of a recording or of a dataset, and says what is meant by names that others have."""

    _elsewhere: ClassVar = by_words(
        {
            "run runs": "each episode has its run: [episode.run for episode in dataset]",
            "metadata": "each episode has its metadata: [episode.metadata for episode in dataset]",
            "success success_rate": "each episode has it, if it is known: [episode.success for episode in dataset]",
            "episodes iterate_episodes iter_episodes": "it is a sequence of them: dataset[3], for episode in dataset",
            "len num_episodes n_episodes total_episodes size": "len(dataset) counts its episodes",
            "columns features fields": "read() gives columns; headers and keys say what is known of episodes",
            "describe info summary": "stats() of the steps, to_pandas('episodes').describe() of the episodes",
            "groupby unique values": "to_pandas('episodes') has a row for each episode, such as for groupby(...)",
            "query select where filter_episodes with_episode_filter": "filter('return > 100') chooses episodes",
            "with_tuple_filter": "filter_steps('reward > 0') chooses steps",
            "best worst top": "sort('return', descending=True).head(5) has the best five episodes",
            "tail": "dataset[-5:] has the last five episodes",
            "sample_episodes": "sample(n) draws episodes",
            "shuffle": "loader(..., seed=0) shuffles; sample(n) draws episodes",
            "train_test_split": "split(0.8, seed=0) gives the training and the test episodes",
            "concat concatenate extend append": "dataset + other_dataset has the episodes of both",
            "sequences chunks segments": "windows(8) has sequences of 8 steps",
            "batches iter_batches dataloader to_torch": "loader(batch_size=256) gives batches of tensors",
            "to_numpy to_dict to_list": "read() gives arrays",
            "to_csv": "to_pandas('steps').to_csv(path) writes a row for each step",
            "to_parquet to_polars": "to_arrow() gives a table for pyarrow, Polars, DuckDB",
            "export write": "save() writes a recording, to_pandas() and to_arrow() give tables",
            "push upload": "save() it, then TupliAPIClient(url).push(path) sends the file",
            "tag": "annotate(key=value) notes something about all of its episodes",
            "restore undelete restore_episodes": "tupli_mcap.restore_episodes(path) brings deleted episodes back",
            "compact": "FileStorage(directory).compact() frees the space of deleted episodes",
            "edit edit_runs undo_edit rename": "tupli_mcap.recording has edit_runs(path, ...) and undo_edit(path)",
            "doctor check validate examine": "tupli_mcap.doctor.examine(path) finds what is wrong with the data",
            "report show render replay video": "view() shows episodes, plot() draws them; episode.video() is a film",
            "spaces": "observation_space and action_space",
            "env_id environment": "each episode's run has it: [episode.run.environment for episode in dataset]",
            "env spec make_env": (
                "recording.benchmark.make_env() rebuilds the environment; dataset.example is a recording"
            ),
        }
    )

    def view(
        self,
        episodes: str | Sequence[int] | None = None,
        *,
        save: str | os.PathLike[str] | None = None,
        **options: Any,
    ) -> Any:
        """Shows the episodes in the Rerun viewer (in a notebook: below the cell), or writes them into a `.rrd` file.

        Of more than ten episodes, it shows the last, the best and the worst one, unless `episodes` says which: "all",
        "best", "worst", "first", "last", or numbers, such as "3,7-9" of a recording. `options` are those of
        `tupli_mcap.viewer.show`, `display` and `save`.

        Raises:
            MissingExtraError: rerun-sdk is not installed.
        """
        from tupli_mcap import viewer

        return viewer.view(cast("Dataset", self), episodes, save=save, **options)

    def plot(
        self,
        *,
        episode: str | int = "best",
        episode_filter: BaseFilter | None = None,
        x: Literal["steps", "episodes", "time"] | None = None,
    ) -> Any:
        """A `tupli_mcap.plots.Report` of the episodes: returns, lengths, success, states, actions and one episode.

        A notebook shows it; `.plot().save("report.png")` writes it. Arguments are those of `tupli_mcap.plots.report`:
        `x="steps"`, "episodes" or "time" is the horizontal axis, `episode="worst"` the one whose steps are shown.

        Raises:
            MissingExtraError: matplotlib (the extra `plot`) is not installed.
        """
        from tupli_mcap import plots

        return plots.report(cast("Dataset", self), episode=episode, episode_filter=episode_filter, x=x)


class DatasetVerbs(EpisodeViews):
    """Methods of `Dataset`, where their arguments and errors are documented."""

    @property
    def dataset(self) -> Dataset:
        """Its episodes as a `Dataset`, which opens the file by its path."""
        raise NotImplementedError

    @property
    def keys(self) -> list[str]:
        """The keys that `filter`, `sort` and `split` understand."""
        return self.dataset.keys

    @property
    def headers(self) -> Sequence[EpisodeHeader]:
        """The facts about the episodes, without their steps."""
        return self.dataset.headers

    def filter(self, test: Test) -> Dataset:
        """The episodes that match a test: `recording.filter("return > 100")`."""
        return self.dataset.filter(test)

    def filter_steps(self, test: TupleFilter | F | str) -> Dataset:
        """The episodes with only the steps that match a test: `recording.filter_steps("reward > 0")`."""
        return self.dataset.filter_steps(test)

    def sort(self, key: str | Callable[[Episode], Any], *, descending: bool = False) -> Dataset:
        """The episodes in the order of a key ("return", "metadata.score") or a function."""
        return self.dataset.sort(key, descending=descending)

    def head(self, n: int = 5) -> Dataset:
        """The first `n` episodes."""
        return self.dataset.head(n)

    def sample(self, n: int, *, seed: int | None = None) -> Dataset:
        """`n` different episodes, drawn at random."""
        return self.dataset.sample(n, seed=seed)

    def split(self, fraction: float, *, seed: int = 0, by: str | None = None) -> tuple[Dataset, Dataset]:
        """Two datasets: about `fraction` of the episodes, and the others."""
        return self.dataset.split(fraction, seed=seed, by=by)

    def windows(self, length: int, **chosen: Any) -> Windows:
        """Sub-trajectories of `length` steps. `chosen`: stride, pad, history, fields."""
        return self.dataset.windows(length, **chosen)

    def delta_windows(
        self, deltas: Mapping[str, Iterable[float]], unit: Unit = "steps", **chosen: Any
    ) -> DeltaWindows:
        """The values around each step: `{"state": [-2, -1, 0], "action": range(16)}`. `chosen`: step_seconds."""
        return self.dataset.delta_windows(deltas, unit, **chosen)

    def transitions(self, n_step: int = 1, discount: float = 1.0, **chosen: Any) -> Transitions:
        """The transition (s, a, r, s') that starts at each step. `chosen`: fields."""
        return self.dataset.transitions(n_step, discount, **chosen)

    def loader(self, *, length: int | None = None, **chosen: Any) -> Any:
        """A PyTorch `DataLoader` of windows of `length` steps, or of transitions."""
        return self.dataset.loader(length=length, **chosen)

    def with_cache(self, cache_bytes: int, threads: int | None = None) -> Dataset:
        """Its dataset, with another budget for what `windows`, `transitions` and `loader` keep decoded."""
        return self.dataset.with_cache(cache_bytes, threads)

    def episode_values(self, expression: F | BaseFilter) -> Array:
        """The number of each episode at a key, such as `F("metadata.score")`: float64 (episodes,)."""
        return self.dataset.episode_values(expression)

    def stats(self, fields: Sequence[str] | None = None) -> Mapping[str, FieldStatistics]:
        """Count, mean, std, min, max and quantiles of each leaf, or info: `stats(["states", "info.force"])`; of the
        channels of an image that is named: `stats(["state.camera"])`."""
        return self.dataset.stats(fields)

    def to_pandas(self, level: Level = "steps", *, frames: bool = False) -> pd.DataFrame:
        """A table with a row for each step, or for each episode."""
        return self.dataset.to_pandas(level, frames=frames)

    def to_arrow(self, level: Level = "steps", *, frames: bool = False) -> pa.Table:
        """The same as an Arrow table."""
        return self.dataset.to_arrow(level, frames=frames)

    def save(self, target: str | os.PathLike[str], *, overwrite: bool = False) -> Path:
        """Writes the episodes to a new recording."""
        return self.dataset.save(target, overwrite=overwrite)

    def save_columns(self, directory: str | os.PathLike[str]) -> None:
        """Writes the steps to an unused directory as plain `.npy` files."""
        self.dataset.save_columns(directory)

    def map(
        self,
        function: Callable[[Episode], Any],
        target: str | os.PathLike[str],
        *,
        fields: Sequence[str] = ("rewards",),
        overwrite: bool = False,
    ) -> Path:
        """Writes the episodes to a new recording, with new rewards or actions."""
        return self.dataset.map(function, target, fields=fields, overwrite=overwrite)

    def trim(
        self,
        steps: slice | Callable[[Episode], slice],
        target: str | os.PathLike[str],
        *,
        overwrite: bool = False,
    ) -> Path:
        """Writes the episodes to a new recording, each with only some consecutive steps."""
        return self.dataset.trim(steps, target, overwrite=overwrite)

    def delete(self, *, dry_run: bool = False) -> int:
        """Deletes all episodes where they are stored; returns their number."""
        return self.dataset.delete(dry_run=dry_run)
