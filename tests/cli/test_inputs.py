"""The model of a checkpoint after command-line changes, its data, and the device."""

import copy

import pytest
import torch
from hydra.core.hydra_config import HydraConfig
from omegaconf import open_dict

from ghgs_lit.cli import inputs
from ghgs_lit.cli.application import _rewrite_overrides
from ghgs_lit.config import compose, run_of
from ghgs_lit.config.compose import to_plain
from ghgs_lit.config.registry import class_of, verb_class
from ghgs_lit.errors import InputError
from ghgs_lit.method.model import GHGS
from ghgs_lit.weights.checkpoint import read_config, write_checkpoint
from tests.helpers.models import config, load_model

TRAINED = ("model=hull", "skip=balanced")


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory):
    path = tmp_path_factory.mktemp("model") / "a.ckpt"
    write_checkpoint(path, {}, {**config(*TRAINED), "data": {"kind": "scans", "root": "old", "size": 42}})
    return str(path)


@pytest.fixture
def composed(monkeypatch):
    """Compose a verb as on the command line, so that its overrides are available."""

    def composed(verb, *overrides):
        cfg = compose(verb, _rewrite_overrides(verb, list(overrides)), with_hydra=True)
        monkeypatch.setattr(HydraConfig.instance(), "cfg", copy.deepcopy(cfg))
        with open_dict(cfg):
            del cfg["hydra"]
        return verb_class(verb).of(to_plain(cfg))

    return composed


@pytest.mark.parametrize("verb", ["evaluate", "predict"])
def test_a_checkpoint_is_not_changed_by_what_a_verb_composes(composed, checkpoint, verb):
    """The defaults of a verb describe another model: only explicit overrides count."""
    run = composed(verb, f"checkpoint={checkpoint}")
    assert inputs.model_of(checkpoint, run) == config(*TRAINED)


@pytest.mark.parametrize("verb", ["evaluate", "predict"])
def test_what_is_said_of_the_model_acts_on_a_checkpoint(composed, checkpoint, verb):
    """Options that do not require other weights change the model, with everything derived from them."""
    said = [
        "skip=none",
        "recalibration.k=2",
        "recalibration.similarity=log",
        "bounds.kind=box",
        "model.pad=multiple",
    ]
    model = inputs.model_of(checkpoint, composed(verb, f"checkpoint={checkpoint}", *said))
    assert model == config(*TRAINED, *said)
    assert model["skip"]["pixels"] == "all"
    model = inputs.model_of(
        checkpoint, composed(verb, f"checkpoint={checkpoint}", "recalibration.tokens=all")
    )
    assert model == config(*TRAINED, "recalibration.tokens=all")


@pytest.mark.parametrize(
    ("verb", "said", "height"),
    [
        ("predict", [], 34),
        ("predict", ["rounds.height=null"], None),
        ("evaluate", ["rounds.height=60", "data=scans"], 60),
        ("adapt", ["data.size=518"], 34),
    ],
)
def test_weights_know_the_height_of_their_own_training(composed, tmp_path, verb, said, height):
    """Four fifths of the training images' height, whatever the weights are used for or fine-tuned on."""
    path = str(tmp_path / "recurrent.ckpt")
    write_checkpoint(path, {}, {**config("model=recurrent"), "data": {"size": 42}})
    run = composed(verb, f"checkpoint={path}", *said)
    assert inputs.model_of(path, run)["rounds"]["height"] == height


@pytest.mark.parametrize(
    ("model", "said", "refused"),
    [
        ("recurrent", "rounds.heigt=null", r"rounds\.heigt: .* found 'heigt' \(did you mean height\?\)"),
        ("recurrent", "rounds.height=-3", r"rounds\.height: expected .*; found -3"),
        (
            "hull",
            "rounds.height=9",
            r"rounds\.height: expected no key of rounds, as the model of",
        ),
    ],
)
def test_a_key_that_the_rounds_of_a_checkpoint_lack_is_refused(composed, tmp_path, model, said, refused):
    """Regression: null was treated as the value of a missing key, and had no effect."""
    path = str(tmp_path / "trained.ckpt")
    write_checkpoint(path, {}, config(f"model={model}"))
    with pytest.raises(InputError, match=refused):
        inputs.model_of(path, composed("evaluate", f"checkpoint={path}", said))


@pytest.mark.parametrize(
    ("said", "refused"),
    [
        ("encoder=vggt_small", "encoder.width: expected 32, which the checkpoint's weights"),
        ("recalibration.num_heads=1", "recalibration.num_heads: expected 2,"),
        ("gaussian_head.color_limit=0.25", "gaussian_head.color_limit: expected 0.5,"),
        ("depth_head.parameterization=bounded_inverse", "depth_head.parameterization: expected 'linear',"),
        ("compat=release", "compat.name: expected 'none',"),
        ("model=paper", "model.name: expected 'hull',"),
        ("ablation=neither", "ablation: expected full, .*recalibration.neighborhood=.* act"),
    ],
)
def test_what_the_weights_were_trained_for_is_refused(composed, checkpoint, said, refused):
    """An option that cannot take effect must not be recorded as if it had."""
    run = composed("evaluate", f"checkpoint={checkpoint}", said)
    with pytest.raises(InputError, match=refused):
        inputs.model_of(checkpoint, run)


def test_what_agrees_with_the_checkpoint_is_accepted(composed, checkpoint):
    """Repeating trained values changes nothing."""
    run = composed("evaluate", f"checkpoint={checkpoint}", "model=hull", "compat=none", "ablation=full")
    assert inputs.model_of(checkpoint, run) == config(*TRAINED)


def test_a_stage_that_is_no_mapping_is_named(composed, tmp_path):
    """A foreign checkpoint must not end in a traceback."""
    path = str(tmp_path / "b.ckpt")
    write_checkpoint(path, {}, {**config(), "encoder": "vggt_nano"})
    said = r"b\.ckpt: config\.encoder: expected a mapping of its keys; found 'vggt_nano'"
    with pytest.raises(InputError, match=said):
        inputs.model_of(path, composed("evaluate", f"checkpoint={path}", "encoder.width=64"))


@pytest.mark.parametrize("verb", ["evaluate", "predict"])
def test_data_that_moved_are_one_override(composed, checkpoint, verb):
    """``data.root=`` alone applies to the data that a checkpoint was trained on."""
    run = composed(verb, f"checkpoint={checkpoint}", "data.root=new")
    found = inputs.with_trained_data(run).plain["data"]
    assert found.items() >= {"kind": "scans", "root": "new", "size": 42}.items()
    assert set(found) == {"kind", *class_of("data", "scans", "data").model_fields}
    chosen = inputs.with_trained_data(composed(verb, f"checkpoint={checkpoint}", "data=scans"))
    assert chosen.data.name == "scans"
    with pytest.raises(InputError, match="data: expected data=<option> where there is no checkpoint"):
        inputs.with_trained_data(composed("evaluate", "data.root=new"))


@pytest.mark.parametrize("verb", ["evaluate", "predict"])
def test_data_that_are_not_here_are_named_by_their_key(composed, checkpoint, monkeypatch, tmp_path, verb):
    """Regression: ``old: expected the folder of the data set`` did not mention the origin of the path."""
    monkeypatch.chdir(tmp_path)
    expected = (
        r"data\.root: expected data\.root=<folder>, .*a\.ckpt is not where .*; found no such folder 'old'"
    )
    with pytest.raises(InputError, match=expected):
        inputs.with_trained_data(composed(verb, f"checkpoint={checkpoint}"))
    (tmp_path / "old").mkdir()
    assert inputs.with_trained_data(composed(verb, f"checkpoint={checkpoint}")).data.root == "old"


def test_a_strange_size_of_rounds_takes_no_memory(tmp_path):
    """Regression: ``rounds.hidden=65536`` in a checkpoint allocated 150 GB before the comparison with its
    weights."""
    path, settings = tmp_path / "a.ckpt", config("model=recurrent")
    state = GHGS.from_config(settings).state_dict()
    write_checkpoint(path, state, {**settings, "rounds": {**settings["rounds"], "hidden": 65536}})
    with pytest.raises(InputError, match=r"a\.ckpt: rounds\..*: expected shape \(65536, .* found \("):
        inputs.load_predictor(read_config(path), path, "cpu")
    with pytest.raises(InputError, match=r"a\.ckpt: rounds\..*: expected shape"):
        load_model(path)
    write_checkpoint(path, state, settings)
    model = load_model(path)
    assert not any(tensor.is_meta for tensor in (*model.parameters(), *model.buffers()))


def test_targets_on_the_command_line_are_measured_alone(composed):
    """``targets=midway`` evaluates this protocol; evaluation.targets is for several protocols."""
    found = inputs.with_chosen_targets(composed("evaluate", "targets=midway"))
    assert found.evaluation.targets == ("midway",)
    for said in ([], ["targets.per_subject=2"], ["targets=ghg", "evaluation.targets=[release,midway]"]):
        found = inputs.with_chosen_targets(composed("evaluate", *said))
        assert found.evaluation.targets == ("release", "midway")


@pytest.mark.skipif(torch.cuda.is_available(), reason="needs a machine without CUDA")
def test_a_device_or_renderer_that_is_not_there_is_refused():
    """A run on the CPU must not pass for one on a GPU, and missing gsplat is a one-line error."""
    with pytest.raises(
        InputError, match="device: expected auto or cpu on a machine without CUDA; found 'cuda'"
    ):
        inputs.pick_device("cuda")
    assert inputs.pick_device("auto").type == "cpu"
    renderer = run_of("evaluate", ["renderer.backend=gsplat"])
    with pytest.raises(InputError, match="needs a CUDA device"):
        inputs.build_renderer(renderer, torch.device("cpu"))
