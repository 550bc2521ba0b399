"""Detection in many recordings: the plan, the workers, and the results."""
