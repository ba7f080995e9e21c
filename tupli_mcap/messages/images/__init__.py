"""Image leaves: stacks of frames, PNG and JPEG.

codecs     the codecs of image channels: stacks of frames, each of which is stored once, and PNG
pictures   encodes and decodes PNG and JPEG with Pillow, for rendered frames too
"""
