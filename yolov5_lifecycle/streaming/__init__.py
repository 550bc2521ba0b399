"""Frame pipeline: inference thread with a newest-frame slot, frame balance and rates."""
