"""The console: detectors in a web browser, through the topics and services that every node of ROS may use."""
