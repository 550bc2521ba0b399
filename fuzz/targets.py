"""Fuzz targets: invariants of everything that reads external data, for any bytes."""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from functools import cache, partial

import cv2
import numpy as np
import torch
from support import hostile_archives, hostile_onnx, hostile_safetensors
from support import pickle_assembler as asm
from support.checkpoint_builder import SMALL, official_model, saved, stripped
from support.compressed_files import image_file, smooth_bgr
from support.hostile_images import HOSTILE_JPEGS, HOSTILE_PNGS
from support.random_model import random_model
from support.small_families import COSTLY, EVERY_SMALL

from fuzz import files
from fuzz.files import taken
from yolov5_lifecycle.checkpoints.onnx_file import export_cost, read_onnx
from yolov5_lifecycle.checkpoints.pt_file import read_checkpoint
from yolov5_lifecycle.checkpoints.safetensors_file import read_safetensors
from yolov5_lifecycle.images.compressed import decode_compressed
from yolov5_lifecycle.images.encodings import ENCODINGS, decode_raw
from yolov5_lifecycle.images.image import MAX_SIDE_PX, ImageError
from yolov5_lifecycle.models.architecture import Architecture
from yolov5_lifecycle.models.class_names import MAX_NAME_LENGTH
from yolov5_lifecycle.models.cost import size_multiple
from yolov5_lifecycle.models.head import Segment
from yolov5_lifecycle.models.model import MAX_CLASSES, Export, Model, WeightsError
from yolov5_lifecycle.models.network import Network
from yolov5_lifecycle.printable import in_one_line
from yolov5_lifecycle.process.environment import MAX_COMPRESSED_PX

_MAX_SEED_BYTES = 4096
_PROTOCOLS = (2, 4, 5)
_RAW_IMAGE = struct.Struct("<BBHHI")
"""Index of the encoding, byte order, height, width and step; the pixels follow."""


@dataclass(frozen=True)
class Target:
    """A fuzz target: `check` accepts any bytes and raises AssertionError if an invariant is violated.

    `seeds` is the initial corpus.
    """

    check: Callable[[bytes], None]
    seeds: Callable[[], Iterable[bytes]]


def check_compressed_image(data: bytes) -> None:
    """Expect an image within the limits, or a one-line error."""
    try:
        height, width = decode_compressed(data).size_hw
    except ImageError as error:
        assert str(error).isprintable()
        assert "as its header says" not in str(error), "OpenCV must not decode what was not checked"
    else:
        assert max(height, width) <= MAX_SIDE_PX
        assert height * width <= MAX_COMPRESSED_PX


def check_raw_image(data: bytes) -> None:
    """Expect an image of the size in the message, or a one-line error."""
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
    if image := taken(decode, ImageError):
        assert image.size_hw == (height, width)
        assert len(image.pixels.tobytes()) == 3 * height * width  # every byte of it can be read


def check_weights(read: Callable[[bytes], Model], data: bytes) -> None:
    """Expect a complete model, or a one-line error."""
    model = taken(lambda: read(data), WeightsError)
    if model is None:
        return
    network = Network(model.architecture).eval()
    network.load_state_dict(model.state_dict, strict=True)
    assert len(model.class_names) == model.architecture.classes
    assert all(in_one_line(name) == name and 0 < len(name) <= MAX_NAME_LENGTH for name in model.class_names)
    assert all(bool(torch.isfinite(tensor).all()) for tensor in model.state_dict.values())
    architecture, side = model.architecture, size_multiple(model.architecture)
    features = network.features(torch.zeros(1, architecture.image_channels, side, side))
    outputs = 5 + architecture.classes + architecture.mask_coefficients
    assert network.predictions(features).shape[2] == outputs
    if isinstance(network.head, Segment):
        assert network.head.proto(features[0]).shape[1] == architecture.mask_coefficients


def check_checkpoint(data: bytes) -> None:
    """Check `data` as the pickle of an otherwise valid archive."""
    check_weights(read_checkpoint, hostile_archives.with_pickle(data))


def check_family(data: bytes) -> None:
    """Check `data` after its first byte, which selects a family of models, as the pickle of such a file."""
    files = _families()
    if data:
        check_weights(read_checkpoint, hostile_archives.with_pickle(data[1:], files[data[0] % len(files)]))


@cache
def _families() -> list[bytes]:
    """A file for each kind of layer."""
    return [saved(stripped(official_model(architecture))) for architecture in EVERY_SMALL.values()]


def check_safetensors(data: bytes) -> None:
    """Check `data` as the header of an otherwise valid file."""
    _, tensors = hostile_safetensors.cut(hostile_safetensors.valid())
    check_weights(read_safetensors, hostile_safetensors.glued(data, tensors))


def check_export(data: bytes) -> None:
    """Check `data` as the graph of an otherwise valid ONNX file, without its weights."""
    check_onnx(hostile_onnx.glued(data))


def check_onnx(data: bytes) -> None:
    """Expect an export whose outputs are known, or a one-line error."""
    export = taken(lambda: read_onnx(data), WeightsError)
    if export is None:
        return
    assert isinstance(export, Export)
    assert 0 < len(export.class_names) <= MAX_CLASSES
    assert (export.prototypes is None) == (export.mask_coefficients == 0)
    side = export.size_hw or (128 // export.stride * export.stride or export.stride,) * 2
    assert export_cost(export, side).weight_bytes < 4 * len(data)


def _compressed_images() -> Iterator[bytes]:
    """Complete files, and small ones in unusual forms."""
    colour = smooth_bgr(9, 12)
    for values in (colour, colour[..., 0], colour.astype(np.uint16) * 257):
        yield image_file(".png", values)
    for flags in ((), (cv2.IMWRITE_JPEG_PROGRESSIVE, 1)):
        yield image_file(".jpg", colour, *flags)
    for data, _ in [*HOSTILE_JPEGS.values(), *HOSTILE_PNGS.values()]:
        if len(data) <= _MAX_SEED_BYTES:
            yield data


def _raw_images() -> Iterator[bytes]:
    """A grey image in each encoding."""
    side = 4
    for number, layout in enumerate(ENCODINGS.values()):
        step = side * layout.pixel_bytes
        fields = _RAW_IMAGE.pack(number, False, side, side, step)
        yield fields + bytes([128]) * int(side * layout.rows * step)


def _pickles() -> Iterator[bytes]:
    """A small model in each protocol, the other operations of protocol 5, and hostile networks."""
    yield from map(hostile_archives.valid_pickle, _PROTOCOLS)
    model = asm.stacked_name("models.yolo", "Model") + asm.MEMOIZE + asm.EMPTY_TUPLE + asm.NEWOBJ
    numbers = asm.EMPTY_SET + asm.MARK + asm.number(1) + asm.ADDITEMS
    values = model + numbers + asm.byte_array(b"abc") + asm.short_bytes(b"abc") + asm.get(0)
    yield asm.START_5 + asm.frame(asm.MARK + values + asm.TUPLE) + asm.STOP
    yield from _costly_pickles()


def _family_pickles() -> Iterator[bytes]:
    for index, data in enumerate(_families()):
        yield bytes([index]) + hostile_archives.pickle_of(data)


def _header() -> bytes:
    text, _ = hostile_safetensors.cut(hostile_safetensors.valid())
    return text


def _costly() -> Iterator[Architecture]:
    """Networks that would take up the memory although their files are small."""
    return (architecture for architecture, _ in COSTLY.values() if architecture.classes == SMALL.classes)


def _costly_pickles() -> Iterator[bytes]:
    for architecture in _costly():
        yield hostile_archives.pickle_of(saved(stripped(official_model(architecture))))


def _costly_headers() -> Iterator[bytes]:
    for architecture in _costly():
        yield hostile_safetensors.cut(hostile_safetensors.written(random_model(0, architecture)))[0]


TARGETS = {
    "compressed-images": Target(check_compressed_image, _compressed_images),
    "raw-images": Target(check_raw_image, _raw_images),
    "checkpoints": Target(check_checkpoint, _pickles),
    "families": Target(check_family, _family_pickles),
    "safetensors": Target(check_safetensors, lambda: [_header(), *_costly_headers()]),
    "exports": Target(check_export, lambda: [hostile_onnx.graph_without_weights()]),
    "labels": Target(files.check_labels, files.label_seeds),
    "coco-files": Target(files.check_coco_file, files.coco_seeds),
    "descriptions": Target(files.check_description, files.description_seeds),
    "image-lists": Target(files.check_image_list, files.image_list_seeds),
    "recordings": Target(files.check_recording, files.recording_seeds),
}
