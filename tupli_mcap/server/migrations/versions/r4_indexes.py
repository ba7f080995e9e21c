"""Episodes are found by their length, their return, and when they ended."""

from __future__ import annotations

from alembic import op

revision = "4"
down_revision = "3"


def upgrade() -> None:
    """Adds three indexes."""
    for name in ("n_tuples", "episode_return", "created_at"):
        op.create_index(f"ix_episode_{name}", "episode", [name, "id"])
