"""What viewers open on a server: an episode for Rerun."""

from __future__ import annotations

import sys
from pathlib import Path

import httpx
import numpy as np
import pytest
from rrd import Rrd
from test_server import Things, Users, things, token_of, users
from test_storage import episode

__all__ = ["things", "users"]  # fixtures


def test_an_episode_for_rerun(
    users: Users, things: Things, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    header = things.episodes[1]
    url = f"{users.url}/v1/episodes/{header.id}.rrd"
    answer = httpx.get(url, headers=token_of(users.ann))
    (tmp_path / "e.rrd").write_bytes(answer.content)
    shown = Rrd(tmp_path / "e.rrd")
    assert (len(shown.recordings), len(shown.blueprints)) == (1, 1)
    with users.ann.open_recording(header.recording) as recording:
        assert shown.recordings[0].recording_id.startswith(recording.uuid)
        assert np.array_equal(shown.scalars("/reward").ravel(), recording.episodes[1].rewards)
    ticket = users.ann._session.ask("POST", "/v1/tickets", {"recording": header.recording})["path"].partition(
        "="
    )[2]
    assert httpx.get(url, params={"ticket": ticket}).content[:4] == answer.content[:4]
    other = users.ann.record_episodes([episode(things.benchmark, 7)])[0]
    refused = httpx.get(f"{users.url}/v1/episodes/{other.id}.rrd", params={"ticket": ticket})
    assert (refused.status_code, refused.json()["detail"]) == (
        401,
        "the ticket is for another recording; open it again",
    )
    monkeypatch.setitem(sys.modules, "rerun", None)
    missing = httpx.get(url, headers=token_of(users.ann))
    assert (missing.status_code, missing.json()["error"]) == (501, "MissingExtraError")
    assert "looking at recordings needs rerun-sdk: pip install" in missing.json()["detail"]
