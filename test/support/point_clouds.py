"""What subscribers of point clouds make of them: the values of the points, and a costmap of Nav2."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sensor_msgs.msg import PointCloud2, PointField

_TYPES = {PointField.FLOAT32: "f4", PointField.UINT32: "u4"}


def points_of(cloud: PointCloud2) -> NDArray[Any]:
    """A record (n,) for each point, with the fields that the message names."""
    assert cloud.row_step == cloud.point_step * cloud.width
    assert len(cloud.data) == cloud.row_step * cloud.height
    order = ">" if cloud.is_bigendian else "<"
    layout = np.dtype(
        {
            "names": [each.name for each in cloud.fields],
            "formats": [order + _TYPES[each.datatype] for each in cloud.fields],
            "offsets": [each.offset for each in cloud.fields],
            "itemsize": cloud.point_step,
        }
    )
    return np.frombuffer(bytes(cloud.data), layout)


@dataclass
class Costmap:
    """Cells that Nav2's obstacle layer marks and clears, by the rules that its page documents.

    An update clears the cells on the rays from the sensor to the points of a clearing source, and marks those
    below the points of a marking source whose height and distance are within the limits.
    docs.nav2.org/configuration/packages/costmap-plugins/obstacle.html
    """

    camera_height_m: float
    """Above the floor; the camera looks along x, level."""
    resolution_m: float = 0.05
    min_obstacle_height: float = 0.1
    max_obstacle_height: float = 2.0
    obstacle_max_range: float = 5.0
    is_marked: NDArray[np.bool_] = field(default_factory=lambda: np.zeros((200, 200), np.bool_))
    """Cells ahead of the robot, and from right to left, the robot in the middle."""

    def update(self, marking: PointCloud2, clearing_xyz_m: NDArray[np.float64]) -> None:
        ends = self._in_base(clearing_xyz_m)[:, :2]
        on_rays = np.linspace(0, 0.99, 300)[:, None, None] * ends
        self.is_marked[self._cells(on_rays.reshape(-1, 2))] = False
        values = points_of(marking)
        xyz_m = self._in_base(np.stack([values[axis] for axis in "xyz"], axis=1))
        height, distance = xyz_m[:, 2], np.hypot(*xyz_m[:, :2].T)
        is_obstacle = (height >= self.min_obstacle_height) & (height <= self.max_obstacle_height)
        self.is_marked[self._cells(xyz_m[is_obstacle & (distance <= self.obstacle_max_range), :2])] = True

    def _in_base(self, xyz_m: NDArray[Any]) -> NDArray[Any]:
        """Points (n, 3) of the optical frame: ahead, left and above the floor."""
        return np.stack((xyz_m[:, 2], -xyz_m[:, 0], self.camera_height_m - xyz_m[:, 1]), axis=1)

    def _cells(self, xy_m: NDArray[Any]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        ahead, left = np.floor(xy_m / self.resolution_m).astype(np.intp).T
        return ahead, left + self.is_marked.shape[1] // 2
