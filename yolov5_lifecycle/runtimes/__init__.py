"""Ways to execute a network, one file each, with the same call."""
