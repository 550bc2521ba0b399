"""Decoding of raw and compressed images to pixels (H, W, 3)."""
