"""YOLOv5 object detection as a ROS 2 lifecycle node."""

import os

# OpenMP reads this when torch is imported. By default its threads spin at every barrier: beside other busy
# processes, as on a robot, yolov5n at 384x640 then took 1.3 to 4.9 s on two cores instead of 0.05 to 0.1 s.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

# numpy reads this when it is imported. By default the threads of its OpenBLAS spin for milliseconds after
# each product of matrices, while the network waits: one picture then took 22 to 30 ms instead of 16.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
