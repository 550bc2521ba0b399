"""Transformers over the cells of a feature map, without positions and normalisation."""

from __future__ import annotations

from torch import Tensor, nn

from yolov5_lifecycle.models.blocks import layer_kind
from yolov5_lifecycle.models.partial import Partial

_HEADS = 4


class TransformerLayer(nn.Module):
    def __init__(self, channels: int) -> None:
        super().__init__()
        if channels % _HEADS:
            raise ValueError(f"{channels} channels cannot be divided among {_HEADS} attention heads")
        self.q = nn.Linear(channels, channels, bias=False)
        self.k = nn.Linear(channels, channels, bias=False)
        self.v = nn.Linear(channels, channels, bias=False)
        self.ma = nn.MultiheadAttention(channels, _HEADS)
        self.fc1 = nn.Linear(channels, channels, bias=False)
        self.fc2 = nn.Linear(channels, channels, bias=False)

    def forward(self, cells: Tensor) -> Tensor:
        """Cells (ny * nx, B, C) -> the same shape."""
        attended, _ = self.ma(self.q(cells), self.k(cells), self.v(cells), need_weights=False)
        attended = attended + cells
        refined: Tensor = self.fc2(self.fc1(attended)) + attended
        return refined


class TransformerBlock(nn.Module):
    def __init__(self, channels: int, layers: int) -> None:
        super().__init__()
        self.linear = nn.Linear(channels, channels)
        self.tr = nn.Sequential(*(TransformerLayer(channels) for _ in range(layers)))

    def forward(self, features: Tensor) -> Tensor:
        cells = features.flatten(2).permute(2, 0, 1)  # (ny * nx, B, C)
        cells = self.tr(cells + self.linear(cells))
        refined: Tensor = cells.permute(1, 2, 0).reshape(features.shape)
        return refined


@layer_kind()
class C3TR(Partial):
    """Its repeats are those of the transformer's layers; it has neither shortcut nor groups."""

    def _refinement(self, hidden: int, repeats: int, shortcut: bool, groups: int) -> nn.Module:
        return TransformerBlock(hidden, repeats)
