"""The pages of a server: those of `tupli_mcap.page` for signed-in users, and pages about people.

shelf      the shelf of what a caller may read
session    sign-in by a cookie; forms and their protection
account    `/`, signing in and out; `/account`: the password, tokens for machines
people     `/users`, `/groups`
sharing    `/share`: who sees a dataset; `/upload`
"""

from tupli_mcap.server.pages import account, people, sharing

__all__ = ["PAGES"]

PAGES = (account.router, people.router, sharing.router)
