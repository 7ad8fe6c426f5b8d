"""Linear layers on a CPU with the faster of MKL and oneDNN.

``nn.Linear`` in float32 calls MKL, which uses only half the vector width of AVX-512 on CPUs that are
not made by Intel: 95 to 117 GFLOP/s per core, against 186 to 254 with oneDNN. Without AVX-512 both are
equally fast. Other devices, other precisions and small products are not affected."""

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from ghgs_lit.ops.pool import even_parts

#: Multiplications from which oneDNN is faster despite its larger overhead per call: without a gradient
#: (``_SMALL``), and with one (``_LARGE``), as a convolution, which also needs two threads and more than
#: ``_PIXELS`` inputs (PyTorch's limit).
_SMALL = 1 << 21
_LARGE = 1 << 24
_PIXELS = 20480
#: Number of weights per call of oneDNN if the input has fewer rows than channels.
_COPY = 1 << 20


_WIDE_PRODUCTS = torch.backends.mkl.is_available() and torch.backends.mkldnn.is_available()
_WIDE_PRODUCTS = _WIDE_PRODUCTS and torch.backends.cpu.get_cpu_capability() == "AVX512"


def prefers_onednn(x: Tensor, weight: Tensor) -> bool:
    """Whether :func:`linear` is faster with oneDNN.

    Args:
        x: [..., inputs].
        weight: [outputs, inputs].
    """
    if not _WIDE_PRODUCTS or x.device.type != "cpu" or torch.is_autocast_enabled("cpu"):
        return False
    work = x.numel() * len(weight)
    if x.dtype != torch.float32 or work < _SMALL:
        return False
    convolves = work >= _LARGE and x.numel() > _PIXELS and torch.get_num_threads() > 1
    return convolves or not torch.is_grad_enabled()


def linear(x: Tensor, weight: Tensor, bias: Tensor | None = None) -> Tensor:
    """``x @ weight.T + bias``, as ``F.linear``.

    Args:
        x: [..., inputs].
        weight: [outputs, inputs].
        bias: [outputs].

    Returns:
        [..., outputs].
    """
    if not prefers_onednn(x, weight):
        return F.linear(x, weight, bias)
    k = x.shape[-1]
    product = _convolve if torch.is_grad_enabled() else _multiply
    if x.numel() >= k * k or weight.numel() <= _COPY:
        return product(x, weight, bias)
    # oneDNN copies the weight to its own layout, which would take most of the memory if rows are few.
    parts = even_parts(len(weight), _COPY // k)
    return torch.cat([product(x, weight[p], None if bias is None else bias[p]) for p in parts], dim=-1)


def _multiply(x: Tensor, weight: Tensor, bias: Tensor | None) -> Tensor:
    return torch.ops.mkldnn._linear_pointwise(x, weight, bias, "none", [], None)


def _convolve(x: Tensor, weight: Tensor, bias: Tensor | None) -> Tensor:
    """The product as a convolution, with rows as pixels and channels innermost to avoid copies."""
    pixels = x.reshape(1, 1, -1, x.shape[-1]).permute(0, 3, 1, 2)
    products = F.conv2d(pixels, weight[:, :, None, None], bias)
    return products.permute(0, 2, 3, 1).reshape(*x.shape[:-1], len(weight))


class Linear(nn.Linear):
    """``nn.Linear`` computed by :func:`linear`."""

    def forward(self, input: Tensor) -> Tensor:
        return linear(input, self.weight, self.bias)
