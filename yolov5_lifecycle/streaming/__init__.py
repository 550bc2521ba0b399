"""Frames over time: one inference thread serves the cameras in turn; balance and rates of each."""
