# The nodes on apt's ROS 2 Jazzy. The tests do not build this image: docker/try-build does, on stand-ins of both bases, and
# docs/tested.md lists what those cannot show.
#
#   docker build -t yolov5_lifecycle .
#   docker run --rm --network host --ipc host -v yolov5_weights:/home/ubuntu/.ros/yolov5 yolov5_lifecycle fetch_weights n
#   docker run --rm --network host --ipc host -v yolov5_weights:/home/ubuntu/.ros/yolov5 yolov5_lifecycle
#
# For a reproducible base, give both bases by digest, ros@sha256:...; apt keeps no old versions to pin.
ARG BUILD_BASE=ros:jazzy-ros-base
ARG BASE=ros:jazzy-ros-core

FROM ${BUILD_BASE} AS build
# hadolint ignore=DL3008
RUN apt-get update \
 && apt-get install -y --no-install-recommends python3-numpy python3-venv \
 && rm -rf /var/lib/apt/lists/*
# torch, pydantic 2 and safetensors are not in apt. The environment sees apt's packages and uses apt's numpy.
# TORCH=cpu installs the CPU build of torch, from the same index as the Makefile; otherwise the image includes CUDA.
ARG TORCH=""
ARG PIP_FLAGS=""
WORKDIR /workspace/src/yolov5_lifecycle
COPY requirements requirements
RUN python3 -m venv --system-site-packages /opt/venv \
 && if [ "${TORCH}" = cpu ]; then /opt/venv/bin/pip install --no-cache-dir ${PIP_FLAGS} --no-deps \
      --index-url https://download.pytorch.org/whl/cpu -c requirements/constraints-apt.txt torch; \
    elif [ -n "${TORCH}" ]; then echo "TORCH=${TORCH}: expected cpu, or nothing for pip's usual build" >&2; exit 1; fi \
 && /opt/venv/bin/pip install --no-cache-dir ${PIP_FLAGS} -c requirements/constraints-apt.txt \
      h11 onnx onnxruntime prometheus-client pydantic safetensors starlette torch uvicorn websockets
COPY . .
WORKDIR /workspace
# The interpreter that runs colcon is written into the executables' first line: use this environment's, which has torch.
# Look for what the entry point runs, because colcon also succeeds when it finds no package or lacks an extension.
RUN . /opt/ros/jazzy/setup.sh && /opt/venv/bin/python /usr/bin/colcon build \
 && for made in install/setup.bash install/yolov5_lifecycle/lib/yolov5_lifecycle/detector; do \
      if [ ! -f "${made}" ]; then \
        echo "colcon made no ${made}. Has BUILD_BASE python3-colcon-common-extensions?" >&2; exit 1; fi; done

FROM ${BASE}
# hadolint ignore=DL3008
RUN apt-get update \
 && apt-get install -y --no-install-recommends \
      python3-numpy python3-opencv python3-scipy python3-yaml \
      ros-jazzy-bond ros-jazzy-rmw-fastrtps-cpp ros-jazzy-tf2-ros-py ros-jazzy-vision-msgs \
 && rm -rf /var/lib/apt/lists/*
COPY --from=build /opt/venv /opt/venv
COPY --from=build /workspace/install /workspace/install
COPY docker/entrypoint /entrypoint

# UID 1000 is the user ubuntu of Ubuntu 24.04; Kubernetes needs the number. To share memory with nodes on the host,
# run as their user: --user.
RUN install -d -o ubuntu -g ubuntu /home/ubuntu/.ros /home/ubuntu/.ros/yolov5
USER 1000
ENV HOME=/home/ubuntu
VOLUME /home/ubuntu/.ros/yolov5

ENV YOLOV5_NODE=/yolov5
# Half a second, ros2's default, is often too short on a busy machine: then the node is not found.
HEALTHCHECK --interval=30s --timeout=20s --start-period=60s \
  CMD ["/entrypoint", "bash", "-c", "ros2 lifecycle get --no-daemon --spin-time 5 $YOLOV5_NODE | grep -q '^active'"]
ENTRYPOINT ["/entrypoint"]
CMD ["detector", "--ros-args", "-p", "autostart:=true"]
