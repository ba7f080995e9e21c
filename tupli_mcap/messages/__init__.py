"""The messages of a recording, one module for each kind: schema, encoding and decoding side by side.

layout                 CDR offsets, ros2msg definitions and NumPy dtypes of messages of constant size
topics                 the topics of channels
step                   the layout of `/step`: the offset of each leaf of state, action and reward
encode_rows            the generated functions that write a step into a row and commit it
encode_values          the part of these functions that checks and packs one value
decoder                decodes messages of variable size: one, or many at once
episodes               `/episode_start`, `/episode_end`, `/final_state`
infos, frames          `/info`, and infos as columns; `/camera` and `/frame`
images/                image leaves: stacks, PNG, JPEG
variable/              Text, Sequence, Graph and OneOf
shared_dtypes          one dtype for values of several recordings
cdr                    the primitives of CDR
"""
