"""Values of variable size: Text, Sequence, Graph, OneOf, and the Dicts and Tuples inside them.

codec           makes the codec of a space: encode, decode, schema; finds leaves that need a wider dtype than declared
leaf_codecs     numbers and Text
nested_codecs   Tuple, Dict, Sequence, Graph, OneOf
"""
