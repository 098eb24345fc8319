"""Devices behind interfaces; imports nothing of the cell."""

import os

# Read when the library is loaded: of a stream or a video whoever reads it says in one line what is
# wrong, in the library's stead.
os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
os.environ.setdefault("OPENCV_LOG_LEVEL", "ERROR")
