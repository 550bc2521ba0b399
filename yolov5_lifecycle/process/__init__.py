"""Process setup: environment variables, standard streams, signals, threads and memory."""
