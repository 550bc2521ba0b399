"""YOLOv5 object detection as a ROS 2 lifecycle node."""

import os

# OpenMP reads this when torch is imported. By default its threads spin at every barrier: beside other busy
# processes, as on a robot, yolov5n at 384x640 then took 1.3 to 4.9 s on two cores instead of 0.05 to 0.1 s.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
