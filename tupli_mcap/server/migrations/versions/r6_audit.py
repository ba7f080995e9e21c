"""It is counted how often a user has done something."""

from __future__ import annotations

from alembic import op

revision = "6"
down_revision = "5"


def upgrade() -> None:
    """Adds an index."""
    op.create_index("ix_audit_user_action", "audit", ["user", "action"])
