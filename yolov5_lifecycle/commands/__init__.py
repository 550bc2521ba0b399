"""Command-line tools other than the nodes, and their shared code."""
