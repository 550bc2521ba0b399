"""Command `evaluate`: a model on labelled images."""
