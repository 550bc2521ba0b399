"""int8 on a CPU: activation ranges, the file that keeps them, and when they are worth using."""
