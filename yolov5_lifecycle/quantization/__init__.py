"""int8 on a CPU: activation ranges, and the file that keeps them."""
