"""Where detections are in space: depth images, camera intrinsics, distances, pairing by stamp."""
