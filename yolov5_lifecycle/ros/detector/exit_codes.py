"""Exit codes with which the detector's process asks its supervisor for another process."""

from __future__ import annotations

EXIT_DEVICE_LOST = 3
"""The GPU is lost; restart the process."""

EXIT_ABANDONED_THREADS = 4
"""Too many inference threads hang; restart the process, which frees their memory."""
