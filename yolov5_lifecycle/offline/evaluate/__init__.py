"""Command `evaluate`: a model on labelled images and recordings."""
