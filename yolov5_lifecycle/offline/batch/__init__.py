"""Detection in many recordings: what is done, by whom, and what became of it."""
