"""Coverage-guided fuzzing of the readers of untrusted data. `make fuzz`."""

from yolov5_lifecycle.process.environment import prepare_environment

prepare_environment()  # as in the commands; child processes inherit it
