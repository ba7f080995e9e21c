"""Gymnasium spaces.

leaves       the arrays and scalars that a value of a space is made of
space_json   a space as JSON, and back; space_fields has the parts of it that are numbers
labels       names for the actions and dimensions that people know, and for each number of a leaf
exact        casts of values to leaves that lose nothing, or refuse
"""
