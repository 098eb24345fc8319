"""Measurements in a folder (cable-study/1): data classes, reader, writer."""
