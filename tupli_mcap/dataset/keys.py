"""The values of episodes at a key, such as "return" or "metadata.score", and the keys that they have."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final

from tupli_mcap.errors import FilterError, did_you_mean
from tupli_mcap.jsonvalue import spelled
from tupli_mcap.schema import BaseFilter, EpisodeHeader, F, FilterType, filter_keys, format_key
from tupli_mcap.schema.facts import comparisons, path_in
from tupli_mcap.schema.keys import leaves_of
from tupli_mcap.schema.predicate import MISSING, look_up
from tupli_mcap.storage.base import uuid_of

_KINDS: Final = {bool: "true or false", int: "a number", float: "a number", str: "a text"}


def keys_of(headers: Sequence[EpisodeHeader]) -> list[str]:
    """The keys of facts about episodes, and of the metadata of any of them."""
    runs = {id(header.run): header.run for header in headers}.values()
    own = {("metadata", *path) for header in headers for path, _ in leaves_of(header.metadata)}
    own |= {("run", *path) for run in runs for path, _ in leaves_of(run)}
    return sorted(set(filter_keys(EpisodeHeader)) - {"metadata"} | set(map(format_key, own)))


def values_at(
    key: str, headers: Sequence[EpisodeHeader], episodes: Callable[[BaseFilter | None], list[EpisodeHeader]]
) -> list[Any]:
    """The value of each episode at a key, None if it has none; FilterError if it is unknown, or none that `episodes`
    lists without a filter has it."""
    path = path_in(key, EpisodeHeader)
    values = [_value(header, path) for header in headers]
    if values and all(value is None for value in values):
        check_metadata(F(key) == True, episodes(None))  # noqa: E712 - an expression
    return values


def _value(header: EpisodeHeader, path: tuple[str, ...]) -> Any:
    if path == ("run",):  # of files without a run, each is one
        return header.run.get("id") or uuid_of(header)
    value = look_up(header, path)
    return None if value is MISSING else value


def matching(
    wanted: BaseFilter | None, episodes: Callable[[BaseFilter | None], list[EpisodeHeader]]
) -> list[EpisodeHeader]:
    """What `episodes` lists by a filter; FilterError if it names metadata that no episode has."""
    found = episodes(wanted)
    if not found and wanted is not None:
        check_metadata(wanted, episodes(None))
    return found


def negates(wanted: BaseFilter) -> bool:
    """Whether a filter has a `not`, under which a mistyped key of metadata matches all episodes."""
    return wanted.type is FilterType.NOT or any(map(negates, wanted.filters))


def check_metadata(wanted: BaseFilter, among: Sequence[EpisodeHeader]) -> None:
    """FilterError if a filter names metadata, or parts of runs, that no episode has."""
    known: dict[tuple[str, ...], set[str]] = {
        ("metadata",): set(),
        ("run",): set(),
        ("run", "metadata"): set(),
    }
    for header in among:
        _note_keys(header.metadata, ("metadata",), known)
    for run in {id(header.run): header.run for header in among}.values():
        _note_keys(run, ("run",), known)
    for comparison in comparisons(wanted) if among else ():
        path = path_in(comparison.key or "", EpisodeHeader)
        for there, keys in known.items():
            if path[:-1][: len(there)] == there and (name := path[len(there)]) not in keys:
                elsewhere = [
                    format_key((*place, *path[len(there) :]))
                    for place, others in known.items()
                    if name in others
                ]
                written = sorted(format_key([key]) for key in keys)
                meant = f" (did you mean {elsewhere[0]!r}?)" if elsewhere else did_you_mean(name, written)
                raise FilterError(
                    f"no episode has {comparison.key}{meant}; "
                    f"{'.'.join(there)} has {', '.join(written) or 'no keys'}"
                )


def _note_keys(
    value: Mapping[str, Any], within: tuple[str, ...], known: dict[tuple[str, ...], set[str]]
) -> None:
    """Adds the keys of nested mappings, by the path of each mapping."""
    known.setdefault(within, set()).update(value)
    for key, inside in value.items():
        if isinstance(inside, Mapping):
            _note_keys(inside, (*within, key), known)


def unlike_any(wanted: BaseFilter, among: Sequence[EpisodeHeader]) -> str:
    """What a filter that matches no episode may mean, if it compares a key with a value of a kind that no episode has
    there, or with a text that is like one; else nothing."""
    for comparison in comparisons(wanted):
        path = path_in(comparison.key or "", EpisodeHeader)
        found = [value for header in among if (value := look_up(header, path)) not in (MISSING, None)]
        kinds = {_KINDS.get(type(value)): value for value in reversed(found)}
        for value in comparison.value if comparison.type is FilterType.IN else [comparison.value]:
            kind = _KINDS.get(type(value))
            if kind and kinds and not kinds.keys() & {kind, None}:
                (other, example), *_ = kinds.items()
                return f"{comparison.key} is {other}, such as {spelled(example)}, and never {kind}"
            texts = sorted({text for text in found if isinstance(text, str)})
            exact = comparison.type in (FilterType.EQ, FilterType.IN)
            if exact and isinstance(value, str) and value not in texts:
                hint = did_you_mean(value, texts)
                if value and (longer := [text for text in texts if value in text]):
                    hint = f" ({comparison.key} ~ {value!r} finds it as a part of {longer[0]!r:.80})"
                if hint:
                    return f"no {comparison.key} is {value!r}{hint}"
    return ""
