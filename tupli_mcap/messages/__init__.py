"""The messages of a recording, a kind a module: schema, encoding and decoding side by side.

layout                 CDR offsets, ros2msg definitions and NumPy dtypes of a message of constant size
topics                 what each channel is called
step                   the layout of `/step`: where each leaf of state, action and reward lies
encode_rows            the generated function that writes a step into a row, and commits it
decoder                messages of variable size back to values: one, or many at once
episodes               `/episode_start`, `/episode_end`, `/final_state`
infos, frames          `/info`; `/camera` and `/frame`
images/                leaves that are images: how they are compressed
variable/              Text, Sequence, Graph and OneOf
encode_values          the part of that function that checks and packs one value
shared_dtypes          one dtype for values of several recordings
cdr                    the encoding of primitives
"""
