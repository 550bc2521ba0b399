"""YOLOv5: architecture, network and the model of a weights file."""
