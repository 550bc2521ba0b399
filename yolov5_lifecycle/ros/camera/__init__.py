"""The camera, a node that publishes images from a source."""
