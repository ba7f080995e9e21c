"""Datasets for PyTorch, in real DataLoaders with real workers, against the columns they are made of."""

from __future__ import annotations

import gc
import io
import itertools
import multiprocessing
import os
import pickle
import signal
import subprocess
import sys
import weakref
from multiprocessing.reduction import ForkingPickler
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from code_blocks import run_python
from environments import same
from gymnasium import spaces
from hypothesis import given, settings, strategies as st
from sampled import SPACES, record

import tupli_mcap
from tupli_mcap import F, FormatError, Recording, TupliDataset
from tupli_mcap.dataset import open_columns
from tupli_mcap.dataset.items import DeltaWindows, Order, Sampler, SamplingError
from tupli_mcap.recording.columns.fields import ColumnDict

torch = pytest.importorskip("torch")
from torch.utils.data import DataLoader, DistributedSampler, Subset, default_collate  # noqa: E402
from torchdata.stateful_dataloader import StatefulDataLoader  # noqa: E402

from tupli_mcap.dataset.items.shuffle import Blocks, ShuffledBatches  # noqa: E402
from tupli_mcap.torch import Episodes, MapDataset, StreamDataset, collate  # noqa: E402
from tupli_mcap.torch.packed import packed  # noqa: E402

pytestmark = pytest.mark.filterwarnings("ignore:'set_vital' is deprecated:UserWarning")  # torchdata's
GUIDE = Path(__file__).parents[2] / "docs" / "howto" / "pytorch.md"
SMALL = 20_000  # bytes: a few chunks of what `record` writes


def as_numpy(column: Any) -> Any:
    """A batch with arrays in place of tensors."""
    if isinstance(column, torch.Tensor):
        return column.numpy()
    if isinstance(column, dict):
        found = {key: as_numpy(part) for key, part in column.items()}
        return ColumnDict(found) if isinstance(column, ColumnDict) else found
    return tuple(as_numpy(part) for part in column) if isinstance(column, tuple) else column


@pytest.fixture(scope="module", params=SPACES)
def each_space(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> TupliDataset:
    directory = tmp_path_factory.mktemp(request.param)
    return TupliDataset.from_files(
        [record(directory / f"{i}.mcap", SPACES[request.param], 60 + i, seed=i) for i in range(2)]
    )


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> TupliDataset:
    """Images, whose chunks are many and small."""
    directory = tmp_path_factory.mktemp("images")
    return TupliDataset.from_files(
        [record(directory / f"{i}.mcap", SPACES["image"], 200 + i, seed=i) for i in range(3)]
    )


def all_of(batches: Any) -> list[int]:
    """The first step of each item."""
    return [step for batch in numbers(batches) for step in batch]


def numbers(batches: Any) -> list[list[int]]:
    """The first step of each item, batch by batch."""
    return [batch["steps"].tolist() for batch in batches]


def test_a_batch_is_what_the_windows_are(each_space: TupliDataset) -> None:
    windows = each_space.windows(4, pad="zero", history=1)
    found = MapDataset(windows)
    order = np.random.default_rng(0).permutation(len(windows))
    loader = DataLoader(found, batch_size=16, sampler=order.tolist(), collate_fn=collate)
    for i, batch in enumerate(loader):
        expected = windows[order[i * 16 : (i + 1) * 16]].asdict()
        assert same(as_numpy(batch), expected)
    one = found[3]
    assert same(as_numpy(one)["states"], windows[3].states)
    assert one["steps"].ndim == 0


@pytest.mark.parametrize("name", ["box", "nested", "image"])
def test_samples_of_a_batch_are_views_that_pytorch_collates(name: str, tmp_path: Path) -> None:
    windows = TupliDataset.from_files(record(tmp_path / "a.mcap", SPACES[name], 50)).windows(3)
    samples = MapDataset(windows).__getitems__([4, 2, 9])
    batch = collate(samples)
    assert batch["rewards"] is samples.batch["rewards"]
    assert samples[1]["rewards"].data_ptr() == batch["rewards"][1].data_ptr()
    collated = default_collate(samples)
    assert torch.equal(collated["rewards"], batch["rewards"])
    assert [sample["steps"].item() for sample in samples] == batch["steps"].tolist()


@pytest.mark.parametrize("num_workers", [0, 2])
def test_a_loader_takes_items_as_they_are(num_workers: int, tmp_path: Path) -> None:
    dataset = TupliDataset.from_files(record(tmp_path / "a.mcap", SPACES["box"], 50))
    for items in (dataset.windows(3), dataset.transitions(), dataset.delta_windows({"state": [-1, 0]})):
        for collate_fn in (None, collate):
            loader = DataLoader(items, batch_size=16, num_workers=num_workers, collate_fn=collate_fn)
            for i, batch in enumerate(loader):
                assert same(as_numpy(batch), items[i * 16 : (i + 1) * 16].asdict())


def test_numbers_of_a_batch_count_from_the_end_too(tmp_path: Path) -> None:
    dataset = TupliDataset.from_files(record(tmp_path / "a.mcap", SPACES["box"], 50))
    for items in (dataset.windows(3, 3), dataset.windows(3, pad="repeat"), dataset.transitions()):
        (batch,) = DataLoader(Subset(items, [-1, 2, -2]), batch_size=3)
        assert same(as_numpy(batch), items[[-1, 2, -2]].asdict())
        with pytest.raises(IndexError, match=f"expected numbers from 0 to {len(items) - 1}, found 1000"):
            next(iter(DataLoader(Subset(items, [1000]))))


def test_tensors_keep_the_dtypes_that_were_recorded(tmp_path: Path) -> None:
    dtypes = (
        np.uint8,
        np.uint16,
        np.uint32,
        np.uint64,
        np.int8,
        np.int64,
        np.float16,
        np.float32,
        np.float64,
    )
    space = spaces.Dict({np.dtype(kind).name: spaces.Box(0, 3, (2,), kind) for kind in dtypes})
    windows = TupliDataset.from_files(record(tmp_path / "a.mcap", space, 30)).windows(3)
    batch = next(iter(DataLoader(MapDataset(windows), batch_size=5, collate_fn=collate, num_workers=1)))
    assert {key: str(part.dtype) for key, part in batch["states"].items()} == {
        np.dtype(kind).name: f"torch.{np.dtype(kind).name}" for kind in dtypes
    }
    assert same(as_numpy(batch["states"]), windows[:5].states)
    assert batch["terminals"].dtype == torch.bool


def test_items_one_by_one_from_a_worker(each_space: TupliDataset) -> None:
    windows = each_space.windows(3)
    loader = DataLoader(MapDataset(windows), batch_size=None, num_workers=1, collate_fn=collate)
    for one, expected in zip(itertools.islice(loader, 5), windows, strict=False):
        assert same(as_numpy(one)["states"], expected.states)
        assert one["steps"].item() == expected.steps


def test_episodes_are_filled_up_to_the_longest(tmp_path: Path) -> None:
    dataset = TupliDataset.from_files(record(tmp_path / "a.mcap", SPACES["text"], 24, length=10))
    episodes = Episodes(dataset.steps)
    assert [len(episodes[i].mask) for i in range(len(episodes))] == [10, 10, 4]
    batch = collate(MapDataset(episodes).__getitems__([2, 0]))
    assert batch["mask"].sum(1).tolist() == [4, 10]
    assert torch.equal(batch["rewards"][0, :4], torch.from_numpy(episodes[2].rewards))
    assert (batch["rewards"][0, 4:] == 0).all()
    assert batch["states"]["word"] == [[*episodes[2].states["word"], *[None] * 6], episodes[0].states["word"]]


# ---- order


@settings(max_examples=80)
@given(
    st.lists(st.integers(1, 9), min_size=1, max_size=30),
    st.integers(1, 12),
    st.integers(1, 4),
    st.integers(1, 4),
    st.integers(2, 5),
    st.booleans(),
)
def test_each_item_is_in_one_batch_of_one_rank(
    sizes: list[int], size: int, ranks: int, streams: int, mix: int, drop_last: bool
) -> None:
    ends = np.cumsum(sizes)
    blocks = Blocks(ends - sizes, ends, np.arange(len(sizes) + 1))
    total = int(ends[-1])
    options: dict[str, Any] = {"drop_last": drop_last, "ranks": ranks, "streams": streams}
    parts = [ShuffledBatches(blocks, total, size, [7], mix, rank=rank, **options) for rank in range(ranks)]
    batches = [[part[i] for i in range(len(part))] for part in parts]
    seen = [int(item) for part in batches for batch in part for item in batch]
    if drop_last:
        assert {len(part) for part in batches} == {total // ranks // size}
        assert all(len(batch) == size for part in batches for batch in part)
        assert len(seen) == len(set(seen))
    else:
        assert sorted(seen) == list(range(total))
        assert all(len(batch) == size for part in batches for batch in part[:-1])
    again = ShuffledBatches(blocks, total, size, [7], mix, **options)
    for i in reversed(range(len(again))):
        assert again[i].tolist() == batches[0][i].tolist()


def test_a_shuffle_mixes_chunks_and_reads_each_about_once(dataset: TupliDataset) -> None:
    items = dataset.windows(2)
    stream = StreamDataset(items, 16, seed=0, worker_cache_bytes=1 << 16)
    steps = all_of(stream)
    assert sorted(steps) == sorted(items[:].steps.tolist())
    chunks = dataset.steps.blocks(np.array(steps))
    last = {int(chunk): i for i, chunk in enumerate(chunks)}
    first = {int(chunk): len(chunks) - 1 - i for i, chunk in enumerate(chunks[::-1])}
    spread = np.mean([last[chunk] - first[chunk] for chunk in first])
    assert 16 < spread < len(steps) / 2  # of a chunk's items: over several batches, but not over the epoch
    assert np.abs(np.diff(steps)).mean() > len(steps) / 10
    other = StreamDataset(items, 16, seed=1, worker_cache_bytes=1 << 16)
    assert numbers(other) != numbers(stream) == numbers(stream)
    stream.set_epoch(1)
    assert numbers(stream) != numbers(other)


def test_a_batch_comes_from_a_worker_in_one_piece(each_space: TupliDataset) -> None:
    windows = each_space.windows(4, pad="zero")
    loader = DataLoader(StreamDataset(windows, 7, shuffle=False), None, num_workers=1, collate_fn=collate)
    for i, batch in enumerate(loader):
        assert type(batch) is ColumnDict
        assert same(as_numpy(batch), windows[i * 7 : i * 7 + 7].asdict())
        assert batch["rewards"].untyped_storage().data_ptr() == batch["mask"].untyped_storage().data_ptr()


def test_packing_lets_go_of_the_arrays() -> None:
    array = np.zeros(10)
    there = weakref.ref(array)
    gc.disable()
    try:
        batch = packed({"a": array, "b": {"c": (array, ["text"])}})
        del array
        assert there() is None
    finally:
        gc.enable()
    assert batch["b"]["c"][1] == ["text"]


@pytest.mark.parametrize("num_workers", [0, 1])
@pytest.mark.parametrize("length", [None, 3])
def test_a_batch_is_found_by_gymnasiums_names(num_workers: int, length: int | None, tmp_path: Path) -> None:
    dataset = tupli_mcap.open(record(tmp_path / "a.mcap", SPACES["box"], 50))
    fields = ["observations", "truncations"]
    batch = next(iter(dataset.loader(length=length, batch_size=4, num_workers=num_workers, fields=fields)))
    assert batch["observations"] is batch["states"] is batch.get("observations")
    assert batch["truncations"] is batch["timeouts"]
    assert "observations" in batch and "observations" not in list(batch)
    assert "rewards" not in batch and batch.get("rewards") is None
    for name, meant in (("obs", r" \(did you mean 'states'\?\)"), ("rewards", "")):
        with pytest.raises(KeyError, match=f"expected one of .*states.*, found '{name}'{meant}"):
            batch[name]
    copied = pickle.loads(pickle.dumps(batch))
    assert torch.equal(copied["observations"], batch["states"])
    sample = MapDataset(dataset.windows(3))[0]
    assert sample["observations"] is sample["states"]
    assert default_collate([sample, sample])["observations"].shape[0] == 2


def doubled(samples: Any) -> Any:
    """A collate function that changes the batch, also deep inside."""
    batch = collate(samples)
    batch["states"]["speed"] = batch["states"]["speed"].double() * 2
    batch["rewards"] *= 2
    return batch


def test_what_a_collate_function_changes_in_a_worker_arrives(dataset: TupliDataset) -> None:
    windows = dataset.windows(2)
    batch = next(iter(DataLoader(MapDataset(windows), 5, num_workers=1, collate_fn=doubled)))
    assert torch.equal(batch["states"]["speed"], torch.from_numpy(windows[:5].states["speed"]).double() * 2)
    assert torch.equal(batch["rewards"], torch.from_numpy(windows[:5].rewards) * 2)


@pytest.mark.parametrize("loaded", [False, True])
def test_a_worker_keeps_to_its_own_budget(tmp_path: Path, loaded: bool) -> None:
    dataset = TupliDataset.from_files(record(tmp_path / "a.mcap", SPACES["image"], 100))
    if loaded:
        _ = dataset.rewards
    stream = StreamDataset(dataset.windows(2), 16, worker_cache_bytes=SMALL)

    def told(batch: Any) -> int:
        steps: Any = dataset.steps
        recorded: Any = steps._rest if loaded else steps
        return int(recorded.cache_bytes)

    forked = DataLoader(stream, None, num_workers=1, collate_fn=told, multiprocessing_context="fork")
    in_worker = list(forked)
    assert set(in_worker) == {SMALL}
    assert told(None) > SMALL


def test_a_seed_of_none_draws_from_pytorch(dataset: TupliDataset) -> None:
    stream = StreamDataset(dataset.windows(2), 16, worker_cache_bytes=SMALL)
    torch.manual_seed(3)
    first, second = numbers(stream), numbers(stream)
    assert first != second
    torch.manual_seed(3)
    assert numbers(stream) == first


@pytest.mark.sampled(0, keep=["spawn"])
@pytest.mark.parametrize("start", ["fork", "spawn", "forkserver"])
def test_workers_of_every_kind(dataset: TupliDataset, start: str) -> None:
    windows = dataset.windows(2, fields=["states", "rewards"])
    expected = dict(zip(windows[:].steps.tolist(), windows[:].states["eye"], strict=True))
    stream = StreamDataset(windows, 32, seed=0, streams=2, worker_cache_bytes=SMALL)
    loader = DataLoader(
        stream,
        None,
        num_workers=2,
        multiprocessing_context=start,
        persistent_workers=True,
        collate_fn=collate,
    )
    for epoch in range(2):
        stream.set_epoch(epoch)
        found = list(loader)
        assert numbers(found) == numbers(stream)  # `streams` makes it the order without workers
        for batch in found:
            for step, eye in zip(batch["steps"].tolist(), batch["states"]["eye"].numpy(), strict=True):
                assert same(eye, expected[step])


@pytest.mark.parametrize("workers", [0, 2])
def test_items_by_number_in_workers(dataset: TupliDataset, workers: int) -> None:
    windows = dataset.windows(2, stride=2)
    mapped = pickle.loads(pickle.dumps(MapDataset(windows, worker_cache_bytes=SMALL)))
    sampler = DistributedSampler(mapped, num_replicas=2, rank=1, seed=5)
    loader = DataLoader(mapped, 50, sampler=sampler, num_workers=workers, collate_fn=collate)
    found = {
        step: eye
        for batch in loader
        for step, eye in zip(batch["steps"].tolist(), batch["states"]["eye"], strict=True)
    }
    expected = windows[list(sampler)]
    assert sorted(found) == sorted(expected.steps.tolist())
    for step, eye in zip(expected.steps.tolist(), expected.states["eye"], strict=True):
        assert same(found[step].numpy(), eye)


@pytest.mark.parametrize("workers", [1, 2])
def test_each_item_comes_from_one_worker(dataset: TupliDataset, workers: int) -> None:
    stream = StreamDataset(dataset.windows(2), 32, worker_cache_bytes=SMALL)
    loader = DataLoader(stream, batch_size=None, num_workers=workers, collate_fn=collate)
    first, second = all_of(loader), all_of(loader)
    assert first != second
    assert sorted(first) == sorted(second) == dataset.windows(2)[:].steps.tolist()


def test_without_a_shuffle_workers_do_not_matter(dataset: TupliDataset) -> None:
    windows = dataset.windows(2)
    stream = StreamDataset(windows, 32, shuffle=False)
    loader = DataLoader(stream, batch_size=None, num_workers=2, collate_fn=collate)
    assert all_of(loader) == all_of(stream) == windows[:].steps.tolist()


def test_transitions_with_several_steps(dataset: TupliDataset) -> None:
    items = dataset.transitions(3, 0.9)
    batches = list(DataLoader(StreamDataset(items, 50, seed=0), None, collate_fn=collate))
    for batch in batches:
        assert same(as_numpy(batch), items[batch["steps"].numpy()].asdict())
    assert sorted(all_of(batches)) == list(range(len(items)))


def test_deltas_are_nested(dataset: TupliDataset) -> None:
    items = DeltaWindows(dataset.steps, {"state": [-1, 0], "action": range(3)})
    batch = next(iter(DataLoader(MapDataset(items), 8, num_workers=1, collate_fn=collate)))
    assert [*batch] == ["values", "masks", "steps", "episodes"]
    assert same(as_numpy(batch), items[:8].asdict())


# ---- resuming


def stream_of(dataset: TupliDataset, seed: int | None) -> StreamDataset:
    return StreamDataset(dataset.windows(2), 32, seed=seed, worker_cache_bytes=SMALL)


def resumable(stream: StreamDataset, workers: int) -> Any:
    return StatefulDataLoader(stream, batch_size=None, num_workers=workers, collate_fn=collate)


@pytest.mark.sampled(2)
@pytest.mark.parametrize("workers", [0, 2])
@pytest.mark.parametrize("seed", [None, 0])
@settings(max_examples=4)
@given(data=st.data())
def test_a_resumed_run_goes_on_with_the_next_batch(
    dataset: TupliDataset, workers: int, seed: int | None, data: st.DataObject
) -> None:
    stream = stream_of(dataset, seed)
    stream.set_epoch(2)
    stop = data.draw(st.integers(1, len(stream)))
    loader = resumable(stream, workers)
    shown: list[list[int]] = []
    state: bytes = b""
    for batch in loader:
        shown.append(batch["steps"].tolist())
        if len(shown) == stop:
            state = pickle.dumps(loader.state_dict())
    resumed = resumable(stream_of(dataset, seed), workers)
    resumed.load_state_dict(pickle.loads(state))
    assert numbers(resumed) == shown[stop:]
    following = all_of(resumed)
    assert sorted(following) == sorted(dataset.windows(2)[:].steps.tolist())


@pytest.mark.parametrize("workers", [0, 2])
def test_a_shuffled_map_resumes(dataset: TupliDataset, workers: int) -> None:
    windows = dataset.windows(2)

    def loader() -> Any:
        return StatefulDataLoader(
            MapDataset(windows), batch_size=64, shuffle=True, num_workers=workers, collate_fn=collate
        )

    torch.manual_seed(0)
    first = loader()
    batches = iter(first)
    for _ in range(3):
        next(batches)
    state = first.state_dict()
    rest = numbers(batches)
    resumed = loader()
    resumed.load_state_dict(state)
    assert numbers(resumed) == rest != []


@pytest.mark.parametrize("workers", [0, 2])
@pytest.mark.parametrize("kind", ["exact", "blocks", "weights"])
def test_orders_and_samplers_resume(dataset: TupliDataset, workers: int, kind: Any) -> None:
    windows = dataset.windows(2)

    def loader() -> Any:
        numbers: Any = Order(windows, 64, shuffle=kind, seed=4) if kind != "weights" else None
        if numbers is None:
            numbers = Sampler(windows, 64, weights=np.arange(len(windows)), seed=4)
        return StatefulDataLoader(
            MapDataset(windows), batch_sampler=numbers, num_workers=workers, collate_fn=collate
        )

    first = loader()
    batches = iter(first)
    for _ in range(3):
        next(batches)
    checkpoint = io.BytesIO()
    torch.save(first.state_dict(), checkpoint)
    checkpoint.seek(0)
    state = torch.load(checkpoint)  # with weights_only, as by default
    rest = numbers(itertools.islice(batches, 4))
    resumed = loader()
    resumed.load_state_dict(state)
    assert numbers(itertools.islice(resumed, 4)) == rest != []


def test_state_dicts_without_a_loader(dataset: TupliDataset) -> None:
    stream = stream_of(dataset, 0)
    batches = iter(stream)
    for _ in range(4):
        next(batches)
    state = stream.state_dict()
    resumed = stream_of(dataset, 0)
    resumed.load_state_dict(state)
    assert numbers(resumed) == numbers(batches) != []
    assert numbers(resumed) == numbers(stream)  # the next epoch, from its beginning


@pytest.mark.parametrize("workers", [0, 1])
@pytest.mark.parametrize("kind", [StreamDataset, MapDataset])
def test_a_state_dict_of_another_dataset_is_refused(dataset: TupliDataset, workers: int, kind: Any) -> None:
    def loader(items: Any) -> Any:
        if kind is StreamDataset:
            return StatefulDataLoader(StreamDataset(items, 32), None, num_workers=workers)
        return StatefulDataLoader(MapDataset(items), 32, num_workers=workers, collate_fn=collate)

    first = loader(dataset.windows(2))
    next(iter(first))
    other = loader(dataset.with_episode_filter(F("n_tuples") > 5).windows(2))
    other.load_state_dict(first.state_dict())
    with pytest.raises(
        SamplingError, match="expected a state dict of the same items, found one of other episodes"
    ):
        next(iter(other))


def test_state_dicts_of_other_options_are_refused(dataset: TupliDataset, tmp_path: Path) -> None:
    state = stream_of(dataset, 0).state_dict()
    windows = dataset.windows(2)
    with pytest.raises(SamplingError, match="expected a state dict with batch_size=8, found 32"):
        StreamDataset(windows, 8, worker_cache_bytes=SMALL).load_state_dict(state)
    with pytest.raises(SamplingError, match="expected a state dict with ranks=2, found 1"):
        StreamDataset(windows, 32, seed=0, rank=0, ranks=2, worker_cache_bytes=SMALL).load_state_dict(state)
    with pytest.raises(SamplingError, match="expected a state dict with the keys items"):
        stream_of(dataset, 0).load_state_dict({"step": 3})
    dataset.save_columns(tmp_path / "columns")
    with pytest.raises(SamplingError, match="expected a state dict with (mix|chunks)="):
        stream_of(open_columns(tmp_path / "columns"), 0).load_state_dict(state)
    with pytest.raises(SamplingError, match="expected workers, key and batches in a state dict"):
        stream_of(dataset, 0).load_state_dict({name: part for name, part in state.items() if name != "key"})
    for key in ("x", {}, []):
        with pytest.raises(
            SamplingError, match="expected a list of numbers as the key of a state dict, found"
        ):
            stream_of(dataset, 0).load_state_dict({**state, "key": key})
    with pytest.raises(SamplingError, match="a key of numbers that is an integer from 0, found -1"):
        stream_of(dataset, 0).load_state_dict({**state, "key": [0, -1]})
    other = stream_of(dataset, 0)
    other.load_state_dict({**state, "batches": 10_000})
    with pytest.raises(
        SamplingError, match=r"expected a state dict after at most \d+ batches of a worker, found 10"
    ):
        next(iter(other))
    other = stream_of(dataset, 0)
    other.load_state_dict({**state, "workers": 2})
    with pytest.raises(SamplingError, match="of a run with 1 workers.*, found 2"):
        next(iter(other))


# ---- ranks


def shared(rank: int, meeting: Path, files: list[Path], told: Any) -> None:
    """Sends the sum of the rewards over both ranks, and the steps of a rank in two loaders."""
    torch.distributed.init_process_group("gloo", init_method=f"file://{meeting}", rank=rank, world_size=2)
    items = TupliDataset.from_files(files).transitions(fields=["rewards"])
    mapped, stream = MapDataset(items), StreamDataset(items, 16, seed=0)
    loaders = [
        DataLoader(mapped, 16, sampler=DistributedSampler(mapped, seed=1), collate_fn=collate),
        DataLoader(stream, None, num_workers=1, collate_fn=collate, multiprocessing_context="fork"),
    ]
    total = torch.zeros(())
    for batch in loaders[0]:
        total += batch["rewards"].sum()
    torch.distributed.all_reduce(total)
    told.send((total.item(), *(all_of(loader) for loader in loaders)))
    torch.distributed.destroy_process_group()


def test_two_ranks_share_an_epoch(tmp_path: Path) -> None:
    files = [record(tmp_path / f"{i}.mcap", SPACES["box"], 80) for i in range(2)]
    context = multiprocessing.get_context("fork")
    ends = [context.Pipe(duplex=False) for _ in range(2)]
    ranks = [
        context.Process(target=shared, args=(rank, tmp_path / "meeting", files, told))
        for rank, (_, told) in enumerate(ends)
    ]
    for rank in ranks:
        rank.start()
    assert all(heard.poll(200) for heard, _ in ends)
    told = [heard.recv() for heard, _ in ends]
    for rank in ranks:
        rank.join(200)
        assert rank.exitcode == 0
    rewards = TupliDataset.from_files(files).rewards
    assert told[0][0] == told[1][0] == pytest.approx(rewards.sum())
    for loader in (1, 2):
        assert sorted(told[0][loader] + told[1][loader]) == list(range(160))


# ---- what goes wrong


def test_a_worker_that_is_killed_is_told(tmp_path: Path) -> None:
    seen = []

    def last(batch: Any) -> Any:
        """Kills the worker where it holds no lock: one that PyTorch's own DataLoader shares with its workers would
        never be let go of, and the DataLoader would wait for it for ever."""
        seen.append(batch)
        if len(seen) == 3:
            os.kill(os.getpid(), signal.SIGKILL)
        return collate(batch)

    path = record(tmp_path / "a.mcap", SPACES["box"], 400)
    stream = StreamDataset(TupliDataset.from_files(path).windows(2), 8, seed=0)
    loader = DataLoader(stream, None, num_workers=1, collate_fn=last, multiprocessing_context="fork")
    with pytest.raises(
        RuntimeError, match=r"DataLoader worker \(pid.*(is killed by signal: Killed\.|exited unexpectedly)"
    ):
        list(loader)
    assert not seen  # here


def test_a_worker_that_dies_while_a_batch_is_handed_over() -> None:
    ours, theirs = multiprocessing.Pipe()

    def worker() -> None:
        theirs.send_bytes(ForkingPickler.dumps(packed({"states": np.zeros(3)})))
        ours.poll(60)  # until it is killed
        os._exit(1)

    process = multiprocessing.get_context("fork").Process(target=worker)
    process.start()
    assert ours.poll(60)
    batch = ours.recv_bytes()
    process.kill()
    process.join()
    with pytest.raises(
        RuntimeError, match="a worker of the DataLoader has died while it handed over a batch"
    ):
        pickle.loads(batch)


def test_a_damaged_file_is_told_by_workers(tmp_path: Path) -> None:
    path = record(tmp_path / "a.mcap", SPACES["box"], 400)
    stream = StreamDataset(TupliDataset.from_files(path).windows(2), 32, seed=0)
    damaged = bytearray(path.read_bytes())
    start = int(Recording(path).stored.store.table["offset"][0])
    damaged[start + 60] ^= 255
    path.write_bytes(damaged)
    loader = DataLoader(stream, batch_size=None, num_workers=1, collate_fn=collate)
    with pytest.raises(FormatError, match=r"a\.mcap: chunk at offset"):
        list(loader)


def test_numbers_that_mean_nothing(dataset: TupliDataset) -> None:
    windows = dataset.windows(2)
    with pytest.raises(SamplingError, match="expected a batch size that is an integer from 1, found 0"):
        StreamDataset(windows, 0)
    for kind in (MapDataset, lambda items: StreamDataset(items, 4)):
        with pytest.raises(SamplingError, match=r"expected items such as dataset\.windows\(32\), found "):
            kind(dataset)
    with pytest.raises(
        SamplingError, match="expected a budget of workers in bytes that is an integer from 0"
    ):
        MapDataset(windows, worker_cache_bytes=-1)
    with pytest.raises(TypeError, match="cannot be interpreted as an integer"):
        MapDataset(windows)[0.5]
    with pytest.raises(SamplingError, match=r"in one dimension, found array\(\[0.5\]\)"):
        MapDataset(windows).__getitems__([0.5])
    with pytest.raises(
        SamplingError, match="expected at least 2000000 items for one full batch in each rank"
    ):
        StreamDataset(windows, 1_000_000, seed=0, drop_last=True, rank=0, ranks=2)
    with pytest.raises(SamplingError, match="expected at least one item for each of 10000000 ranks, found"):
        StreamDataset(windows, 1, seed=0, rank=0, ranks=10_000_000)
    with pytest.raises(SamplingError, match="expected rank and ranks, or neither of them, found rank=1"):
        StreamDataset(windows, 4, seed=0, rank=1)
    with pytest.raises(SamplingError, match="expected a rank from 0 to 1, found 2"):
        StreamDataset(windows, 4, seed=0, rank=2, ranks=2)
    with pytest.raises(SamplingError, match="expected a seed, which all ranks share, found None"):
        StreamDataset(windows, 4, rank=1, ranks=2)
    with pytest.raises(SamplingError, match="a number of workers that divides streams=3, found 2"):
        list(DataLoader(StreamDataset(windows, 4, streams=3), None, num_workers=2))
    with pytest.raises(
        SamplingError, match="expected a number of an epoch that is an integer from 0, found -1"
    ):
        stream_of(dataset, 0).set_epoch(-1)
    empty = dataset.with_episode_filter(F("n_tuples") > 1000)
    with pytest.raises(SamplingError, match="expected at least one step, found an empty dataset"):
        MapDataset(Episodes(empty.steps))


def test_without_pytorch_the_extra_is_named() -> None:
    code = "import sys; sys.modules['torch'] = None\nimport tupli_mcap.torch"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert "MissingExtraError: tupli_mcap.torch needs PyTorch" in done.stderr
    assert "[torch]" in done.stderr


@pytest.mark.filterwarnings("ignore:'pin_memory' argument is set as true but no accelerator:UserWarning")
def test_batches_go_through_the_pinning_thread(dataset: TupliDataset) -> None:
    stream = stream_of(dataset, 0)
    loader = DataLoader(stream, None, num_workers=1, collate_fn=collate, pin_memory=True)
    assert numbers(loader) == numbers(stream)


# ---- training


def test_the_documented_policy_learns(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    names = run_python(GUIDE.read_text(encoding="utf-8").replace("{code-cell} ", ""))
    assert len(names["rest"]) == len(names["stream"]) - 1
    assert names["batch"]["next", "reward"].shape == (32, 1)
    policy, test = names["policy"], gym.make("CartPole-v1")
    state, _ = test.reset(seed=1)
    steps, over = 0, False
    while not over:
        action = int(policy(torch.from_numpy(state)).argmax())
        state, _, terminal, timeout, _ = test.step(action)
        steps, over = steps + 1, terminal or timeout
    assert steps > 150  # at random, about 20
