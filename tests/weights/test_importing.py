"""Published weights are imported strictly, run, and are exported unchanged."""

import itertools
import re
import warnings

import pytest
import torch
from safetensors.torch import load_file, save_file

from ghgs_lit.config import run_of
from ghgs_lit.errors import InputError
from ghgs_lit.method.model import GHGS
from ghgs_lit.training import start
from ghgs_lit.weights import importing, names
from ghgs_lit.weights.checkpoint import model_state, read_checkpoint, write_checkpoint
from ghgs_lit.weights.exporting import export_weights
from ghgs_lit.weights.importing import Source, match_files
from ghgs_lit.weights.reading import cast
from ghgs_lit.weights.switches import differences
from tests.cli.test_main import call
from tests.helpers.models import close, load_model, predict
from tests.helpers.scenes import make_batch
from tests.helpers.weights import (
    OTHER_HEADS,
    PUBLISHED,
    TINY,
    config,
    import_weights,
    published_tensors,
    write_published,
)


@pytest.fixture
def files(tmp_path):
    (vggt, release), tensors = write_published(tmp_path)
    return str(vggt), str(release), *tensors


def meta(shapes, prefix=""):
    return {prefix + name: torch.empty(shape, device="meta") for name, shape in shapes.items()}


@pytest.mark.parametrize("prefix", ["", "aggregator."])
def test_the_published_names_and_shapes_are_exactly_the_models(monkeypatch, prefix):
    """The published files must fill the full-size model exactly, tensor by tensor."""
    contents = {
        "vggt": meta(PUBLISHED["vggt"], prefix) | meta(OTHER_HEADS),
        "release": {"network": meta(PUBLISHED["network"]), "total_steps": 1},
    }
    monkeypatch.setattr(importing, "open_file", contents.__getitem__)
    files = [
        Source("vggt", "VGGT", "vggt", "", names.VGGT, names.VGGT_IGNORED),
        Source("release", "the release", "release", "", names.RELEASE, entry="network"),
    ]
    own = GHGS.from_config(config(tiny=False), empty=True).state_dict()
    assert all(tensor.is_meta for tensor in own.values())
    match_files(own, files)
    assert [len(source.used) for source in files] == [1210, 164]
    assert sum(own[name].numel() for name in files[0].used) == 909_112_320
    assert sum(own[name].numel() for name in files[1].used) == 77_942_669
    back = {names.to_published(name, names.VGGT) or names.to_published(name, names.RELEASE) for name in own}
    expected = {f"aggregator.{name}" for name in PUBLISHED["vggt"]} | set(PUBLISHED["network"])
    assert back == expected


@pytest.mark.parametrize("suffix", [".safetensors", ".pt"])
def test_import_and_export_give_the_same_tensors_back(tmp_path, suffix):
    """A tensor that is renamed wrongly, changed or lost would show here."""
    (vggt, release), (agg, network) = write_published(tmp_path, suffix)
    out = tmp_path / "out.ckpt"
    report = import_weights(config(), out, str(vggt), str(release))
    assert "ignored (camera_head 1, depth_head 62, point_head 1, track_head 1)" in report[0]
    assert report[1].endswith(f"{len(network)} tensors used, 0 ignored")
    export_weights(out, tmp_path / f"back{suffix}", tmp_path / "back.pth")
    back = load_file(tmp_path / "back.safetensors") if suffix == ".safetensors" else torch.load(
        tmp_path / "back.pt", weights_only=True
    )  # fmt: skip
    again = torch.load(tmp_path / "back.pth", weights_only=True)["network"]
    used = {name: value for name, value in agg.items() if name.startswith("aggregator.")}
    for found, expected in ((back, used), (again, network)):
        assert set(found) == set(expected)
        assert all(torch.equal(found[name], value) for name, value in expected.items())
    assert not [path for path in tmp_path.iterdir() if path.name.startswith(".")]


def test_the_checkpoint_is_the_published_model_and_says_so(tmp_path, files):
    """The imported model must compute with the published tensors, and record their origin."""
    vggt, release, agg, network = files
    out = tmp_path / "out.ckpt"
    import_weights(config(), out, vggt, release)
    checkpoint = read_checkpoint(out)
    assert checkpoint["config"]["encoder"]["weights"] == "vggt.safetensors"
    assert checkpoint["config"]["compat"]["name"] == "release"
    assert checkpoint["imported"]["release"]["tensors"] == len(network)
    assert re.fullmatch("[0-9a-f]{64}", checkpoint["imported"]["vggt"]["sha256"])
    model = load_model(out)
    assert not any(tensor.is_meta for tensor in (*model.parameters(), *model.buffers()))
    expected = GHGS.from_config(config())
    renamed = {names.to_ours(name, names.VGGT): value for name, value in agg.items()}
    renamed |= {names.to_ours(name, names.RELEASE): value for name, value in network.items()}
    expected.load_state_dict({name: value for name, value in renamed.items() if name is not None})
    batch = make_batch(1, 3, 50, 64)  # padded to 56 x 70
    with torch.no_grad():
        close(predict(model, batch).gaussians, predict(expected, batch).gaussians, 0)


def test_without_the_release_the_file_holds_the_encoder_alone(tmp_path, files):
    """It held the heads of one seed, so that the seeds of a table were equal in all 164
    tensors of heads."""
    vggt, _, agg, _ = files
    out, settings = str(tmp_path / "out.ckpt"), config("compat=none")
    report = import_weights(settings, out, vggt)
    assert report[-1].startswith("the encoder alone")
    checkpoint = read_checkpoint(out)
    assert list(checkpoint["config"]) == ["encoder"]
    used = {names.to_ours(name, names.VGGT): value for name, value in agg.items()}
    state = model_state(checkpoint)
    assert state.keys() == {name for name in used if name is not None}
    assert all(torch.equal(state[name], used[name]) for name in state)
    starts = []
    for seed in (1, 2, 3):
        torch.manual_seed(seed)
        model = GHGS.from_config(settings)
        drawn = {name: tensor.clone() for name, tensor in model.state_dict().items()}
        start.initialize(model, out, strict=True)
        starts.append(model.state_dict())
        heads = [name for name in drawn if name not in state]
        assert all(torch.equal(starts[-1][name], drawn[name]) for name in heads)
        assert all(torch.equal(starts[-1][name], state[name]) for name in state)
    random = [name for name in heads if drawn[name].unique().numel() > 1]  # others are constants
    assert len(random) > 60
    for one, other in itertools.combinations(starts, 2):
        assert not any(torch.equal(one[name], other[name]) for name in random)


def test_the_encoder_alone_is_no_whole_model(monkeypatch, capsys, tmp_path, files):
    """It predicts nothing; what fits is exported."""
    monkeypatch.chdir(tmp_path)
    import_weights(config("compat=none"), "start.ckpt", files[0])
    for argv, message in (
        (["predict", "data=synthetic"], "a whole model; found the encoder alone (`ghgs train init_from="),
        (["export", "release=back.pth"], "tensors for back.pth; found 'the encoder alone'"),
        (["export", "inference=small.ckpt"], "a whole model; found 'the encoder alone'"),
    ):
        code, _, err = call(monkeypatch, capsys, *argv, "checkpoint=start.ckpt")
        assert (code, err.count("\n")) == (1, 1)
        assert f"start.ckpt: expected {message}" in err
    assert not list(tmp_path.glob("back*")) + list(tmp_path.glob("small*"))
    export_weights("start.ckpt", "back.safetensors", None)
    assert set(load_file("back.safetensors")) == {name for name in files[2] if name.startswith("aggregator.")}


@pytest.mark.parametrize("dtype", ["bfloat16", "float16"])
def test_the_encoders_precision_is_a_choice(tmp_path, files, dtype):
    """Half precision must reach the encoder alone, and stay close to the float32 model."""
    vggt, release, agg, _ = files
    out = tmp_path / "out.ckpt"
    import_weights(config(), out, vggt, release, dtype)
    half = getattr(torch, dtype)
    assert model_state(read_checkpoint(out))["encoder.aggregator.camera_token"].dtype == half
    model = load_model(out, dtype=half)
    assert {p.dtype for p in model.encoder.parameters()} == {half}
    assert {p.dtype for p in (*model.depth_head.parameters(), *model.gaussian_head.parameters())} == {
        torch.float32
    }
    token = agg["aggregator.camera_token"]
    assert torch.equal(model.encoder.aggregator.camera_token, token.to(half))
    wide = load_model(out, dtype=torch.float32)
    assert {p.dtype for p in wide.parameters()} == {torch.float32}
    batch = make_batch(1, 3)
    with torch.no_grad():
        found, expected = predict(model, batch), predict(wide, batch)
    assert found.gaussians.means.dtype == torch.float32
    mask = batch.masks
    inverse = [1 / prediction.depth[mask] for prediction in (found, expected)]
    assert (inverse[0] - inverse[1]).abs().max() < 0.05 * inverse[1].abs().max()


def test_conversion_maps_the_file_again_and_keeps_what_fits(monkeypatch, tmp_path):
    """Without closing the file between chunks a conversion would hold two copies of the weights."""
    monkeypatch.setattr("ghgs_lit.weights.reading._CHUNK", 3000)
    tensors = {f"a{i}": torch.randn(16, 16) for i in range(8)} | {"b": torch.randn(3)}
    opened = []

    def open_tensors():
        opened.append(1)
        return dict(tensors)

    def precision(name, stored):
        return torch.bfloat16 if name != "b" else stored

    found = cast(open_tensors, precision)
    assert list(found) == list(tensors)
    assert len(opened) == 4
    assert found["b"] is tensors["b"]
    assert all(torch.equal(found[name], tensors[name].bfloat16()) for name in tensors if name != "b")


def tampered(files, tmp_path, change):
    """The release's file after ``change(network)``."""
    network = dict(files[3])
    change(network)
    torch.save({"network": network}, tmp_path / "release.pth")
    return str(tmp_path / "release.pth")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            lambda n: n.pop("blk.norm1.weight"),
            r"blk\.norm1\.weight: expected a tensor of .*\(64,\); .*not",
        ),
        (lambda n: n.update({"blk.lam_s": torch.ones(1)}), r"blk\.lam_s: expected no such tensor"),
        (
            lambda n: n.update({"smpl.x": torch.ones(1)}),
            r"smpl\.x: expected a tensor of the authors' release",
        ),
        (
            lambda n: n.update({"blk.norm1.weight": torch.ones(3)}),
            r"blk\.norm1\.weight: expected shape \(64,\) of the configured model; found \(3,\)",
        ),
        (lambda n: n["blk.norm1.weight"].fill_(float("nan")), r"blk\.norm1\.weight: expected finite numbers"),
        (lambda n: n.update({"blk.norm1.weight": 3}), r"blk\.norm1\.weight: .* found 'int'"),
        (
            lambda n: n.update({"blk.norm1.weight": torch.ones(64, dtype=torch.long)}),
            r"blk\.norm1\.weight: expected floating point",
        ),
    ],
)
def test_a_tensor_that_does_not_fit_is_named(tmp_path, files, change, message):
    """A damaged release must be refused by tensor, and leave no checkpoint."""
    release = tampered(files, tmp_path, change)
    with pytest.raises(InputError, match=r"release\.pth: " + message):
        import_weights(config(), tmp_path / "out.ckpt", files[0], release)
    assert not (tmp_path / "out.ckpt").exists()


def test_a_tensor_that_comes_twice_is_refused(tmp_path, files):
    """With two tensors for one place it would be unclear which one is used."""
    vggt = dict(files[2])
    vggt["camera_token"] = vggt["aggregator.camera_token"]
    save_file({name: tensor.clone() for name, tensor in vggt.items()}, tmp_path / "twice.safetensors")
    with pytest.raises(InputError, match="camera_token too"):
        import_weights(config(), tmp_path / "out.ckpt", str(tmp_path / "twice.safetensors"), files[1])


def test_files_in_the_wrong_place_are_refused(tmp_path, files):
    """Exchanged files, missing ones, and overwriting the input must be refused."""
    vggt, release, *_ = files
    with pytest.raises(InputError, match=r"release\.pth: network: expected a tensor of VGGT-1B"):
        import_weights(config(), tmp_path / "out.ckpt", release, None)
    with pytest.raises(InputError, match=r"expected the entry 'network'; found 'aggregator\..* more"):
        import_weights(config(), tmp_path / "out.ckpt", vggt, vggt)
    with pytest.raises(InputError, match="vggt: expected a file or facebook/VGGT-1B"):
        import_weights(config(), tmp_path / "out.ckpt", None, release)
    with pytest.raises(InputError, match="out: expected another file"):
        import_weights(config(), vggt, vggt, release)
    with pytest.raises(FileNotFoundError, match=r"none\.safetensors"):
        import_weights(config(), tmp_path / "out.ckpt", str(tmp_path / "none.safetensors"))


def test_our_own_variants_have_no_published_names(tmp_path, files):
    """A model that the authors' code cannot load must not be exported to it."""
    vggt, release, *_ = files
    out, settings = tmp_path / "out.ckpt", config("compat=none", "gaussian_head.guide=true")
    write_checkpoint(out, GHGS.from_config(settings).state_dict(), settings)
    with pytest.raises(InputError, match="guide"):
        export_weights(out, None, tmp_path / "back.pth")
    assert not (tmp_path / "back.pth").exists()
    with pytest.raises(InputError, match="vggt=<file>"):
        export_weights(out, None, None)
    import_weights(config(), out, vggt, release)
    with pytest.raises(InputError, match=r"release: expected a PyTorch file"):
        export_weights(out, None, tmp_path / "back.safetensors")


def test_the_verbs(monkeypatch, capsys, tmp_path, files):
    """The command line must pass its keys on, print paths last, and answer errors in one line."""
    monkeypatch.chdir(tmp_path)
    code, out, _ = call(
        monkeypatch, capsys, "import", "vggt=vggt.safetensors", "release=release.pth", "out=a/out.ckpt", *TINY
    )
    assert code == 0
    assert "differs from the release" not in out
    assert out.splitlines()[-1] == "wrote a/out.ckpt"
    code, out, _ = call(monkeypatch, capsys, "export", "checkpoint=a/out.ckpt", "release=back.pth")
    assert code == 0
    assert out.splitlines()[-2:] == [f"back.pth: {len(files[3])} tensors", "wrote back.pth"]
    for argv, message in (
        (["vggt=none.pt", "compat=none", "out=b.ckpt"], "none.pt: expected a file of weights; found none"),
    ):
        code, _, err = call(monkeypatch, capsys, "import", *argv, *TINY)
        assert code == 1
        assert err.strip().startswith(f"ghgs import: {message}")
        assert len(err.strip().splitlines()) == 1


@pytest.mark.parametrize(("skip", "tokens"), [("balanced", "window"), ("fast", "subject")])
def test_fewer_tokens_with_the_authors_weights_give_a_warning(tmp_path, skip, tokens):
    """Their training saw whole photographs: what leaving out patches costs is not known."""
    (vggt, release), _ = write_published(tmp_path)
    out = tmp_path / "out.ckpt"
    import_weights(config(f"skip={skip}"), out, str(vggt), str(release))
    with pytest.warns(UserWarning, match=rf"out\.ckpt: skip\.tokens: expected all, .*; found {tokens}"):
        load_model(out)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        import_weights(config(), out, str(vggt), str(release))
        load_model(out)


def test_switches_that_differ_from_the_releases_are_listed():
    """Users must learn which parts of a model differ from the authors' code."""
    assert differences(config()) == []
    found = differences(config("unprojection.tokens=subject"))
    assert found == ["unprojection.tokens=subject for release"]
    assert any("depth_head.parameterization" in line for line in differences(config("compat=none")))
    assert differences(config(), config()) == []
    assert differences(config(), {"encoder": config()["encoder"]}) == []


def test_tiny_files_have_the_published_structure():
    """The small files of these tests must have the structure of the published ones,
    but for their size."""
    vggt, network = published_tensors()

    def kinds(tensors):
        return {re.sub(r"blocks\.\d+", "blocks", name) for name in tensors}

    assert set(network) == set(PUBLISHED["network"])
    own = {name for name in vggt if name.startswith("aggregator.")}
    assert kinds(own) == {f"aggregator.{name}" for name in kinds(PUBLISHED["vggt"])}


def test_training_from_imported_weights_says_where_they_come_from(tmp_path, files):
    """Tables read ``encoder.weights``, so it must follow the encoder's tensors if all of them
    are loaded."""
    out = str(tmp_path / "out.ckpt")
    settings = config("compat=none", "encoder.trainable=last_1")
    import_weights(settings, out, files[0])
    model = GHGS.from_config(settings)
    lines = start.initialize(model, out, strict=True)
    assert all(line.startswith("loaded" if " encoder." in line else "missing") for line in lines)
    run = run_of("train", ["resume=null", f"init_from={out}"]).replace(**settings)
    assert start.with_origin(run, model).encoder.weights == "vggt.safetensors"
    before = read_checkpoint(out)["config"]
    assert differences(settings, before) == []
    assert run.encoder.weights is None
    afresh = run.replace(init_from=None)
    assert start.with_origin(afresh, model) is afresh
    wider = config("compat=none", "encoder.mask_input=true")
    assert start.with_origin(run.replace(**wider), GHGS.from_config(wider)).encoder.weights is None
    assert differences(config(), before) == []  # the release has the same encoder
    assert differences(config(), settings) != []
