"""Coverage-guided search for bytes that the readers of foreign data do not expect. `make fuzz`."""
