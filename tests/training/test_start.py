"""Start of a training from the weights of another run."""

import pytest
import torch

from ghgs_lit.cli.inputs import with_trained_data
from ghgs_lit.config import run_of
from ghgs_lit.errors import InputError
from ghgs_lit.training.start import initialize, report
from tests.helpers.training import Standin


class Other(torch.nn.Module):
    """Shares ``depth`` with the stand-in; ``shift`` has another shape, ``more`` is additional, ``bias`` is
    missing."""

    def __init__(self):
        super().__init__()
        self.depth = torch.nn.Parameter(torch.tensor(7.0))
        self.shift = torch.nn.Parameter(torch.ones(4))
        self.more = torch.nn.Parameter(torch.ones(2))


def checkpoint(path, model, **changes):
    state = {f"model.{key}": value for key, value in model.state_dict().items()}
    content = {"state_dict": {**state, "val.sum": torch.ones(1)}, "config": {}, "format_version": 1}
    torch.save({**content, **changes}, path)
    return path


def test_each_tensor_has_its_line(tmp_path):
    """Tensors that do not fit stay as initialised, and each is reported."""
    path, model = checkpoint(tmp_path / "a.ckpt", Other()), Standin()
    model.bias = torch.nn.Parameter(torch.full((2,), 5.0))
    lines = initialize(model, path)
    assert model.depth.item() == 7
    assert torch.equal(model.shift, torch.zeros(3))
    assert torch.equal(model.bias, torch.full((2,), 5.0))
    assert [line.split()[:2] for line in lines] == [
        ["loaded", "depth"],
        ["wrong", "shape"],
        ["missing", "bias"],
        ["ignored", "more"],
    ]
    assert "(4,), expected (3,)" in lines[1]
    text = report(lines, path, tmp_path / "init_from.txt")
    assert text.startswith(f"init_from {path}: 1 loaded, 1 wrong shape, 1 missing, 1 ignored (")
    assert (tmp_path / "init_from.txt").read_text().splitlines() == lines


def test_strict_takes_all_or_nothing(tmp_path):
    """A rejected checkpoint changes no tensor of the model."""
    model = Standin()
    with pytest.raises(InputError, match=r"a\.ckpt: shift.*\(3,\).*\(4,\)|a\.ckpt: more"):
        initialize(model, checkpoint(tmp_path / "a.ckpt", Other()), strict=True)
    assert model.depth.item() == 2.5
    other = Standin()
    with torch.no_grad():
        other.depth.fill_(3)
    lines = initialize(model, checkpoint(tmp_path / "b.ckpt", other), strict=True)
    assert model.depth.item() == 3
    assert all(line.startswith("loaded") for line in lines)


def test_weights_that_do_not_fit_at_all_are_refused(tmp_path):
    """Weights of another model, or a mistyped path, must not start a training from scratch unnoticed."""
    path = checkpoint(tmp_path / "a.ckpt", torch.nn.Linear(2, 2))
    with pytest.raises(InputError, match=r"init_from.*a\.ckpt"):
        initialize(Standin(), path)
    with pytest.raises(FileNotFoundError):
        initialize(Standin(), tmp_path / "nothing.ckpt")


def test_what_does_not_learn_needs_weights(tmp_path):
    """A checkpoint of another encoder would leave the frozen encoder random, with a report that is easily
    overlooked."""
    path = checkpoint(tmp_path / "a.ckpt", Other())
    model = Standin()
    model.shift.requires_grad_(False)
    with pytest.raises(InputError, match=r"a\.ckpt: shift: expected weights .* found 'none that fit'"):
        initialize(model, path)
    assert model.depth.item() == 2.5
    initialize(model, path, random_frozen=True)
    assert model.depth.item() == 7


def test_a_checkpoint_does_not_say_where_this_machine_writes(tmp_path):
    """Settings of folders and processes are taken from the command line, never from a checkpoint, which may
    come from another machine."""
    machine = {"cache_dir": str(tmp_path / "theirs"), "workers": 1024, "packed": False}
    data = {"name": "synthetic", "size": 56}
    path = checkpoint(
        tmp_path / "a.ckpt", Other(), config={"data": {**data, **machine, "render_workers": 64}}
    )
    run = run_of("evaluate", [f"checkpoint={path}"])
    assert with_trained_data(run).plain["data"] == data
    assert with_trained_data(run.replace(data={"workers": 2})).plain["data"] == {**data, "workers": 2}


@pytest.mark.parametrize("wrong", [torch.nan, torch.inf])
def test_weights_that_are_not_finite_are_refused(tmp_path, wrong):
    """Such weights would make every prediction empty; no tensor of the model is changed."""
    other, model = Standin(), Standin()
    with torch.no_grad():
        other.shift[1] = wrong
    path = checkpoint(tmp_path / "a.ckpt", other)
    with pytest.raises(InputError, match=r"a\.ckpt: shift: expected finite numbers; found 'NaN or infinity'"):
        initialize(model, path)
    assert model.shift.isfinite().all()
