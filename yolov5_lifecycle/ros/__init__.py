"""ROS 2 code; the only folder that imports rclpy and message packages."""
