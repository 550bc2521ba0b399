"""Frames over time: one inference thread serves the cameras in turns; balance and rates of each."""
