"""The class names of a detector's model, from what it publishes about them."""

from __future__ import annotations

from yolov5_lifecycle.printable import in_one_line
from yolov5_lifecycle.ros.console.serialized_message import SerializedMessage

_MAX_CLASSES = 10_000
_MAX_NAME = 200
_MAX_LENGTH = 256 * 1024
"""Characters of all names; a page could not send more of them."""


def read_class_names(content: bytes) -> list[str]:
    """The names in a serialized vision_msgs/LabelInfo, printable; those beyond the limits are left out.

    Raises UnreadableError.
    """
    message = SerializedMessage(content)
    message.time_s(), message.text(0)
    names, length = list[str](), 0
    for _ in range(min(message.count(), _MAX_CLASSES)):
        message.class_id()
        name = in_one_line(message.text(_MAX_NAME), _MAX_NAME)
        length += len(name)
        if length > _MAX_LENGTH:
            break
        names.append(name)
    return names
