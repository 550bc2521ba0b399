"""The formats in which `detect_bag` writes detections besides recordings."""
