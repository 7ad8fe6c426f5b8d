"""Precisions: PyTorch's switches for rounding float32 products and convolutions on CUDA, which can be set
and read without a GPU."""

import warnings

import pytest
import torch
from torch import nn
from torch.utils._python_dispatch import TorchDispatchMode

from ghgs_lit.errors import InputError
from ghgs_lit.geometry.precision import (
    _warn_rounding,
    exact,
    keep_rounded,
    precision_of,
    round_products,
    rounds_products,
)
from ghgs_lit.training.trainer import TrainerOptions
from tests.helpers.models import make_model, predict
from tests.helpers.scenes import make_batch

CUDA = torch.device("cuda")
MATMUL, CUDNN, MKLDNN = torch.backends.cuda.matmul, torch.backends.cudnn, torch.backends.mkldnn
SWITCHES = (MATMUL, CUDNN.conv, CUDNN.rnn, MKLDNN.matmul, MKLDNN.conv)


def state():
    return [switch.fp32_precision for switch in SWITCHES]


def by_older_switches():
    return torch.get_float32_matmul_precision(), CUDNN.allow_tf32, MATMUL.allow_tf32


@pytest.fixture(autouse=True)
def as_pytorch_has_it():
    def reset():
        torch.backends.fp32_precision = "none"
        torch.set_float32_matmul_precision("highest")
        CUDNN.allow_tf32 = True
        for switch in (MATMUL, MKLDNN.matmul, MKLDNN.conv):
            switch.fp32_precision = "none"

    reset()
    yield
    reset()


def medium():
    torch.set_float32_matmul_precision("medium")


def everything():
    torch.backends.fp32_precision = "tf32"


def convolutions_alone():
    CUDNN.rnn.fp32_precision = "ieee"


@pytest.mark.parametrize("setting", [lambda: None, medium, everything, convolutions_alone])
def test_exact_rounds_neither_products_nor_convolutions_on_cuda(setting):
    """PyTorch rounds convolutions by default; the previous state is restored."""
    setting()
    before = state()
    assert rounds_products("cuda")
    with exact("cuda"):
        assert [switch.fp32_precision for switch in SWITCHES[:4]] == ["ieee"] * 4
        assert not rounds_products("cuda")
        with exact("cpu"):
            assert not rounds_products("cpu")
        assert not rounds_products("cuda")
    assert state() == before


@pytest.mark.parametrize("setting", [lambda: None, medium])
def test_older_switches_can_be_read_inside_and_come_back(setting):
    """Other packages read the older switches, which PyTorch rejects if they contradict the newer ones."""
    setting()
    before = by_older_switches()
    with exact("cuda"):
        assert by_older_switches() == ("highest", False, False)
    with precision_of("tf32", CUDA):
        assert by_older_switches() == ("high", True, True)
        with exact("cuda"):
            assert by_older_switches() == ("highest", False, False)
        assert by_older_switches() == ("high", True, True)
    assert by_older_switches() == before


def test_float32_is_exact_and_tf32_is_refused_on_a_cpu():
    """``precision=float32`` uses no TF32 in convolutions on CUDA; TF32 is rejected on a CPU."""
    with precision_of("float32", CUDA):
        assert not rounds_products("cuda")
    with pytest.raises(InputError, match="precision: expected tf32 on CUDA only; found 'cpu'"):
        precision_of("tf32", torch.device("cpu"))


def test_products_round_where_convolutions_do_which_is_said_once():
    """With PyTorch's default on CUDA, TF32 in convolutions alone, products use TF32 too, with one
    warning; the state is restored."""
    _warn_rounding.cache_clear()
    before = state()
    with pytest.warns(UserWarning, match="precision=inherit: factors of products are rounded to TF32"):
        _state_inside("inherit")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert _state_inside("inherit")[:4] == ["tf32"] * 4
    assert state() == before


def _state_inside(name):
    """State of the switches within a context."""
    with precision_of(name, CUDA):
        return state()


def float32_alone():
    round_products(False)


@pytest.mark.parametrize("setting", [medium, everything, float32_alone])
def test_what_a_process_has_chosen_is_inherited(setting):
    """A chosen precision is kept, such as float32 in convolutions by ``trainer.precision=32-true``."""
    setting()
    before = state()
    assert _state_inside("inherit") == before


@pytest.mark.parametrize("kind", ["model=paper", "model=hull"])
def test_rounded_weights_give_the_same_numbers_as_rounding_at_each_call(kind):
    """Stored half-precision weights take half the memory and need no kernels that cast them."""
    model, batch = make_model(kind).eval(), make_batch(1, 2, 28, 42)
    found, casts = [], []
    for _ in range(2):
        with torch.no_grad(), torch.autocast("cpu", torch.bfloat16), Casts() as seen:
            found.append(predict(model, batch))
        casts.append(seen.count)
        keep_rounded(model.encoder, torch.bfloat16)
    for name in ("means", "scales", "opacities", "colors"):
        assert torch.equal(getattr(found[0].gaussians, name), getattr(found[1].gaussians, name))
    layers = [layer for layer in model.encoder.modules() if isinstance(layer, nn.Linear)]
    assert casts[0] - casts[1] >= len(layers) > 0


class Casts(TorchDispatchMode):
    """Counts operators that cast."""

    count = 0

    def __torch_dispatch__(self, function, types, args=(), kwargs=None):
        self.count += function.name().startswith("aten::_to_copy")
        return function(*args, **(kwargs or {}))


def test_a_training_in_tf32_leaves_nothing_to_the_next_one_of_its_process():
    """Runs of a sweep share a process; with ``32-true``, convolutions are in float32, too."""
    for precision, rounds in (("32-true", False), ("tf32", True), ("32-true", False)):
        TrainerOptions(accelerator="cpu", precision=precision, max_steps=1).build(logger=False)
        assert rounds_products("cuda") == rounds
        assert CUDNN.allow_tf32 == MATMUL.allow_tf32 == rounds
