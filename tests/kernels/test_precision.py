"""Precisions: what rounds products and convolutions of float32 numbers on CUDA, set and read without it."""

import pytest
import torch

from ghgs_lit.errors import InputError
from ghgs_lit.kernels.precision import exact, precision_of, rounds_products
from ghgs_lit.training.trainer import TrainerOptions

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
    """PyTorch's default rounds convolutions there; whatever was set comes back."""
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
    """Other packages read them, and PyTorch refuses that where they contradict the newer ones."""
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
    """``precision=float32`` has no convolutions in TF32, ``inherit`` has what the process has."""
    with precision_of("float32", CUDA):
        assert not rounds_products("cuda")
    with precision_of("inherit", CUDA):
        assert CUDNN.conv.fp32_precision == "tf32"
    with pytest.raises(InputError, match="precision: expected tf32 on CUDA only; found 'cpu'"):
        precision_of("tf32", torch.device("cpu"))


def test_a_training_in_tf32_leaves_nothing_to_the_next_one_of_its_process():
    """Runs of a sweep share a process; ``32-true`` is float32 in convolutions, too."""
    for precision, rounds in (("32-true", False), ("tf32", True), ("32-true", False)):
        TrainerOptions(accelerator="cpu", precision=precision, max_steps=1).build(logger=False)
        assert rounds_products("cuda") == rounds
        assert CUDNN.allow_tf32 == MATMUL.allow_tf32 == rounds
