"""Matrix products by the faster of the two libraries that PyTorch uses on a CPU.

``nn.Linear`` in float32 calls MKL, which uses only half of the vector width on CPUs that Intel did not
make. A 1x1 convolution computes the same product with oneDNN, which uses the full width: 2.1 times as fast
on an AMD CPU of 2024. Nothing changes on other devices and for small products.
"""

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from ghgs_lit.kernels.parts import even_parts

#: Multiplications above which oneDNN is faster in spite of its slower calls, and number of inputs above
#: which PyTorch uses oneDNN's convolution (with two threads or more).
_LARGE, _PIXELS = 1 << 24, 20480
#: Weight values that oneDNN copies at once where the input has fewer rows than channels.
_COPY = 1 << 20


def _has_wide_convolutions() -> bool:
    backends = torch.backends
    capability = backends.cpu.get_cpu_capability()
    return backends.mkl.is_available() and backends.mkldnn.is_available() and capability == "AVX512"


_WIDE_CONVOLUTIONS = _has_wide_convolutions()


def prefers_convolution(device: torch.device) -> bool:
    """Whether large float32 products on ``device`` are faster as 1x1 convolutions."""
    return device.type == "cpu" and _WIDE_CONVOLUTIONS and torch.get_num_threads() > 1


def linear(x: Tensor, weight: Tensor, bias: Tensor | None = None) -> Tensor:
    """``x @ weight.T + bias``.

    Args:
        x: [..., k].
        weight: [n, k].
        bias: [n], or None for no bias.

    Returns:
        [..., n].
    """
    large = x.numel() * len(weight) >= _LARGE and x.numel() > _PIXELS and x.dtype == torch.float32
    if not (large and prefers_convolution(x.device)) or torch.is_autocast_enabled("cpu"):
        return F.linear(x, weight, bias)
    k = x.shape[-1]
    if x.numel() >= k * k or weight.numel() <= _COPY:
        return _convolve(x, weight, bias)
    # oneDNN copies the weight to its own layout; for few rows that copy would need most of the memory.
    parts = even_parts(len(weight), _COPY // k)
    return torch.cat([_convolve(x, weight[p], None if bias is None else bias[p]) for p in parts], dim=-1)


def _convolve(x: Tensor, weight: Tensor, bias: Tensor | None) -> Tensor:
    """The product as a convolution: rows are pixels with the channels innermost, so nothing is copied."""
    pixels = x.reshape(1, 1, -1, x.shape[-1]).permute(0, 3, 1, 2)
    found = F.conv2d(pixels, weight[:, :, None, None], bias)
    return found.permute(0, 2, 3, 1).reshape(*x.shape[:-1], len(weight))


class Linear(nn.Linear):
    """``nn.Linear`` computed by :func:`linear`."""

    def forward(self, input: Tensor) -> Tensor:
        return linear(input, self.weight, self.bias)
