"""Samplers and orders: what they draw, that it can be repeated, and that it goes on where it was."""

from __future__ import annotations

import itertools
import json
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from gymnasium import spaces

from tupli_mcap import F, TupliDataset
from tupli_mcap.dataset.items import Batches, Order, Sampler, SamplingError, Transitions
from tupli_mcap.errors import FilterError
from tupli_mcap.recording import EpisodeData, write_recording

LENGTHS = [2, 40, 3, 5, 50]


def write(path: Path, lengths: list[int], scores: list[Any]) -> Path:
    def episode(number: int, length: int) -> EpisodeData:
        rows = range(length)
        states = [np.array([number, i], np.float32) for i in rows]
        over = [i == length - 1 for i in rows]
        return EpisodeData(
            states, [0] * length, [1.0] * length, over, [False] * length, states[0],
            metadata={"score": scores[number], "nested": {"v1.0": 2}},
        )  # fmt: skip

    write_recording(
        path,
        (episode(i, length) for i, length in enumerate(lengths)),
        observation_space=spaces.Box(-1e6, 1e6, (2,)),
        action_space=spaces.Discrete(2),
    )
    return path


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> TupliDataset:
    return TupliDataset.from_files(write(tmp_path_factory.mktemp("one") / "r.mcap", LENGTHS, [0, 1, 2, 3, 4]))


def episodes_drawn(items: Any, sampler: Sampler, batches: int = 40) -> Counter[int]:
    return Counter(int(e) for _ in range(batches) for e in items[next(sampler)].episodes)


def close(found: Counter[int], shares: list[float]) -> bool:
    """Whether counts are in proportion, within five standard deviations."""
    total, expected = found.total(), np.array(shares) / sum(shares)
    counts = np.array([found[i] for i in range(len(shares))])
    return bool((np.abs(counts - total * expected) <= 5 * np.sqrt(total * expected) + 1e-9).all())


def test_steps_alike_and_episodes_alike(dataset: TupliDataset) -> None:
    transitions = dataset.transitions()
    assert close(episodes_drawn(transitions, transitions.sampler(64, seed=1)), LENGTHS)
    assert close(episodes_drawn(transitions, transitions.sampler(64, by="episodes", seed=1)), [1] * 5)
    windows = dataset.windows(5)  # two of the episodes are too short for any
    assert close(episodes_drawn(windows, windows.sampler(64, by="episodes", seed=1)), [0, 1, 0, 1, 1])
    assert windows.counts().tolist() == [0, 36, 0, 1, 46]


def test_weights_of_items_of_episodes_and_by_expression(dataset: TupliDataset) -> None:
    transitions, windows = dataset.transitions(), dataset.windows(5)
    weights = np.zeros(100)
    weights[[3, 99]] = 1, 3
    drawn = Counter(transitions.sampler(2000, weights=weights, seed=0).draw(0).tolist())
    assert set(drawn) == {3, 99} and 2.5 < drawn[99] / drawn[3] < 3.5
    assert close(
        episodes_drawn(windows, windows.sampler(64, by="episodes", weights=[9, 1, 9, 2, 3], seed=0)),
        [0, 1, 0, 2, 3],
    )
    by_score = transitions.sampler(64, by="episodes", weights=F("metadata.score"), seed=0)
    assert close(episodes_drawn(transitions, by_score), [0, 1, 2, 3, 4])
    by_step = transitions.sampler(64, weights=F("metadata.score"), seed=0)
    assert close(episodes_drawn(transitions, by_step), [i * n for i, n in enumerate(LENGTHS)])
    good = transitions.sampler(64, by="episodes", weights=F("metadata.score") > 2, seed=0)
    assert close(episodes_drawn(transitions, good), [0, 0, 0, 1, 1])
    assert dataset.episode_values(F("metadata", "nested", "v1.0")).tolist() == [2.0] * 5


def test_weights_change(dataset: TupliDataset) -> None:
    transitions = dataset.transitions()
    sampler = transitions.sampler(500, weights=np.ones(100), seed=3)
    sampler.update(np.arange(100), 0.0)
    sampler.update([7, 8, 8], [2.0, 5.0, 2.0])
    assert set(sampler.draw(0).tolist()) == {7, 8} and sampler.weights.sum() == 4
    sampler.update([7, 8], 0)
    with pytest.raises(SamplingError, match="expected a weight above 0, found 0 for every item"):
        next(sampler)


def test_tiny_and_huge_weights_never_give_an_item_of_weight_zero(dataset: TupliDataset) -> None:
    rng = np.random.default_rng(0)
    for _ in range(50):
        weights = 10.0 ** rng.integers(-300, 290, 100) * (rng.random(100) < 0.2)
        weights[rng.integers(100)] = 1.0
        drawn = dataset.transitions().sampler(300, weights=weights, seed=1).draw(0)
        assert (weights[drawn] > 0).all()


@pytest.mark.parametrize("shuffle", [False, "exact", "blocks"])
@pytest.mark.parametrize("drop_last", [False, True])
def test_each_item_once_an_epoch(dataset: TupliDataset, shuffle: Any, drop_last: bool) -> None:
    transitions = dataset.transitions()
    order = transitions.order(8, shuffle=shuffle, seed=5, drop_last=drop_last)
    epochs = [[batch.tolist() for batch in order] for _ in range(3)]
    assert len(order) == len(epochs[0]) == (12 if drop_last else 13)
    for epoch in epochs:
        numbers = [number for batch in epoch for number in batch]
        assert len(set(numbers)) == len(numbers) == (96 if drop_last else 100)
        assert (numbers == sorted(numbers)) == (shuffle is False)
    assert (epochs[0] == epochs[1]) == (shuffle is False)
    again = transitions.order(8, shuffle=shuffle, seed=5, drop_last=drop_last)
    assert [[batch.tolist() for batch in again] for _ in range(3)] == epochs


def numbers_of(kind: str, items: Any) -> Order | Sampler:
    if kind == "weighted":
        return items.sampler(8, weights=np.arange(len(items)) + 1.0, seed=2)
    if kind == "episodes":
        return items.sampler(8, by="episodes", seed=2)
    return items.order(8, shuffle=kind if kind != "in order" else False, seed=2)


@pytest.mark.parametrize("read_ahead", [0, 3])
@pytest.mark.parametrize("kind", ["in order", "exact", "blocks", "weighted", "episodes"])
@pytest.mark.parametrize("stop", [0, 1, 5, 12, 13])
def test_a_state_goes_on_with_the_next_batch(
    dataset: TupliDataset, kind: str, read_ahead: int, stop: int
) -> None:
    transitions = dataset.transitions()
    whole = transitions.batches(numbers_of(kind, transitions), read_ahead=read_ahead)
    taken = iter(whole)
    for _ in range(stop):
        next(taken)
    state = whole.state_dict()
    if kind != "weighted":
        state = json.loads(json.dumps(state))
    left = iter(dataset.transitions().batches(resumed(kind, dataset, state), read_ahead=read_ahead))
    for _ in range(13 - stop if kind in ("in order", "exact", "blocks") else 6):
        assert next(left).steps.tolist() == next(taken).steps.tolist()
    if kind in ("in order", "exact", "blocks"):
        assert next(left, None) is next(taken, None) is None


def resumed(kind: str, dataset: TupliDataset, state: dict[str, Any]) -> Order | Sampler:
    numbers = numbers_of(kind, dataset.transitions())
    numbers.load_state_dict(state)
    return numbers


def test_an_iteration_left_early(dataset: TupliDataset) -> None:
    """What was read ahead is not lost to a sampler; an order begins its next epoch."""
    transitions = dataset.transitions()
    sampler = transitions.sampler(4, seed=9)
    expected = [sampler.draw(i).tolist() for i in range(5)]
    batches = transitions.batches(sampler, read_ahead=2)
    found = []
    for _ in range(5):
        for batch in batches:
            found.append(batch.steps.tolist())
            break
    assert found == expected
    order = transitions.order(30, seed=9)
    ahead = transitions.batches(order, read_ahead=5)
    firsts = [next(iter(ahead)).steps.tolist() for _ in range(3)]
    assert firsts == [list(range(30))] * 3 and order.epoch == 2
    assert len(ahead) == 4 and [len(batch.steps) for batch in ahead] == [30, 30, 30, 10]


def test_a_state_of_something_else(dataset: TupliDataset, tmp_path: Path) -> None:
    other = TupliDataset.from_files(write(tmp_path / "o.mcap", LENGTHS, [0] * 5)).transitions()
    transitions = dataset.transitions()
    state = transitions.order(8, seed=1).state_dict()
    for items in (other, dataset.transitions(2), dataset.with_tuple_filter(F("step") > 0).transitions()):
        with pytest.raises(SamplingError, match="expected the state of these items, found that of others"):
            items.order(8).load_state_dict(state)
    for numbers in (transitions.sampler(8), transitions.order(9), transitions.order(8, shuffle="exact")):
        with pytest.raises(SamplingError, match="expected a state with (kind|batch_size)"):
            numbers.load_state_dict(state)
    with pytest.raises(SamplingError, match=r"expected a state that state_dict\(\) gave, found \{"):
        transitions.order(8).load_state_dict({"epoch": 1})
    with pytest.raises(SamplingError, match="expected numbers of the same items"):
        Batches(other, transitions.order(8))


def test_shuffled_blocks_go_on_with_the_same_blocks_only(tmp_path: Path) -> None:
    """The items are the same after `load`, but lie in other blocks: going on would repeat some and leave some out."""
    path = write(tmp_path / "r.mcap", [1000] * 40, [0] * 40)

    def order(dataset: TupliDataset, shuffle: Any) -> Order:
        return dataset.transitions().order(64, shuffle=shuffle, seed=100)

    recorded, loaded = TupliDataset.from_files(path), TupliDataset.from_files(path)
    loaded.load()
    first = order(recorded, "blocks")
    taken = list(itertools.islice(first, 3))
    with pytest.raises(
        SamplingError, match="expected the state of a shuffle of these blocks, found that of others"
    ):
        order(loaded, "blocks").load_state_dict(first.state_dict())
    resumed = order(TupliDataset.from_files(path), "blocks")
    resumed.load_state_dict(first.state_dict())
    assert len(np.unique(np.concatenate([*taken, *resumed]))) == 40_000
    order(loaded, "exact").load_state_dict(order(recorded, "exact").state_dict())


def test_a_state_that_was_changed(dataset: TupliDataset) -> None:
    transitions = dataset.transitions()
    weighted, order = transitions.sampler(8, weights=np.ones(100)), transitions.order(8)
    for numbers, changed, message in [
        (weighted, {"weights": [1.0]}, "expected weights as bytes in a state, found"),
        (weighted, {"weights": b"1234567"}, "expected weights as bytes in a state, found"),
        (weighted, {"weights": np.ones(2).tobytes()}, "expected 100 weights, one for each item"),
        (weighted, {"unused": 5}, "expected a list of unused batches in a state, found 5"),
        (weighted, {"unused": [["a"]]}, "expected unused numbers of items in one dimension, found"),
        (weighted, {"unused": [[3, 100]]}, "expected unused numbers of items from 0 to 99, found others"),
        (order, {"batch": 14}, "expected a batch of at most 13, found 14"),
    ]:
        before = numbers.state_dict()
        with pytest.raises(SamplingError, match=message):
            numbers.load_state_dict({**before, **changed})
        assert numbers.state_dict() == before


def test_weights_of_the_episodes_that_the_items_are_of(tmp_path: Path) -> None:
    """Also where the dataset has listed others since."""
    path = write(tmp_path / "r.mcap", LENGTHS, [0, 0, 0, 0, 7])
    dataset = TupliDataset.from_files(path)
    transitions = dataset.transitions()
    path.unlink()
    write(path, [9, 9, 9, 9, 9, 9], [1] * 6)
    assert len(dataset.preview()) == 6
    for by in ("steps", "episodes"):
        drawn = transitions.sampler(50, by=by, weights=F("metadata.score"), seed=0).draw(0)
        assert drawn.min() >= sum(LENGTHS[:4])  # of the last one


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"weights": [1.0, -2.0] * 50}, "expected weights from 0 on, found -2.0 for item 1"),
        ({"weights": [1.0, float("nan")] * 50}, "expected weights from 0 on, found nan for item 1"),
        ({"weights": [1.0, float("inf")] * 50}, "expected weights from 0 on, found inf for item 1"),
        ({"weights": np.zeros(100)}, "expected a weight above 0, found none for any item"),
        ({"weights": [1.0, 2.0]}, r"expected 100 weights, one for each item, found float64 of shape \(2,\)"),
        ({"weights": ["a"] * 100}, r"expected 100 weights, one for each item, found <U1 of shape \(100,\)"),
        ({"weights": np.ones(100), "by": "episodes"}, "expected 5 weights, one for each episode"),
        (
            {"weights": F("metadata.nested")},
            "expected a number as metadata.nested of every episode, found {'v1.0': 2}",
        ),
        (
            {"weights": F("metadata.none")},
            "expected a number as metadata.none of every episode, found nothing for ",
        ),
        ({"by": "hours"}, "expected by to be 'steps' or 'episodes', found 'hours'"),
        ({"seed": -1}, "expected a seed that is an integer from 0, found -1"),
        (
            {"seed": 1 << 128},
            "expected a seed of at most 340282366920938463463374607431768211455, found 3402",
        ),
        ({"weights": [1e308] * 100}, "found 1e\\+308 for item 0; their sum must be finite, too"),
        ({"weights": [[1], [1, 2]]}, r"expected 100 weights, one for each item, found \[\[1\], \[1, 2\]\]"),
        ({"batch_size": 0}, "expected a batch size that is an integer from 1, found 0"),
    ],
)
def test_what_a_sampler_refuses(dataset: TupliDataset, arguments: dict[str, Any], message: str) -> None:
    with pytest.raises(SamplingError, match=message):
        dataset.transitions().sampler(**{"batch_size": 8, **arguments})


def test_what_else_is_refused(dataset: TupliDataset) -> None:
    transitions = dataset.transitions()
    with pytest.raises(FilterError, match=r"unknown key .meta.score. .did you mean .metadata.\?.; the keys"):
        transitions.sampler(8, weights=F("meta.score"))
    with pytest.raises(SamplingError, match="expected one weight for each episode, found F"):
        Transitions(dataset.steps).sampler(8, weights=F("metadata.score"))
    with pytest.raises(
        SamplingError, match="expected shuffle to be one of False, 'exact', 'blocks', found 'yes'"
    ):
        transitions.order(8, shuffle="yes")
    with pytest.raises(SamplingError, match="expected at least 200 items for one full batch, found 100"):
        transitions.order(200, drop_last=True)
    with pytest.raises(SamplingError, match="expected a sampler with weights, found one without"):
        transitions.sampler(8).update([1], 2)
    sampler = transitions.sampler(8, weights=np.ones(100))
    with pytest.raises(SamplingError, match="expected items from 0 to 99, found 5 to 100"):
        sampler.update([5, 100], 1)
    with pytest.raises(SamplingError, match="expected weights from 0 on, of a finite sum, found -1.0"):
        sampler.update([5], -1)
    with pytest.raises(
        SamplingError, match="expected weights from 0 on, of a finite sum, found 1e\\+308 to 1e"
    ):
        sampler.update(range(100), 1e308)
    for places in ([0.7], ["a"], None, [True]):
        with pytest.raises(SamplingError, match="expected items from 0 to 99 in one dimension, found"):
            sampler.update(places, 1)
    for weights in (["a"], [1, 2, 3], {}):
        with pytest.raises(SamplingError, match="expected a weight, or 2 of them, one for each item, found"):
            sampler.update([4, 5], weights)
    assert (sampler.weights == 1).all()
    with pytest.raises(
        SamplingError, match="expected the number of a batch that is an integer from 0, found -1"
    ):
        sampler.draw(-1)
    for numbers in (None, "a", [1, 2]):
        with pytest.raises(SamplingError, match="expected an Order, a Sampler or a batch size, found"):
            transitions.batches(numbers)
    assert len(transitions.batches(np.int64(8))) == 13
    with pytest.raises(SamplingError, match="expected an Order, which has epochs, found a Sampler"):
        len(transitions.batches(sampler))


@pytest.mark.parametrize("stride", [1, 10])
@pytest.mark.parametrize(
    ("cache_bytes", "times"), [(1_300_000, 1), (1_000_000, 3)]
)  # decoded, or room for three chunks
def test_shuffled_blocks_are_read_about_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, cache_bytes: int, times: int, stride: int
) -> None:
    path = write(tmp_path / "r.mcap", [1000] * 40, [0] * 40)
    dataset = TupliDataset.from_files(path).with_cache(cache_bytes, threads=1)
    transitions = dataset.transitions() if stride == 1 else dataset.windows(2, stride)
    store = dataset.steps._index.stores[0]
    chunks = len(np.unique(transitions.source.blocks(np.arange(40_000))))
    assert chunks > 8 and store.table["uncompressed"].sum() > 2_500_000
    read: list[int] = []
    fetch = store._read
    monkeypatch.setattr(store, "_read", lambda i: read.append(i) or fetch(i))
    seen = [transitions[batch].states for batch in transitions.order(64, shuffle="blocks", seed=0)]
    needed = chunks + (stride == 1)  # one has the final states
    assert needed == len(set(read)) <= len(read) <= times * needed
    firsts = np.concatenate(seen).reshape(len(transitions), -1)[:, :2]
    assert np.unique(firsts, axis=0).shape == (40_000 // stride, 2)
    numbers = next(iter(transitions.order(64, shuffle="blocks", seed=0)))
    blocks = transitions.source.blocks(transitions.steps_of(numbers))
    assert len(np.unique(blocks)) > 1 and (np.diff(numbers) != 1).any()
