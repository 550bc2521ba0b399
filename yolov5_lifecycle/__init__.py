"""YOLOv5 object detection as a ROS 2 lifecycle node."""
