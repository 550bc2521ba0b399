"""Long trials of the detector's process: hostile neighbours, faults, signals, many lives. `make soak`."""
