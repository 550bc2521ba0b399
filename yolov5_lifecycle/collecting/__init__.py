"""Frames that are worth a label: why one is kept, and the folder in which it is kept."""
