"""The ROS 2 side: the only folder that knows rclpy and messages."""
