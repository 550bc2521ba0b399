"""Image sources of a camera: synthetic scenes, devices, videos, streams and folders."""
