"""Weights files: location, validation and loading, without executing anything in them."""
