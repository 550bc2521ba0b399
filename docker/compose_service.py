"""Arguments of `docker run`, one a line, for a service of the compose.yaml on stdin. For docker/try-image.

Its own arguments: the name of the service, and what to put before the names of volumes.
"""

from __future__ import annotations

import shlex
import sys

import yaml

service = yaml.safe_load(sys.stdin)["services"][sys.argv[1]]
words = ["--network", service["network_mode"], "--ipc", service["ipc"]]
for name, value in service["environment"].items():
    words += ["--env", name if value.startswith("${") else f"{name}={value}"]
for volume in service.get("volumes", []):
    words += ["--volume", sys.argv[2] + volume]
words += [service["image"], *shlex.split(service["command"])]
sys.stdout.writelines(f"{word}\n" for word in words)
