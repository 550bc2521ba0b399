"""Detections over time: objects that keep their identity."""
