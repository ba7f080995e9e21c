"""What Alembic runs: all revisions in the transaction that `upgrade` is called in."""

from __future__ import annotations

from alembic import context

context.configure(connection=context.config.attributes["connection"])
context.run_migrations()
