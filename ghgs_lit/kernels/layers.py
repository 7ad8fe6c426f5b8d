"""Small networks inside kernels, ``PANEL`` rows at a time.

Values are stored by channel: one line of ``PANEL`` floats, a lane for each row. So a layer's result is the
next one's input as it is, and its activation needs no other layout.
"""

import numpy as np
from torch import nn

from ghgs_lit.kernels import memory, simd
from ghgs_lit.kernels.compile import helper
from ghgs_lit.kernels.products import product
from ghgs_lit.kernels.simd import LANES
from ghgs_lit.kernels.tile import PANEL, ROWS

ZERO = np.float32(0)


def room(channels: int) -> int:
    """Lines that a layer with so many outputs writes: whole tiles."""
    return -(-channels // ROWS) * ROWS


def packed(layer: nn.Linear) -> np.ndarray:
    """Weights in tiles of ``ROWS`` outputs, each [inputs, ROWS], then the biases, as one flat array."""
    outputs, inputs = layer.weight.shape
    both = np.zeros((room(outputs), inputs + 1), np.float32)
    both[:outputs, :-1], both[:outputs, -1] = (x.detach().numpy() for x in (layer.weight, layer.bias))
    tiles = both[:, :-1].reshape(-1, ROWS, inputs).swapaxes(1, 2)
    return np.concatenate((tiles.ravel(), both[:, -1]))


#: :func:`room` inside kernels.
lines = helper(room)


@helper
def size(outputs, inputs):
    """Floats of a packed layer."""
    return lines(outputs) * (inputs + 1)


@helper
def put_rows(table, first, count, line, values):
    """Copy ``count`` rows of a table from ``first`` on to lines from ``line`` on; the last one repeats."""
    for lane in range(PANEL):
        row = first + min(lane, count - 1)
        for channel in range(table.shape[1]):
            values[(line + channel) * PANEL + lane] = table[row, channel]


@helper
def linear(layers, at, outputs, inputs, values, result):
    """``result = W values`` of the packed layer at ``layers[at]``; the biases are :func:`rectify`'s."""
    for row in range(0, outputs, ROWS):
        product(layers, at + row * inputs, values, 0, inputs, result, row * PANEL, PANEL)


@helper
def bend(layers, at, outputs, inputs, values):
    """``values = tanh(values + b)`` of the packed layer at ``layers[at]``."""
    biases = at + lines(outputs) * inputs
    for channel in range(outputs):
        for i in range(channel * PANEL, (channel + 1) * PANEL, LANES):
            memory.store(values, i, simd.tanh(memory.load(values, i) + layers[biases + channel]))


@helper
def rectify(layers, at, outputs, inputs, values):
    """``values = max(values + b, 0)`` of the packed layer at ``layers[at]``; NaN stays."""
    biases = at + lines(outputs) * inputs
    for channel in range(outputs):
        for i in range(channel * PANEL, (channel + 1) * PANEL, LANES):
            memory.store(values, i, simd.maximum(ZERO, memory.load(values, i) + layers[biases + channel]))
