"""Detection in recordings, videos and image files, without ROS."""
