"""Who asks, and what they may do.

access      rights, roles, and the one condition for what a caller may read
accounts    users, groups, roles
tokens      how users and machines prove who they are
quotas      how much each may keep
throttle    passwords are not tried too often
"""
