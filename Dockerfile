# The node on apt's ROS 2 Jazzy. Never built by the tests, which have no container engine: read it as a recipe. What the
# tests do check, with the same numpy and OpenCV, is `make test SET=apt`; and colcon builds this folder in every run.
#
#   docker build -t yolov5_lifecycle .
#   docker run --rm --network host --ipc host yolov5_lifecycle
#   ros2 lifecycle set /yolov5 configure
FROM ros:jazzy-ros-base

RUN apt-get update \
 && apt-get install -y --no-install-recommends \
      python3-opencv python3-venv ros-jazzy-rmw-fastrtps-cpp ros-jazzy-vision-msgs \
 && rm -rf /var/lib/apt/lists/*

# torch, pydantic 2 and safetensors are not in apt. The environment sees apt's packages, and its numpy stays apt's.
# PIP_FLAGS tells pip where to find the CPU build of torch; without it the image holds CUDA as well.
ARG PIP_FLAGS=""
WORKDIR /workspace/src/yolov5_lifecycle
COPY requirements requirements
RUN python3 -m venv --system-site-packages /opt/venv \
 && /opt/venv/bin/pip install --no-cache-dir ${PIP_FLAGS} -c requirements/constraints-apt.txt pydantic safetensors torch

COPY . .
WORKDIR /workspace
# The interpreter that runs colcon goes into the first line of the executables: this environment's, which has torch.
RUN . /opt/ros/jazzy/setup.sh && /opt/venv/bin/python /usr/bin/colcon build

RUN sed -i '$ i source /workspace/install/setup.bash' /ros_entrypoint.sh
CMD ["ros2", "run", "yolov5_lifecycle", "detector"]
