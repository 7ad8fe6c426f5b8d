"""Published weights are imported strictly and predict; downloads are checked."""

import hashlib
import itertools
import sys
import types
import warnings

import pytest
import torch
from safetensors.torch import save_file

from ghgs_lit.config import run_of
from ghgs_lit.errors import InputError
from ghgs_lit.method.model import GHGS
from ghgs_lit.training import start
from ghgs_lit.weights import published
from ghgs_lit.weights.checkpoint import model_state, read_checkpoint
from ghgs_lit.weights.published import RELEASE, VGGT, VGGT_IGNORED, match_names, to_ours
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
    write_published,
)


@pytest.fixture
def files(tmp_path):
    (vggt, release), tensors = write_published(tmp_path)
    return str(vggt), str(release), *tensors


def meta(shapes, prefix=""):
    return {prefix + name: torch.empty(shape, device="meta") for name, shape in shapes.items()}


@pytest.mark.parametrize("prefix", ["", "aggregator."])
def test_the_published_names_and_shapes_are_exactly_the_models(prefix):
    """The published files fill the full-size model exactly, tensor by tensor."""
    own = GHGS.from_config(config(tiny=False), empty=True).state_dict()
    assert all(tensor.is_meta for tensor in own.values())
    assert all(name.startswith(VGGT_IGNORED) for name in OTHER_HEADS)
    encoder = match_names(own, meta(PUBLISHED["vggt"], prefix), VGGT, "vggt")
    heads = match_names(own, meta(PUBLISHED["network"]), RELEASE, "release")
    assert (len(encoder), len(heads)) == (1210, 164)
    assert encoder.keys() | heads.keys() == own.keys()
    assert sum(own[name].numel() for name in encoder) == 909_112_320
    assert sum(own[name].numel() for name in heads) == 77_942_669
    back = {published.to_published(name, VGGT) or published.to_published(name, RELEASE) for name in own}
    assert back == {f"aggregator.{name}" for name in PUBLISHED["vggt"]} | set(PUBLISHED["network"])


@pytest.mark.parametrize("suffix", [".safetensors", ".pt"])
def test_an_imported_model_is_the_published_one(tmp_path, suffix):
    """Detects tensors that are renamed wrongly, changed or lost."""
    (vggt, release), (agg, network) = write_published(tmp_path, suffix)
    out = tmp_path / "out.ckpt"
    report = import_weights(config(), out, str(vggt), str(release))
    assert "ignored (camera_head 1, depth_head 62, point_head 1, track_head 1)" in report[0]
    assert report[1].endswith(f"{len(network)} tensors used, 0 ignored")
    checkpoint = read_checkpoint(out)
    assert checkpoint["config"]["encoder"]["weights"] == f"vggt{suffix}"
    assert checkpoint["config"]["compat"]["name"] == "release"
    assert checkpoint["imported"]["release"]["tensors"] == len(network)
    assert checkpoint["imported"]["vggt"]["sha256"] == hashlib.sha256(vggt.read_bytes()).hexdigest()
    expected = GHGS.from_config(config())
    renamed = {to_ours(name, VGGT): value for name, value in agg.items()}
    renamed |= {to_ours(name, RELEASE): value for name, value in network.items()}
    expected.load_state_dict({name: value for name, value in renamed.items() if name is not None})
    batch = make_batch(1, 3, 50, 64)  # padded to 56 x 70
    with torch.no_grad():
        close(predict(load_model(out), batch).gaussians, predict(expected, batch).gaussians, 0)
    state = model_state(checkpoint)
    assert all(torch.equal(state[name], value) for name, value in renamed.items() if name is not None)


def test_without_the_release_the_file_holds_the_encoder_alone(monkeypatch, capsys, tmp_path, files):
    """Heads are initialised from the seed of each training; tables show the origin of the encoder's
    weights; such a file cannot predict."""
    vggt, _, agg, _ = files
    monkeypatch.chdir(tmp_path)
    out, settings = "start.ckpt", config("compat=none", "encoder.trainable=last_1")
    assert import_weights(settings, out, vggt)[-1].startswith("the encoder alone")
    checkpoint = read_checkpoint(out)
    assert list(checkpoint["config"]) == ["encoder"]
    used = {to_ours(name, VGGT): value for name, value in agg.items()}
    state = model_state(checkpoint)
    assert state.keys() == {name for name in used if name is not None}
    assert all(torch.equal(state[name], used[name]) for name in state)
    starts = []
    for seed in (1, 2, 3):
        torch.manual_seed(seed)
        model = GHGS.from_config(settings)
        drawn = {name: tensor.clone() for name, tensor in model.state_dict().items()}
        lines = start.initialize(model, out, strict=True)
        assert all(line.startswith("loaded" if " encoder." in line else "missing") for line in lines)
        starts.append(model.state_dict())
        heads = [name for name in drawn if name not in state]
        assert all(torch.equal(starts[-1][name], drawn[name]) for name in heads)
        assert all(torch.equal(starts[-1][name], state[name]) for name in state)
    random = [name for name in heads if drawn[name].unique().numel() > 1]  # others are constants
    assert len(random) > 60
    for one, other in itertools.combinations(starts, 2):
        assert not any(torch.equal(one[name], other[name]) for name in random)

    run = run_of("train", ["resume=null", f"init_from={out}"]).replace(**settings)
    assert start.with_origin(run, model).encoder.weights == "vggt.safetensors"
    afresh = run.replace(init_from=None)
    assert start.with_origin(afresh, model) is afresh
    wider = config("compat=none", "encoder.mask_input=true")
    assert start.with_origin(run.replace(**wider), GHGS.from_config(wider)).encoder.weights is None

    for argv, message in (
        (["predict", "data=synthetic"], "a whole model; found the encoder alone (`ghgs train init_from="),
        (["export", "inference=small.ckpt"], "a whole model; found 'the encoder alone'"),
    ):
        code, _, err = call(monkeypatch, capsys, *argv, "checkpoint=start.ckpt")
        assert (code, err.count("\n")) == (1, 1)
        assert f"start.ckpt: expected {message}" in err
    assert not list(tmp_path.glob("small*"))


@pytest.mark.parametrize("dtype", ["bfloat16", "float16"])
def test_the_encoders_precision_is_a_choice(tmp_path, files, dtype):
    """Half precision affects the encoder alone, and stays close to the float32 model."""
    vggt, release, agg, _ = files
    out = tmp_path / "out.ckpt"
    import_weights(config(), out, vggt, release, dtype)
    half = getattr(torch, dtype)
    state = model_state(read_checkpoint(out))
    assert {state[name].dtype for name in state if name.startswith("encoder.")} == {half}
    assert {state[name].dtype for name in state if not name.startswith("encoder.")} == {torch.float32}
    model = load_model(out, dtype=half)
    heads = (*model.depth_head.parameters(), *model.gaussian_head.parameters())
    assert {p.dtype for p in model.encoder.parameters()} == {half}
    assert {p.dtype for p in heads} == {torch.float32}
    token = agg["aggregator.camera_token"]
    assert torch.equal(model.encoder.aggregator.camera_token, token.to(half))
    wide = load_model(out, dtype=torch.float32)
    assert {p.dtype for p in wide.parameters()} == {torch.float32}
    batch = make_batch(1, 3)
    with torch.no_grad():
        found, expected = predict(model, batch), predict(wide, batch)
    assert found.gaussians.means.dtype == torch.float32
    inverse = [1 / prediction.depth[batch.masks] for prediction in (found, expected)]
    assert (inverse[0] - inverse[1]).abs().max() < 0.05 * inverse[1].abs().max()


NORM = "blk.norm1.weight"
#: Changes of the release's tensors, and the resulting error.
TAMPERED = [
    (lambda n: n.pop(NORM), rf"{NORM}: expected a tensor of .*\(64,\); .*nothing"),
    (lambda n: n.update({"blk.lam_s": torch.ones(1)}), r"blk\.lam_s: expected no such tensor"),
    (lambda n: n.update({"smpl.x": torch.ones(1)}), r"smpl\.x: expected a tensor of these .* unknown"),
    (
        lambda n: n.update({NORM: torch.ones(3)}),
        rf"{NORM}: expected shape \(64,\) of the configured model; found \(3,\)",
    ),
    (lambda n: n[NORM].fill_(float("nan")), rf"{NORM}: expected finite numbers"),
    (lambda n: n.update({NORM: 3}), rf"{NORM}: .* found 'int'"),
    (lambda n: n.update({NORM: torch.ones(64, dtype=torch.long)}), rf"{NORM}: expected floating point"),
]


@pytest.mark.parametrize(("change", "message"), TAMPERED)
def test_a_tensor_that_does_not_fit_is_named(tmp_path, files, change, message):
    """A damaged release is rejected with the tensor's name, and no checkpoint is written."""
    network = dict(files[3])
    change(network)
    torch.save({"network": network}, tmp_path / "release.pth")
    with pytest.raises(InputError, match=r"release\.pth: " + message):
        import_weights(config(), tmp_path / "out.ckpt", files[0], str(tmp_path / "release.pth"))
    assert not (tmp_path / "out.ckpt").exists()


@pytest.mark.parametrize(
    ("vggt", "release", "out", "message"),
    [
        ("release.pth", None, "out.ckpt", r"release\.pth: network: expected a tensor of these"),
        ("vggt.safetensors", "vggt.safetensors", "out.ckpt", r"expected the entry 'network'; found 'aggreg"),
        (None, "release.pth", "out.ckpt", "vggt: expected a file or facebook/VGGT-1B"),
        ("vggt.safetensors", "release.pth", "vggt.safetensors", "out: expected another file"),
        ("none.safetensors", None, "out.ckpt", r"none\.safetensors"),
        ("twice.safetensors", "release.pth", "out.ckpt", "camera_token too"),
    ],
)
def test_files_in_the_wrong_place_are_refused(monkeypatch, tmp_path, files, vggt, release, out, message):
    """Swapped files, missing ones, two tensors with one name, and overwriting the input."""
    monkeypatch.chdir(tmp_path)
    twice = {name: tensor.clone() for name, tensor in files[2].items()}
    save_file({**twice, "camera_token": twice["aggregator.camera_token"].clone()}, "twice.safetensors")
    with pytest.raises((InputError, FileNotFoundError), match=message):
        import_weights(config(), out, vggt, release)


def test_the_verb(monkeypatch, capsys, tmp_path, files):
    """The command passes its keys on, and prints the path last."""
    monkeypatch.chdir(tmp_path)
    given = ["vggt=vggt.safetensors", "release=release.pth", "out=a/out.ckpt", *TINY]
    code, out, _ = call(monkeypatch, capsys, "import", *given)
    assert code == 0
    assert "differs from the release" not in out
    assert out.splitlines()[-1] == "wrote a/out.ckpt"


@pytest.mark.parametrize(("skip", "tokens"), [("balanced", "window"), ("fast", "subject"), ("exact", None)])
def test_fewer_tokens_with_the_authors_weights_give_a_warning(tmp_path, files, skip, tokens):
    """They were trained on whole images: the cost of leaving out patches is unknown."""
    out = tmp_path / "out.ckpt"
    import_weights(config(f"skip={skip}"), out, *files[:2])
    with warnings.catch_warnings(record=True) as seen:
        warnings.simplefilter("always")
        load_model(out)
    said = [str(warning.message) for warning in seen if "skip.tokens" in str(warning.message)]
    assert [text.split("; found ")[1].split(",")[0] for text in said] == [tokens] * (tokens is not None)


def test_switches_that_differ_from_the_releases_are_listed():
    """Users are told which parts of a model differ from the authors' code."""
    assert differences(config()) == []
    found = differences(config("unprojection.tokens=subject"))
    assert found == ["unprojection.tokens=subject for release"]
    assert any("depth_head.parameterization" in line for line in differences(config("compat=none")))
    assert differences(config(), config()) == []
    assert differences(config(), {"encoder": config()["encoder"]}) == []


def fake_client(monkeypatch, cached=None, download=None):
    """A client of the hub whose cache holds ``cached`` and whose download returns ``download``."""
    client = types.ModuleType("huggingface_hub")
    client.hf_hub_url = lambda repository, filename: f"https://hub.test/{repository}/resolve/main/{filename}"
    client.try_to_load_from_cache = lambda repository, filename: cached
    client.hf_hub_download = download or (lambda *_: pytest.fail("no download was needed"))
    monkeypatch.setitem(sys.modules, "huggingface_hub", client)


def cached_file(folder, content, name=None):
    """A file as the client caches it: named by its checksum, behind a link."""
    blob = folder / (name or hashlib.sha256(content).hexdigest())
    blob.write_bytes(content)
    link = folder / "model.safetensors"
    link.symlink_to(blob)
    return str(link)


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("facebook/VGGT-1B", True),
        ("weights/model.safetensors", False),
        ("weights/model.pt", False),
        ("/data/vggt/model", False),
        ("model", False),
        ("a/b/c", False),
        ("there/VGGT-1B", False),
    ],
)
def test_repositories_and_files_are_distinguished(monkeypatch, tmp_path, name, expected):
    """A file name is not looked up on the hub, nor a repository on the disk; an existing file with a
    repository's name is a file."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "there").mkdir()
    (tmp_path / "there" / "VGGT-1B").write_bytes(b"x")
    assert published.is_repository(name) is expected


def test_a_cached_file_needs_no_network_and_a_download_is_checked(monkeypatch, tmp_path):
    """Downloaded weights work offline; a broken download is rejected."""
    path = cached_file(tmp_path, b"weights")
    fake_client(monkeypatch, cached=path)
    _, found, checksum = published.fetch("facebook/VGGT-1B")
    assert (str(found), checksum) == (path, hashlib.sha256(b"weights").hexdigest())
    (tmp_path / "model.safetensors").unlink()
    broken = cached_file(tmp_path, b"half of the wei", name="0" * 64)
    fake_client(monkeypatch, download=lambda *_: broken)
    with pytest.raises(InputError, match=r"0{64}: expected SHA-256 0{64}; found '\w{64}: a broken download"):
        published.fetch("facebook/VGGT-1B")


def test_what_the_hub_refuses_is_one_line(monkeypatch):
    """The client's long error becomes one line with the file to fetch; without the package, the error
    names its extra."""

    def refuse(*_):
        raise RuntimeError("Repository Not Found.\nMake sure that you are logged in.")

    fake_client(monkeypatch, download=refuse)
    with pytest.raises(InputError, match=r"found: Repository Not Found\.") as caught:
        published.fetch("facebook/VGGT-1B")
    address = "https://hub.test/facebook/VGGT-1B/resolve/main/model.safetensors"
    assert f"Download {address} by hand and set vggt=<that file>" in str(caught.value)
    assert "\n" not in str(caught.value)
    monkeypatch.setitem(sys.modules, "huggingface_hub", None)
    with pytest.raises(InputError, match=r"the package huggingface_hub \(pip install 'ghgs-lit\[hub\]'"):
        published.fetch("facebook/VGGT-1B")
