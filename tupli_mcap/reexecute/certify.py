"""`certify`: runs the episodes of a recording again and compares them."""

from __future__ import annotations

import os
import time
import warnings
from collections.abc import Callable, Sequence
from functools import cached_property
from typing import Any, BinaryIO, Literal

import gymnasium as gym

from tupli_mcap.errors import RecordingError, brief
from tupli_mcap.recording import Recording
from tupli_mcap.recording.describe.description import describe_space
from tupli_mcap.recording.index import chosen_numbers
from tupli_mcap.recording.sign.carried_code import foreign_options, options_are_trusted
from tupli_mcap.reexecute.attempt import Attempt, Watch, attempt, repeats_itself
from tupli_mcap.reexecute.certificate import (
    REASONS,
    Certificate,
    Counts,
    Divergence,
    SkipKind,
    Skipped,
    content_digest,
    platform_facts,
    versions_under,
)
from tupli_mcap.reexecute.compare import Checker, Difference
from tupli_mcap.reexecute.reapply import Reexecutor
from tupli_mcap.reexecute.starts import EpisodePlan, needed_for, plan_episodes, up_to_last
from tupli_mcap.spaces.leaves import own_space

_MAX_DIVERGENCES = 100


def certify(
    recording: Recording | str | os.PathLike[str] | BinaryIO,
    *,
    trust: bool = False,
    episodes: Sequence[int] | None = None,
    env: gym.Env[Any, Any] | None = None,
    progress: Callable[[int], None] | None = None,
) -> Certificate:
    """Run the episodes of a recording again, and compare them bit for bit.

    Each episode is reset with its seed and options and stepped with its actions; states, rewards, flags and the final
    state are compared. An episode that was reset without a seed continues the random stream of the one before, as it
    did when it was recorded.

    Args:
        recording: an open recording, or what `Recording` opens.
        trust: rebuild the environment even if that runs code from the file, and reset it with any options.
        episodes: numbers of those to check; by default, all. Episodes that they depend on are run too.
        env: an environment to use instead of the one in the file; it is not closed.
        progress: called with the number of steps done.

    Raises:
        UntrustedError: rebuilding the environment would run code that this user does not trust.
        RecordingError: the recording carries no environment, or has no such episode.
        FormatError: the file is damaged.
    """
    if not isinstance(recording, Recording):
        with Recording(recording) as opened:
            return certify(opened, trust=trust, episodes=episodes, env=env, progress=progress)
    chosen = frozenset(chosen_numbers(recording.index, episodes, recording.name))
    return Certifier(recording, trust, chosen, env, progress).run()


class Certifier:
    """Runs the chosen episodes again, and those that they depend on. For one call of `run`.

    A subclass that does more than compare overrides `_build`, `_watch` and `_stops`.
    """

    def __init__(
        self,
        recording: Recording,
        trust: bool,
        chosen: frozenset[int],
        env: gym.Env[Any, Any] | None,
        progress: Callable[[int], None] | None,
    ) -> None:
        self._recording = recording
        self._trust = trust
        self._chosen = chosen
        self._given = env
        self._progress = progress
        self._record = recording.benchmark.record if env is None else None
        self._versions: dict[str, str] | None = None
        self._outcomes: dict[int, Divergence | SkipKind | None] = {}  # by position
        self._done = 0
        self._plain = False  # whether actions are passed with Python's numbers
        self._settled = False  # whether `_plain` is known
        self._deterministic: bool | None = None
        self._stopped = False

    def run(self) -> Certificate:
        captured = self._record is not None and self._record.pickle is not None
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # the environment gave its warnings when it was recorded
            if self._chosen:
                self._checker = Checker(self._recording.layout, casts=self._recording.is_vector)
                for plans in plan_episodes(self._recording, captured=captured):
                    if not self._stopped:
                        self._sub_environment(plans)
        return self._certificate()

    def _make(self) -> gym.Env[Any, Any]:
        env = self._given if self._given is not None else self._build()
        if self._versions is None:
            _check_spaces(self._recording, env)
            self._versions = versions_under(env)
        return env

    def _build(self) -> gym.Env[Any, Any]:
        return self._recording.benchmark.make_env(trust=self._trust)

    def _watch(self, plan: EpisodePlan, reexecutor: Reexecutor) -> Watch | None:
        """The watcher of the next attempt at an episode; further attempts may follow."""
        return None

    def _stops(self, plan: EpisodePlan, outcome: Divergence | SkipKind | None) -> bool:
        return False

    def _reexecutor(self, *, plain: bool = False) -> Reexecutor:
        return Reexecutor(self._make, owned=self._given is None, plain=plain)

    def _sub_environment(self, plans: list[EpisodePlan]) -> None:
        """Runs the chosen episodes of one sub-environment, and those that they continue. If one differs, runs them anew
        after all episodes before them: a wrapper may carry state over a seeded reset."""
        everything = up_to_last(plans, self._chosen)
        needed = needed_for(everything, self._chosen)
        self._reexecute(needed)
        if len(needed) < len(everything) and self._given is None:
            outcomes = [self._outcomes.get(plan.position) for plan in needed if plan.number in self._chosen]
            if any(isinstance(outcome, Divergence) for outcome in outcomes):
                self._stopped = False
                self._reexecute(everything)

    def _reexecute(self, plans: list[EpisodePlan]) -> None:
        reexecutor = self._reexecutor(plain=self._plain)
        doubt: SkipKind | None = "unseeded"
        try:
            for plan in plans:
                doubt = self._doubt(plan, doubt)
                outcome: Divergence | SkipKind | None = None
                if self._withheld(plan):
                    outcome = doubt = "untrusted"
                else:
                    result, reexecutor = self._attempt(plan, reexecutor)
                    if result.agrees:
                        doubt = None if doubt == "after_divergence" else doubt
                    else:
                        outcome = doubt or self._divergence(plan, result)
                        doubt = doubt or "after_divergence"
                self._outcomes[plan.position] = outcome
                self._done += int(self._recording.index["length"][plan.position])
                if self._progress is not None:
                    self._progress(self._done)
                self._stopped = self._stops(plan, outcome)
                if self._stopped:
                    return
        finally:
            reexecutor.close()

    def _withheld(self, plan: EpisodePlan) -> bool:
        """Whether an episode is not run, because its reset options could run code and are not trusted."""
        return any(foreign_options(reset.options) for reset in plan.resets) and not self._any_options

    @cached_property
    def _any_options(self) -> bool:
        """Whether options that could run code are trusted."""
        return self._trust or options_are_trusted(self._recording)

    def _doubt(self, plan: EpisodePlan, before: SkipKind | None) -> SkipKind | None:
        """A reason for which an episode may differ although nothing is wrong; None if there is none."""
        if plan.starts_chain:
            return None
        if plan.gap:
            return "no_predecessor"
        return before if plan.needs_predecessor else "unseeded"

    def _attempt(self, plan: EpisodePlan, reexecutor: Reexecutor) -> tuple[Attempt, Reexecutor]:
        """Runs an episode in the environment of those before it; if it differs, in new ones: another process may have
        continued the recording, or the policy may have given Python's numbers."""
        used = reexecutor.used
        found = self._attempted(plan, reexecutor)
        if found.agrees:
            self._settled = True
        if found.agrees or not plan.starts_chain or self._given is not None:
            return found, reexecutor
        others = [self._reexecutor(plain=self._plain)] if used else []
        if not self._settled and any(leaf.is_scalar for leaf in self._recording.layout.action):
            others.append(self._reexecutor(plain=True))
        for other in others:
            again = self._attempted(plan, other)
            if again.agrees:
                reexecutor.close()
                self._settled, self._plain = True, other.plain
                return again, other
            other.close()
        return found, reexecutor

    def _attempted(self, plan: EpisodePlan, reexecutor: Reexecutor) -> Attempt:
        watch = self._watch(plan, reexecutor)
        return attempt(self._recording, reexecutor, plan, self._checker, watch)

    # ---- the first difference of an episode

    def _divergence(self, plan: EpisodePlan, found: Attempt) -> Divergence:
        tally, first, error = found.tally, found.tally.first, found.error
        known = not tally.unmeasured and tally.largest is not None
        if first is None:
            step = -1 if error is None else error.step
            first = Difference(step, "", "", "", "" if error is None else brief(error.cause), None)
            kind: Literal["value", "end", "error"] = "error"
        else:
            kind = "end" if first.leaf in ("terminal", "timeout") else "value"
        return Divergence(
            kind=kind,
            episode=plan.number,
            env=plan.env,
            step=first.step,
            leaf=first.leaf,
            path=first.path,
            expected=first.expected,
            found=first.found,
            largest_difference=tally.largest if known else None,
            largest_step=tally.largest_step if known else None,
            differing_steps=tally.steps,
            length=tally.length,
            hint=" ".join(self._hints(plan, found)),
        )

    def _hints(self, plan: EpisodePlan, found: Attempt) -> list[str]:
        hints = []
        tally = found.tally
        if tally.ended is not None:
            left = tally.length - tally.ended - 1
            hints.append(f"The episode ends differently here, so its last {left} steps were not compared.")
        repeats = self._repeats_itself(plan) if plan.starts_chain and found.error is None else None
        if repeats is False:
            hints.append(
                "The environment is not deterministic: two runs with the same seed differ "
                "(it may draw from np.random, random or an unseeded space)."
            )
        elif repeats:
            hints.append(
                "The environment is deterministic: its code, its libraries or the recorded values have changed."
            )
        if plan.env > 0:
            hints.append(
                "The file holds the first sub-environment; this one may have been made in another way."
            )
        if plan.needs_predecessor and not plan.after_end:
            hints.append(
                "It was reset without a seed after an interrupted episode: a step before it may not have been recorded."
            )
        return hints

    def _repeats_itself(self, plan: EpisodePlan) -> bool | None:
        if self._deterministic is None and self._given is None:
            reexecutors = self._reexecutor(), self._reexecutor()
            try:
                self._deterministic = repeats_itself(self._recording, plan, reexecutors)
            finally:
                for reexecutor in reexecutors:
                    reexecutor.close()
        return self._deterministic

    # ---- the result

    def _certificate(self) -> Certificate:
        recording, record = self._recording, self._record
        rows = recording.index
        outcomes = {
            p: o for p, o in sorted(self._outcomes.items()) if int(rows["episode"][p]) in self._chosen
        }
        divergences = [o for o in outcomes.values() if isinstance(o, Divergence)]
        return Certificate(
            recording=recording.uuid,
            benchmark_id=recording.benchmark_id,
            environment=record.name if record is not None else str(self._given),
            environment_digest=record.digest if record is not None else "",
            content_sha256=content_digest(recording),
            created_ns=time.time_ns(),
            recorded=self._counts(range(len(rows))),
            chosen=self._counts(outcomes),
            agreed=self._counts([p for p, o in outcomes.items() if o is None]),
            diverged=self._counts([p for p, o in outcomes.items() if isinstance(o, Divergence)]),
            skipped=self._skipped(outcomes),
            divergences=divergences[:_MAX_DIVERGENCES],
            versions=self._versions or versions_under(None),
            recorded_versions=dict(record.versions) if record is not None else {},
            platform=platform_facts(),
        )

    def _counts(self, positions: Any) -> Counts:
        chosen = list(positions)
        return Counts(episodes=len(chosen), steps=int(self._recording.index["length"][chosen].sum()))

    def _skipped(self, outcomes: dict[int, Divergence | SkipKind | None]) -> list[Skipped]:
        skipped = []
        for kind, reason in REASONS.items():
            positions = [p for p, o in outcomes.items() if o == kind]
            if positions:
                counts = self._counts(positions)
                first = int(self._recording.index["episode"][positions[0]])
                skipped.append(Skipped(kind=kind, reason=reason, first=first, **counts.model_dump()))
        return skipped


def _check_spaces(recording: Recording, env: gym.Env[Any, Any]) -> None:
    if not isinstance(env, gym.Env):
        raise RecordingError(
            f"env: expected an environment, such as gymnasium.make(...) makes, found {env!r:.80}"
        )
    for name in ("observation_space", "action_space"):
        recorded, found = getattr(recording, name), own_space(getattr(env, name))
        if recorded != found:
            told = [describe_space(space) for space in (recorded, found)]
            if told[0] == told[1]:  # bounds of single dimensions
                told = [" ".join(str(space).split()) for space in (recorded, found)]
            raise RecordingError(
                f"{recording.name}: expected an environment with the {name} {told[0]:.300}, found {told[1]:.300}"
            )
