"""What must hold for any bytes, for each reader of what comes from outside."""

from __future__ import annotations

import json
import struct
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from functools import partial
from typing import TypeVar

import hostile_archives
import hostile_safetensors
import torch
from compressed_files import KINDS, compressed

from yolov5_lifecycle.checkpoint import read_checkpoint
from yolov5_lifecycle.compressed_image import MAX_COMPRESSED_PX, decode_compressed
from yolov5_lifecycle.images import MAX_SIDE_PX, ImageError
from yolov5_lifecycle.model import Model, WeightsError
from yolov5_lifecycle.network import Network
from yolov5_lifecycle.parameter_file import ParameterFileError, assigned_value
from yolov5_lifecycle.raw_image import ENCODINGS, decode_raw
from yolov5_lifecycle.safetensors_file import read_safetensors
from yolov5_lifecycle.settings import SETTINGS, SettingsError, validated

Taken = TypeVar("Taken")
Refusal = TypeVar("Refusal", bound=Exception)

_RAW_IMAGE = struct.Struct("<BBHHI")
"""Number of the encoding, byte order, height, width and step; the pixels follow."""


@dataclass(frozen=True)
class Target:
    """`check` takes any bytes and raises AssertionError when they were taken wrongly.

    `seeds` are bytes that are taken well, to begin with.
    """

    check: Callable[[bytes], None]
    seeds: Callable[[], Iterable[bytes]]


def check_compressed_image(data: bytes) -> None:
    """A picture within the limits, or one line that says why not."""
    picture = _taken(lambda: decode_compressed(data), ImageError)
    if isinstance(picture, ImageError):
        assert str(picture).isprintable()
        return
    height, width = picture.size_hw
    assert max(height, width) <= MAX_SIDE_PX
    assert height * width <= MAX_COMPRESSED_PX


def check_raw_image(data: bytes) -> None:
    """A picture of the size that the message claims, or one line that says why not."""
    if len(data) < _RAW_IMAGE.size:
        return
    number, is_bigendian, height, width, step = _RAW_IMAGE.unpack_from(data)
    names = [*ENCODINGS, "unknown"]
    decode = partial(
        decode_raw,
        data[_RAW_IMAGE.size :],
        encoding=names[number % len(names)],
        height=height,
        width=width,
        step=step,
        is_bigendian=bool(is_bigendian),
    )
    picture = _taken(decode, ImageError)
    if isinstance(picture, ImageError):
        assert str(picture).isprintable()
        return
    assert picture.size_hw == (height, width)
    assert len(picture.pixels.tobytes()) == 3 * height * width  # every byte of it can be read


def check_weights(read: Callable[[bytes], Model], data: bytes) -> None:
    """A model that is whole, or one line that says why not."""
    model = _taken(lambda: read(data), WeightsError)
    if isinstance(model, WeightsError):
        assert str(model).isprintable()
        return
    network = Network(model.architecture).eval()
    network.load_state_dict(model.state_dict, strict=True)
    assert len(model.class_names) == model.architecture.classes
    assert all(bool(torch.isfinite(tensor).all()) for tensor in model.state_dict.values())
    side = max(model.architecture.strides)
    assert network(torch.zeros(1, 3, side, side)).shape[2] == 5 + model.architecture.classes


def check_checkpoint(data: bytes) -> None:
    """`data` as the pickle of an archive that is whole."""
    check_weights(read_checkpoint, hostile_archives.with_pickle(data))


def check_safetensors(data: bytes) -> None:
    """`data` as the header of a file that is whole."""
    _, tensors = hostile_safetensors.cut(hostile_safetensors.valid())
    check_weights(read_safetensors, hostile_safetensors.glued(data, tensors))


def check_settings(data: bytes) -> None:
    """Lines of NAME=VALUE: settings that stay the same when checked again, or what is wrong with them."""
    lines = data.decode(errors="replace").split("\n")
    values = _taken(lambda: dict(map(assigned_value, lines)), ParameterFileError)
    if isinstance(values, ParameterFileError):
        assert str(values).isprintable()
        return
    settings = _taken(lambda: validated(values), SettingsError)
    if isinstance(settings, SettingsError):
        assert settings.problems
        assert all(len(problem.message) < 500 for problem in settings.problems)
        return
    assert validated(settings.model_dump()) == settings


def _taken(take: Callable[[], Taken], refusal: type[Refusal]) -> Taken | Refusal:
    """What is made of the bytes, or how they are refused; any other exception escapes."""
    try:
        return take()
    except refusal as error:
        return error


def _raw_images() -> Iterator[bytes]:
    """A grey picture in each encoding."""
    side = 4
    for number, layout in enumerate(ENCODINGS.values()):
        step = side * layout.pixel_bytes
        fields = _RAW_IMAGE.pack(number, False, side, side, step)
        yield fields + bytes([128]) * int(side * layout.rows * step)


def _header() -> bytes:
    text, _ = hostile_safetensors.cut(hostile_safetensors.valid())
    return text


def _defaults() -> bytes:
    return "\n".join(f"{setting.name}={json.dumps(setting.default)}" for setting in SETTINGS).encode()


TARGETS = {
    "compressed-images": Target(check_compressed_image, lambda: map(compressed, KINDS)),
    "raw-images": Target(check_raw_image, _raw_images),
    "checkpoints": Target(check_checkpoint, lambda: [hostile_archives.valid_pickle()]),
    "safetensors": Target(check_safetensors, lambda: [_header()]),
    "settings": Target(check_settings, lambda: [_defaults()]),
}
