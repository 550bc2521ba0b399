"""The console: detectors in a web browser, through ordinary ROS topics and services only."""
