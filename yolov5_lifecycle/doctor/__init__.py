"""The command `doctor`: checks of the machine, each with a limit of time, and their report."""
