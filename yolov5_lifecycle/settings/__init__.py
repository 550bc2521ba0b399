"""User settings, their validation rules and ROS parameter files."""
