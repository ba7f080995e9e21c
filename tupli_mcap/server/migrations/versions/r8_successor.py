"""A refresh token is exchanged again if the first answer was lost."""

from __future__ import annotations

from alembic import op
from sqlalchemy import Column, Text

revision = "8"
down_revision = "7"


def upgrade() -> None:
    """Adds a column."""
    op.add_column("refresh_token", Column("successor", Text))
