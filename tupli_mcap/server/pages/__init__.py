"""The page of a server: what `tupli_mcap.page` shows, for who is signed in, and the pages about people.

shelf      what a caller may read, as a shelf of the page
session    who asks: the cookie of a sign-in, and forms that nobody else can send
entrance   `/`, signing in and out
account    `/account`: the password, tokens of machines
people     `/users`, `/groups`
sharing    `/share`: who sees a dataset; `/upload`
forms      what these pages have in common
"""

from tupli_mcap.server.pages import account, entrance, people, sharing

__all__ = ["PAGES"]

PAGES = (entrance.router, account.router, people.router, sharing.router)
