"""Users and their rights.

access      rights, roles, and the one condition for what a caller may read
accounts    users, groups, roles
tokens      tokens with which users and machines identify themselves
limits      how often sign-ins may fail, and how much each user may ask and store
"""
