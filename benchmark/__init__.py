"""How fast the project is, beside what its users could take instead."""
