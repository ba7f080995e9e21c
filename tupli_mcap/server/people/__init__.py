"""Users and their rights.

access      rights, roles, and the one condition for what a caller may read
accounts    users, groups, roles
tokens      tokens with which users and machines identify themselves
quotas      how much each user may store
throttle    limits failed sign-ins
"""
