"""Users, groups, roles and tokens of a server: methods of `TupliAPIClient`."""

from __future__ import annotations

import contextlib
from urllib.parse import quote

from tupli_mcap.errors import StorageError, TupliError
from tupli_mcap.schema import (
    ApiToken,
    Group,
    GroupMembershipQuery,
    GroupWithMembers,
    ListedUser,
    Me,
    UserOut,
    UserRole,
)
from tupli_mcap.storage.api.answers import SignInError, as_told
from tupli_mcap.storage.api.session import Session


class People:
    """Methods for the people of a server. Every method raises StorageError if the user lacks the right."""

    _session: Session

    # --- users ---

    def signup(self, username: str, password: str) -> UserOut:
        """Create a user. Everybody may if the server is open to sign-ups; else it takes the right `user_create`."""
        wanted = {"username": username, "password": password}
        try:
            try:
                return as_told(UserOut, self._session.ask("POST", "/v1/users", wanted))
            except SignInError:  # an expired token would be refused, but no token is needed
                return as_told(UserOut, self._session.ask("POST", "/v1/users", wanted, anonymous=True))
        except TupliError as err:
            raise StorageError(f"Signup failed: {err}") from err

    def whoami(self) -> Me:
        """Who is signed in, and how much they have stored."""
        return as_told(Me, self._session.ask("GET", "/v1/me"))

    def list_users(self) -> list[ListedUser]:
        """All users; for callers with the right `user_update`, with what they have stored, and may store (bytes)."""
        return as_told(list[ListedUser], self._session.ask("GET", "/v1/users"))

    def change_password(self, username: str, new_password: str, *, old: str | None = None) -> None:
        """Change a user's password; for your own, `old` is needed. All sign-ins of the user end."""
        wanted = {"password": new_password, "old": old}
        self._session.ask("PUT", f"/v1/users/{_name(username)}/password", wanted)

    def set_quota(self, username: str, quota: int | None) -> None:
        """Set how many bytes a user may store; None for as many as the server lets everybody. It takes the right
        `user_update`. NotFoundError if there is no such user."""
        self._session.ask("PUT", f"/v1/users/{_name(username)}/quota", {"bytes": quota})

    def delete_user(self, username: str) -> None:
        """Delete a user, and what only they could see; what they published stays. Nothing happens if there is none."""
        self._session.ask("DELETE", f"/v1/users/{_name(username)}")

    # --- groups ---

    def create_group(self, group: Group | str) -> Group:
        """Create a group with you as its admin. `group`: a Group, or just its name."""
        wanted = Group(name=group) if isinstance(group, str) else group
        return as_told(Group, self._session.ask("POST", "/v1/groups", wanted.model_dump()))

    def list_groups(self) -> list[Group]:
        """The groups that you may see."""
        return as_told(list[Group], self._session.ask("GET", "/v1/groups"))

    def read_group(self, group_name: str) -> GroupWithMembers:
        """A group and its members."""
        return as_told(GroupWithMembers, self._session.ask("GET", f"/v1/groups/{_name(group_name)}"))

    def delete_group(self, group_name: str) -> None:
        """Delete a group; what was published in it is then seen only by its owners."""
        self._session.ask("DELETE", f"/v1/groups/{_name(group_name)}")

    def add_group_members(self, group_membership_query: GroupMembershipQuery) -> GroupWithMembers:
        """Give users further roles in a group: all of them, or none."""
        wanted = [member.model_dump(exclude_none=True) for member in group_membership_query.members]
        path = f"/v1/groups/{_name(group_membership_query.group_name)}/members"
        return as_told(GroupWithMembers, self._session.ask("PUT", path, wanted))

    def remove_group_members(self, group_membership_query: GroupMembershipQuery) -> GroupWithMembers:
        """Remove users from a group, with all of their roles; users who are not in it are ignored."""
        name = group_membership_query.group_name
        for member in group_membership_query.members:
            self._session.ask("DELETE", f"/v1/groups/{_name(name)}/members/{_name(member.user)}")
        return self.read_group(name)

    # --- roles ---

    def create_role(self, role: UserRole) -> UserRole:
        """Create a role. It takes the right `role_management`, as deleting one does."""
        return as_told(UserRole, self._session.ask("POST", "/v1/roles", role.model_dump(mode="json")))

    def list_roles(self) -> list[UserRole]:
        """All roles. It takes the right `role_management`."""
        return as_told(list[UserRole], self._session.ask("GET", "/v1/roles"))

    def delete_role(self, role_name: str) -> None:
        """Delete a role, and take it from all who have it; nothing happens if there is no such role."""
        self._session.ask("DELETE", f"/v1/roles/{_name(role_name)}")

    # --- tokens for machines ---

    def create_token(self, name: str, scope: str = "read", days: int | None = 90) -> ApiToken:
        """Create a token that gives a machine your rights. On the machine, put it into TUPLI_MCAP_TOKEN.

        scope: "read", or "write" to read and write. days: how long it is valid; None for ever.

        Returns:
            The token. Only this result contains its text.
        """
        wanted = {"name": name, "scope": scope, "days": days}
        made = self._session.ask("POST", "/v1/api-tokens", wanted)
        try:
            return as_told(ApiToken, made)
        except StorageError:  # of a server of another version: nobody would see this token
            with contextlib.suppress(TupliError, AttributeError):
                self.delete_token(made.get("id"))
            raise

    def list_tokens(self) -> list[ApiToken]:
        """Your tokens for machines."""
        return as_told(list[ApiToken], self._session.ask("GET", "/v1/api-tokens"))

    def delete_token(self, token_id: str) -> None:
        """Revoke one of your tokens. NotFoundError if there is none with this id."""
        self._session.ask("DELETE", f"/v1/api-tokens/{_name(token_id)}")


def _name(name: str) -> str:
    """A name, quoted for a path."""
    return quote(str(name), safe="")
