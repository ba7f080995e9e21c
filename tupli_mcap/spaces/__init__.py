"""Gymnasium spaces.

leaves       the arrays and scalars that a value of a space is made of
space_json   a space as JSON, and back
labels       names of actions and dimensions, for people
exact        casts values to leaves exactly, or refuses
statistics   statistics of the values of a leaf
"""
