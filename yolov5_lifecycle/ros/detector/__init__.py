"""The detector, a managed lifecycle node."""
