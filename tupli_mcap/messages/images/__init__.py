"""Leaves that are images: frame stacks without repetition, PNG and JPEG.

codecs     which way a leaf is stored, and back
stack      frame stacks: each frame once
png        lossless PNG
pictures   PNG and JPEG by Pillow, for frames too
"""
