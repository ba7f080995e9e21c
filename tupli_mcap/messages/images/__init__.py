"""Image leaves: stacks of frames, PNG and JPEG.

codecs     chooses the codec of a channel
stack      stacks of frames: each frame is stored once
png        images as PNG
pictures   encodes and decodes PNG and JPEG with Pillow, for rendered frames too
"""
