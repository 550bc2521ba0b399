"""The official checkpoints: their names, where they are, and the digests of the files."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

from yolov5_lifecycle.models.architecture import SIZES

MODELS = (*SIZES, *(f"{size}-seg" for size in SIZES if len(size) == 1))
"""The official models: for detection, then for segmentation."""
URL = "https://github.com/ultralytics/yolov5/releases/download/v7.0/yolov5{size}.pt"
SHA256: Mapping[str, str] = MappingProxyType(
    {
        "n": "4f180cf23ba0717ada0badd6c685026d73d48f184d00fc159c2641284b2ac0a3",
        "s": "8b3b748c1e592ddd8868022e8732fde20025197328490623cc16c6f24d0782ee",
        "m": "61d933360ba5a7733a36764996c800287d973889d875227f5beedd2473a97a56",
        "l": "2f603b7354c25454d1270663a14d8ddc1eea98e5eebc1d84ce0c6e3150fa155f",
        "x": "9f27a794fa0308e2606f90565164571d6f0a0ba18a3ce2e5e5d323b71c157859",
        "n6": "496c05a2b991da15acc6c4408c63da287f2513a46c6756618776d4dd71170781",
        "s6": "95bda9019ada63f37338308d0c81a66047a6fbaba061abaff271ba9334cf2a6f",
        "m6": "7afe7fa0f29a8351467200a2a5a33c7996d1155ed6636c7edd8ca70b14951c64",
        "l6": "b357b77f646b0190912985937c44e2923441369d5fda69ba86da2aa919212618",
        "x6": "257c991b216d625427dc4d9c7c76d6c6d93cf3732797538da34bdc02f97bfef0",
    }
)
"""Digests of the files of release v7.0 by model; those of the models for segmentation are not known."""
