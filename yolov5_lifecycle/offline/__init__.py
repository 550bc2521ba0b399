"""Detection in what was recorded, without ROS."""
