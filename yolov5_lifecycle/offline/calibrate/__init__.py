"""Command `calibrate`: activation ranges for int8, and what int8 is worth."""
