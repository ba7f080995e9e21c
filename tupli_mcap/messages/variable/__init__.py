"""Values of variable size: Text, Sequence, Graph, OneOf, and what holds them.

codec           a space's codec: encode, decode, schema
leaf_codecs     constant leaves and Text
nested_codecs   Tuple, Dict, Sequence, Graph, OneOf
widening        how several values become one array
"""
