"""One image in, detections out."""
