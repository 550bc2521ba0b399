# The image with systemd in it, for docker/try-units.
ARG IMAGE=localhost/yolov5_lifecycle
FROM ${IMAGE}
# hadolint ignore=DL3002
USER 0
# hadolint ignore=DL3008
RUN apt-get update \
 && apt-get install -y --no-install-recommends systemd \
 && rm -rf /var/lib/apt/lists/*
