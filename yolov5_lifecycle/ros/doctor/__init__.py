"""The checks of `doctor` that concern ROS."""
