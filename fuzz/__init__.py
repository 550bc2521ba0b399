"""Coverage-guided fuzzing of all code that reads untrusted data: `make fuzz`."""

from yolov5_lifecycle.process.environment import prepare_environment

prepare_environment()  # as in the commands; child processes inherit it
