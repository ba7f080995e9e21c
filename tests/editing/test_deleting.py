"""Episodes that are deleted and brought back, in files, directories and storages."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import gymnasium as gym
import pytest
from golden_files import place
from signing_keys import write_key
from typer.testing import CliRunner
from web_server import serving

import tupli_mcap
from tupli_mcap import FileStorage, RecordEpisodes, Recording, RecordingError
from tupli_mcap.cli.app import app
from tupli_mcap.dataset.which import candidates
from tupli_mcap.errors import bytes_of
from tupli_mcap.recording import journal_path
from tupli_mcap.recording.sign.sign import sign_recording


def record(path: Path, episodes: int = 4) -> Path:
    with RecordEpisodes(gym.make("CartPole-v1", max_episode_steps=3), path) as recorded:
        for seed in range(episodes):
            recorded.reset(seed=seed)
            for _ in range(3):
                recorded.step(0)
    return path


def killed(path: Path, **options: Any) -> None:
    """A recording of three episodes whose process was killed."""
    program = f"""
import os
from pathlib import PosixPath
import gymnasium as gym
from tupli_mcap import RecordEpisodes
env = RecordEpisodes(gym.make("CartPole-v1"), {str(path)!r}, **{options!r})
for seed in range(3):
    env.reset(seed=seed)
    env.step(0)
os._exit(0)
"""
    subprocess.run([sys.executable, "-c", program], check=True)


def run(*words: str, code: int = 0) -> str:
    result = CliRunner().invoke(app, words)
    assert result.exit_code == code, result.output
    return result.output


@pytest.fixture
def runs(tmp_path: Path) -> Path:
    for name in ("a", "deep/b"):
        record(tmp_path / "runs" / f"{name}.mcap")
    return tmp_path / "runs"


def seeds(path: Path) -> list[int | None]:
    return [episode.seed for episode in tupli_mcap.open(path)]


def test_of_a_file_and_back(runs: Path) -> None:
    file = runs / "a.mcap"
    before = file.read_bytes()
    assert "would delete 2 episodes" in run("delete", str(file), "--episodes", "1,last", "--dry-run")
    assert seeds(file) == [0, 1, 2, 3]
    assert "deleted 2 episodes" in run("delete", str(file), "--episodes", "1,last")
    assert seeds(file) == [0, 2]
    assert file.read_bytes() == before
    with Recording(file) as recording:  # has all that the file has
        assert [recording.n_steps, len(recording.dataset)] == [12, 2]
        assert len(recording) == len(recording.lengths) == len(recording.returns) == 4
    assert seeds(runs) == [0, 2, 0, 1, 2, 3]
    run("delete", str(file), "--episodes", "1", code=1)  # it is not there any more
    assert "would restore 2 episodes" in run("restore", str(runs), "--dry-run")
    assert "restored 1 episode" in run("restore", str(file), "--episodes", "2-3")
    assert seeds(file) == [0, 2, 3]
    assert "such as '3,7-9', or all, found 'best'" in run("restore", str(runs), "-e", "best", code=2)
    assert json.loads(run("restore", str(runs), "-e", "all", "--json"))["result"]["episodes"] == [
        f"{Recording(file).uuid}-1"
    ]
    assert seeds(file) == [0, 1, 2, 3]
    assert sorted(path.name for path in runs.rglob("[!.]*")) == ["a.mcap", "b.mcap", "deep"]


@pytest.mark.parametrize("which", ["best", "worst", "first", "last", "1", "3-4", "all", "1,first"])
def test_of_a_directory_as_info_shows_it(runs: Path, which: str) -> None:
    """A word is one of all its episodes, a number is that of each recording that has it."""
    run("delete", str(runs / "a.mcap"), "--episodes", "3")
    place = [str(runs), "--episodes", which]
    shown = json.loads(run("info", *place, "--json"))["result"]["episodes"]
    tagged = json.loads(run("tag", *place, "good=true", "--dry-run", "--json"))["result"]
    deleted = json.loads(run("delete", *place, "--dry-run", "--json"))["result"]["episodes"]
    assert shown == sum(len(one["episodes"]) for one in tagged) == len(deleted)
    assert "runs has no episode 9; choose from 0 to 3" in run("delete", str(runs), "-e", "9", code=1)


def test_of_a_copy_only(runs: Path) -> None:
    file, copy = runs / "a.mcap", runs / "copy.mcap"
    shutil.copyfile(file, copy)
    assert "deleted 1 episode" in run("delete", str(copy), "--episodes", "0")
    assert (seeds(copy), seeds(file)) == ([1, 2, 3], [0, 1, 2, 3])
    assert "deleted 1 episode" in run("delete", str(file), "--episodes", "0")
    assert "restored 1 episode" in run("restore", str(copy))
    assert (seeds(copy), seeds(file)) == ([0, 1, 2, 3], [1, 2, 3])


def test_the_space_of_one_file_or_of_all(runs: Path) -> None:
    one, other = runs / "a.mcap", runs / "deep" / "b.mcap"
    sizes = [path.stat().st_size for path in (one, other)]
    run("delete", str(one), str(other), "--episodes", "0")
    assert "a.mcap" in run("compact", str(one), "--dry-run")
    assert "compacted 1 recording" in run("compact", str(one))
    assert (one.stat().st_size < sizes[0], other.stat().st_size) == (True, sizes[1])
    assert (seeds(one), seeds(other)) == ([1, 2, 3], [1, 2, 3])
    assert "restored 0 episodes" in run("restore", str(one))
    assert "compacted 1 recording" in run("compact", str(other.parent))
    assert other.stat().st_size < sizes[1]


def test_the_space_of_a_directory_and_of_a_file_in_it(runs: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(runs)
    run("delete", "a.mcap", "--episodes", "0")
    for places in ((".", "a.mcap"), ("a.mcap", "."), (".", str(runs))):
        told = json.loads(run("compact", *places, "--dry-run", "--json"))["result"]["recordings"]
        assert [item["recording"] for item in told] == ["a.mcap"]
    assert "compacted 1 recording" in run("compact", ".", "a.mcap")


def test_names_of_several_directories_tell_which(runs: Path) -> None:
    other = runs.parent / "other" / "a.mcap"
    other.parent.mkdir()
    shutil.copyfile(runs / "a.mcap", other)
    run("delete", str(runs / "a.mcap"), str(other), "--episodes", "0")
    told = json.loads(run("compact", str(runs), str(other), "--dry-run", "--json"))["result"]["recordings"]
    assert [item["recording"] for item in told] == [str(runs / "a.mcap"), str(other)]


def test_the_space_of_one_that_is_being_recorded(runs: Path) -> None:
    live, told = runs / "live.mcap", "live.mcap is being recorded: its deleted episodes stay in it"
    with RecordEpisodes(gym.make("CartPole-v1"), live) as recorded:
        recorded.reset(seed=0)
        recorded.step(0)
        run("delete", str(live), "--episodes", "0")
        for words in ((str(live),), (str(runs),), (str(runs), "--dry-run")):
            assert told in " ".join(run("compact", *words).split())
        assert told not in run("compact", str(runs / "a.mcap"))
    assert "compacted 1 recording" in run("compact", str(live))


def test_the_space_of_one_that_was_not_finished(tmp_path: Path) -> None:
    """Its journal goes, too; without one, it only gets the index that it lacked."""
    file = place("unfinished_holes", tmp_path)
    journal = journal_path(file)
    sizes = file.stat().st_size, journal.stat().st_size
    run("delete", str(file), "-e", "1")
    told = run("compact", str(file), "--json")
    assert json.loads(told)["result"]["bytes_freed"] == sum(sizes) - file.stat().st_size
    assert not journal.exists()
    file = place("unfinished_holes", tmp_path)
    journal.unlink()
    run("delete", str(file), "-e", "1")
    told = run("compact", str(file))
    assert (
        f"compacted 1 recording, which freed nothing: {bytes_of(file.stat().st_size - sizes[0])} more are used"
        in told
    )


@pytest.mark.parametrize("episodes", ["0", "all"])
def test_the_journal_of_one_that_was_killed_goes_from_where_it_is(tmp_path: Path, episodes: str) -> None:
    """But not that of another recording: of the original of a copy, or of one that was renamed without it."""
    elsewhere, file, copy = tmp_path / "journals", tmp_path / "a.mcap", tmp_path / "copy.mcap"
    elsewhere.mkdir()
    killed(file, journal_dir=elsewhere)
    shutil.copy(file, copy)
    run("delete", str(file), str(copy), "--episodes", episodes)
    for path, left in ((copy, 1), (file, 0)):
        assert "compacted 1 recording" in run("compact", str(path))
        assert len(list(elsewhere.iterdir())) == left
    killed(tmp_path / "b.mcap")
    (tmp_path / "b.mcap").rename(tmp_path / "renamed.mcap")
    record(tmp_path / "other.mcap").rename(tmp_path / "b.mcap")
    run("delete", str(tmp_path / "b.mcap"), "--episodes", episodes)
    assert "compacted 1 recording" in run("compact", str(tmp_path / "b.mcap"))
    journal_path(tmp_path / "b.mcap").rename(journal_path(tmp_path / "renamed.mcap"))
    assert seeds(tmp_path / "renamed.mcap") == [0, 1, 2]


def test_a_signature_goes_with_a_warning(runs: Path, tmp_path: Path) -> None:
    file = runs / "a.mcap"
    sign_recording(file, write_key(tmp_path / "id"))
    run("delete", str(file), "--episodes", "0")
    with pytest.warns(UserWarning, match=r"a\.mcap: its signature covers .* left out"):
        FileStorage(runs).compact()
    assert "signature.ed25519" not in Recording(file).attachments


def test_merged_and_split_they_stay_deleted(runs: Path, tmp_path: Path) -> None:
    file, other = runs / "a.mcap", runs / "deep" / "b.mcap"
    run("delete", str(file), "--episodes", "1,2")
    assert tupli_mcap.merge_recordings([file, other], tmp_path / "m.mcap", dry_run=True).episodes == 6
    run("merge", str(file), str(other), "-o", str(tmp_path / "m.mcap"))
    assert seeds(tmp_path / "m.mcap") == [0, 3, 0, 1, 2, 3]
    run("split", str(file), "-o", str(tmp_path / "s.mcap"), "--episodes", "1")
    assert seeds(tmp_path / "s.mcap") + seeds(tmp_path / "s_0001.mcap") == [0, 3]
    assert not (tmp_path / "s_0002.mcap").exists()


def test_importing_does_not_bring_them_back(runs: Path, tmp_path: Path) -> None:
    lab, whole, part = tmp_path / "lab", tmp_path / "whole.mcap", tmp_path / "part.mcap"
    run("bundle", str(runs / "a.mcap"), "-o", str(whole))
    run("delete", str(runs / "a.mcap"), "--episodes", "2,3")
    run("bundle", str(runs / "a.mcap"), "-o", str(part))  # none of its episodes is left in the storage below
    run("import", str(whole), "--storage", str(lab))
    run("delete", str(lab), "--filter", "episode < 2")
    for bundle, count in ((whole, 4), (part, 2)):
        for dry in ([], ["--dry-run"]):
            told = run("import", str(bundle), "--storage", str(lab), *dry)
            assert f"import{'' if dry else 'ed'} 0 of {count} episodes" in told
            assert told.count("not copied: 2 episodes that had been deleted there; `tupli-mcap restore ") == 1
    with pytest.warns(UserWarning, match="not copied: 2 episodes"):
        FileStorage(lab).import_bundle(whole)
    assert seeds(lab) == [2, 3]
    assert "restored 1 episode" in run("restore", str(lab), "--episodes", "0")
    run("compact", "--storage", str(lab))  # now nothing brings it back but a copy
    assert "imported 1 of 4 episodes" in run("import", str(whole), "--storage", str(lab))
    assert sorted(map(str, seeds(lab))) == ["0", "1", "2", "3"]


def test_importing_does_not_bring_back_all_of_a_recording(runs: Path, tmp_path: Path) -> None:
    file, lab = str(runs / "a.mcap"), str(tmp_path / "lab")
    run("import", file, "--storage", lab)
    run("delete", lab, "--filter", "steps > 0")
    for dry in (["--dry-run"], []):
        told = run("import", file, "--storage", lab, *dry)
        assert f"import{'' if dry else 'ed'} 0 of 4 episodes" in told
        assert "not copied: 4 episodes that had been deleted there; `tupli-mcap restore " in told
    assert "restored 4 episodes" in run("restore", lab)
    assert len(list(Path(lab).rglob("*.mcap"))) == 1


def test_of_a_directory_by_filter(runs: Path) -> None:
    for where in (runs, runs / "a.mcap"):
        assert "no episode has metadata.lost" in run(
            "delete", str(where), "--filter", "metadata.lost", code=2
        )
    assert "deleted 4 episodes" in run("delete", str(runs), "--filter", "seed >= 2")
    assert seeds(runs) == [0, 1, 0, 1]
    storage = FileStorage(runs)
    assert len(storage.deleted_episodes()) == 4
    assert storage.restore_episodes(storage.deleted_episodes()[:1]) == 1
    assert storage.restore_episodes(["nobody-1"]) == 0
    run("compact", "--storage", str(runs))
    assert storage.deleted_episodes() == []
    assert storage.restore_episodes() == 0
    assert seeds(runs) == [0, 1, 2, 0, 1]


def test_what_compact_removes_stays_deleted_in_a_recording_that_is_open(runs: Path) -> None:
    """The notes about it are gone, while whoever has opened the file before still has these episodes."""
    file = runs / "a.mcap"
    with Recording(file) as recording:
        run("delete", str(file), "--episodes", "1,last")
        assert candidates(recording).tolist() == [0, 2]
        run("compact", str(file))
        assert (len(recording), candidates(recording).tolist()) == (4, [0, 2])
        run("delete", str(file), "--episodes", "2")
        assert candidates(recording).tolist() == [0]


def test_a_whole_recording_comes_back_until_compact_removes_it(runs: Path) -> None:
    assert "say which" in run("delete", str(runs), code=2)
    words = "delete", str(runs / "a.mcap"), "--episodes", "all"
    assert run(*words, "--dry-run") == "would delete 4 episodes\n"
    assert run(*words) == "deleted 4 episodes\n"
    assert seeds(runs) == [0, 1, 2, 3]
    assert run("restore", str(runs)) == "restored 4 episodes\n"
    assert seeds(runs) == [0, 1, 2, 3] * 2
    run(*words)
    assert "freed" in run("compact", str(runs))
    assert [path.name for path in runs.rglob("[!.]*.mcap*")] == ["b.mcap"]


def test_another_recording_of_the_same_name_loses_nothing(runs: Path) -> None:
    run("delete", str(runs / "a.mcap"), "--episodes", "0")
    (runs / "a.mcap").unlink()
    record(runs / "a.mcap", episodes=2)
    assert "restored 0 episodes" in run("restore", str(runs / "a.mcap"))
    assert seeds(runs / "a.mcap") == [0, 1]


def test_in_python_and_back(runs: Path) -> None:
    file = runs / "a.mcap"
    doomed = tupli_mcap.open(file).filter("seed >= 2")
    assert (doomed.delete(dry_run=True), seeds(file)) == (2, [0, 1, 2, 3])
    assert not list(runs.rglob("*.json"))
    assert (doomed.delete(), seeds(file)) == (2, [0, 1])
    assert doomed.delete() == 0  # they are gone already
    uuid = Recording(file).uuid
    assert tupli_mcap.restore_episodes(runs, [3], dry_run=True) == [f"{uuid}-3"]
    assert tupli_mcap.restore_episodes([file, runs], [3]) == [f"{uuid}-3"]
    assert seeds(file) == [0, 1, 3]
    assert tupli_mcap.restore_episodes(file) == [f"{uuid}-2"]
    assert seeds(file) == [0, 1, 2, 3]
    with pytest.raises(RecordingError, match="does not exist"):
        tupli_mcap.restore_episodes(runs / "none.mcap")


def test_a_pattern_that_the_shell_has_left(runs: Path) -> None:
    pattern = str(runs / "**" / "*.mcap")
    assert "deleted 2 episodes" in run("delete", pattern, "--episodes", "0")
    assert seeds(runs / "deep" / "b.mcap")[0] == 1
    assert "restored 2 episodes" in run("restore", pattern)
    assert "no file matches" in run("restore", str(runs / "x*.mcap"), code=1)


def test_what_is_not_deleted_is_not_restored(runs: Path) -> None:
    file, other = runs / "a.mcap", runs / "deep" / "b.mcap"
    for words in (["delete"], ["restore"], ["restore", str(other)]):
        told = run(*words, str(file), "-e", "99", code=1)
        assert told.count("episode 99") == 1
    assert f"{file} has no episode 99; choose from 0 to 3" in run("delete", str(file), "-e", "99", code=1)
    assert f"{file} has no deleted episode 0; none can be" in run("restore", str(file), "-e", "0", code=1)
    run("delete", str(file), "-e", "1,2")
    for dry in ([], ["--dry-run"]):
        told = run("restore", str(file), "-e", "1,3", *dry, code=1)
        assert f"{file} has no deleted episode 3; choose from 1 to 2" in told
        assert "b.mcap has no deleted episode 1; none" in run(
            "restore", *map(str, (file, other)), "-e", "1", code=1
        )
    assert seeds(file) == [0, 3]
    with pytest.raises(RecordingError, match=r"a\.mcap has no deleted episode 0; choose from 1 to 2"):
        tupli_mcap.restore_episodes(file, [1, 0])
    assert tupli_mcap.restore_episodes(file, []) == []
    run("restore", str(file), "-e", "", code=2)
    assert len(tupli_mcap.restore_episodes(runs, "2-9, 1")) == 2
    assert seeds(file) == [0, 1, 2, 3]


def test_one_episode_in_python(runs: Path) -> None:
    assert tupli_mcap.open(runs)[1].delete() == 1
    assert Recording(runs / "a.mcap").episodes[0].delete() == 1
    assert Recording(runs / "a.mcap").episodes[0].delete() == 0
    assert seeds(runs) == [2, 3, 0, 1, 2, 3]


def test_a_whole_recording_of_several_in_python(runs: Path) -> None:
    one, other = tupli_mcap.open(runs / "a.mcap"), tupli_mcap.open(FileStorage(runs / "deep"))
    chosen = one.filter("seed == 0") + other
    assert chosen.delete(dry_run=True) == 5
    assert seeds(runs) == [0, 1, 2, 3] * 2
    assert chosen.delete() == 5
    assert seeds(runs) == [1, 2, 3]
    assert len(tupli_mcap.restore_episodes([runs, runs / "deep"])) == 5
    assert seeds(runs) == [0, 1, 2, 3] * 2


def test_in_a_storage_the_catalog_knows(runs: Path) -> None:
    storage = FileStorage(runs)
    assert storage.count_episodes() == 8
    assert tupli_mcap.open(storage).filter("seed >= 2").delete() == 4
    assert storage.count_episodes() == 4
    assert len(tupli_mcap.restore_episodes(runs)) == 4
    assert storage.count_episodes() == 8


@pytest.mark.parametrize(
    "text", ["not metadata.chekced", "metadata.chekced not in [1]", "episode < 9 and not run.nme"]
)
def test_a_mistyped_key_does_not_delete_all(runs: Path, text: str) -> None:
    for where in (runs, runs / "a.mcap"):
        run("tag", str(where), "checked=true", "--episodes", "all")
        assert "no episode has" in run("delete", str(where), "--filter", text, code=2)
        assert seeds(runs / "a.mcap") == [0, 1, 2, 3]
    assert "deleted 8 episodes" in run("delete", str(runs), "--filter", "not metadata.checked = 2")


def test_at_a_url_nothing_is_deleted(runs: Path) -> None:
    with serving() as server:
        server.files["/a.mcap"] = (runs / "a.mcap").read_bytes()
        dataset = tupli_mcap.open(server.url("/a.mcap"))
        for delete in (dataset.filter("seed == 0").delete, dataset[0].delete):
            with pytest.raises(RecordingError, match="cannot be changed here; download it"):
                delete()


def test_a_link_is_the_file_that_it_names(runs: Path, tmp_path: Path) -> None:
    file, link = runs / "a.mcap", tmp_path / "curated" / "link.mcap"
    link.parent.mkdir()
    link.symlink_to(file)
    assert seeds(link.parent) == [0, 1, 2, 3]
    run("delete", str(link), "--episodes", "1")
    assert seeds(link) == seeds(link.parent) == seeds(file) == [0, 2, 3]
    run("delete", str(file), "--episodes", "0")
    assert seeds(link) == seeds(link.parent) == [2, 3]
    run("restore", str(link), "--episodes", "0")
    before = file.stat().st_size
    run("compact", str(link))
    assert link.is_symlink() and file.stat().st_size < before
    assert seeds(file) == seeds(link.parent) == [0, 2, 3]
    run("delete", str(link), "--episodes", "all")
    run("compact", str(link))
    assert not (file.exists() or link.is_symlink())


def test_a_hidden_file_that_is_named(tmp_path: Path) -> None:
    file = record(tmp_path / ".hidden.mcap")
    assert tupli_mcap.open(file).filter("seed = 1").delete() == 1
    assert seeds(file) == [0, 2, 3]
    assert "restored 1 episode" in run("restore", str(file))
    assert seeds(file) == [0, 1, 2, 3]


def test_what_is_saved_over_a_file_is_not_hidden_by_its_notes(tmp_path: Path) -> None:
    runs = tupli_mcap.open(record(tmp_path / "a.mcap", 5))
    good = runs.filter("seed < 3").save(tmp_path / "good.mcap")
    assert tupli_mcap.open(good).filter("seed = 1").delete() == 1
    runs.filter("seed < 4").save(good, overwrite=True)
    assert seeds(good) == [0, 1, 2, 3]
