"""Height and width of feature maps as a function of those of the network's input."""

from __future__ import annotations

from fractions import Fraction
from typing import NamedTuple


class Cells(NamedTuple):
    """A feature map has one cell for `pixels` pixels of the input on each axis, and `surplus` more."""

    pixels: Fraction = Fraction(1)
    surplus: int = 0

    def slid(self, kernel: int, stride: int, padding: int, dilation: int = 1) -> Cells:
        """After a window of `kernel` cells slid over them, for inputs divisible by the strides."""
        room = self.surplus + 2 * padding - dilation * (kernel - 1) - 1
        return Cells(self.pixels * stride, room // stride + 1)

    def spread(self, kernel: int, stride: int, padding: int, output_padding: int) -> Cells:
        """After a transposed convolution."""
        surplus = (self.surplus - 1) * stride - 2 * padding + kernel + output_padding
        return Cells(self.pixels / stride, surplus)

    def padded(self, cells: int) -> Cells:
        """With `cells` more cells."""
        return Cells(self.pixels, self.surplus + cells)

    def contracted(self, gain: int) -> Cells:
        """After squares of `gain` x `gain` cells became one; raises ValueError for incomplete squares."""
        if self.surplus % gain:
            raise ValueError(f"the input cannot be divided into squares of {gain} x {gain} cells")
        return Cells(self.pixels * gain, self.surplus // gain)

    def expanded(self, gain: int) -> Cells:
        """After each cell has become a square of `gain` x `gain` cells."""
        return Cells(self.pixels / gain, self.surplus * gain)
