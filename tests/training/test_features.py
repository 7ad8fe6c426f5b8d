"""Disk cache of the tokens of a frozen ViT, and an encoder with bfloat16 products."""

import logging
import shutil
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

from ghgs_lit.data.augmentation import Augmentation
from ghgs_lit.errors import InputError
from ghgs_lit.geometry.precision import round_products
from ghgs_lit.method.encoder import encoder as encoder_module
from ghgs_lit.training.features import DiskFeatureCache, FeatureCache
from tests.helpers.encoders import SMALL_VGGT, make_encoder
from tests.helpers.people import render_boxes
from tests.helpers.scenes import make_batch
from tests.helpers.verbs import ghgs


def frozen_encoder(seed=0, tokens="all", **options):
    """An encoder in training mode whose ViT is frozen."""
    torch.manual_seed(seed)
    encoder = make_encoder(tokens, **{**SMALL_VGGT, **options}).train()
    for parameter in encoder.aggregator.patch_embed.parameters():
        torch.nn.init.normal_(parameter, std=0.2)
    return encoder


def with_cache(encoder, folder, network="small"):
    encoder.aggregator.patch_embed.cache = FeatureCache(folder, network)
    return encoder


@pytest.fixture
def batch():
    return make_batch(2, 3, 42, 56)


def test_tokens_from_disk_are_those_that_are_computed_up_to_rounding(tmp_path, batch):
    """Tokens are bit-identical whether computed or read, and differ from uncached ones only by the
    rounding to float16."""
    exact = frozen_encoder()(batch.images, batch.masks)
    encoder = with_cache(frozen_encoder(), tmp_path)
    cache = encoder.aggregator.patch_embed.cache
    computed = encoder(batch.images, batch.masks)
    assert (cache.computed, cache.read) == (6, 0)
    found = encoder(batch.images, batch.masks)
    assert (cache.computed, cache.read) == (6, 6)
    assert torch.equal(found.semantic, computed.semantic)
    assert all(torch.equal(a, b) for a, b in zip(found.latent, computed.latent, strict=True))
    assert found.semantic.dtype == torch.float32
    error = (found.semantic - exact.semantic).abs()
    assert error.max() > 0
    assert (error <= exact.semantic.abs() * 2.0**-11 + 2.0**-24).all()
    for layer, expected in zip(found.latent, exact.latent, strict=True):
        assert (layer - expected).abs().max() <= 20 * 2.0**-11 * expected.abs().max()


def test_photographs_are_recognised_by_their_pixels(tmp_path, batch):
    """Images are found in another order, batch and step; one changed value makes another image."""
    encoder = with_cache(frozen_encoder(), tmp_path)
    cache = encoder.aggregator.patch_embed.cache
    first = encoder(batch.images, batch.masks)
    order = torch.tensor([2, 0, 1])
    found = encoder(batch.images[1:, order], batch.masks[1:, order])
    assert cache.computed == 6
    tokens = first.semantic.unflatten(0, (2, 3, -1))[1, order]
    assert torch.equal(found.semantic.unflatten(0, (3, -1)), tokens)
    changed = batch.images.clone()
    changed[0, 0, 0, 0, 0] = changed[0, 0, 0, 0, 0] + 1e-3
    encoder(changed, batch.masks)
    assert cache.computed == 7


def test_a_training_that_was_killed_goes_on_with_what_is_there(tmp_path, batch):
    """Files that are missing, truncated by a full disk or left behind by a killed process are computed
    again."""
    encoder = with_cache(frozen_encoder(), tmp_path)
    cache = encoder.aggregator.patch_embed.cache
    expected = encoder(batch.images, batch.masks)
    files = sorted(tmp_path.rglob("*.npy"))
    assert len(files) == 6
    files[0].unlink()
    content = files[1].read_bytes()
    files[1].write_bytes(content[:-100])
    files[2].write_bytes(b"")
    files[3].with_name(f".{files[3].name}.elsewhere.1.tmp").write_bytes(content[:50])
    found = encoder(batch.images, batch.masks)
    assert cache.computed == 6 + 3
    assert torch.equal(found.semantic, expected.semantic)
    assert files[1].read_bytes() == content
    encoder(batch.images, batch.masks)
    assert cache.computed == 9


def test_other_networks_and_precisions_have_other_tokens(tmp_path, batch):
    """Each network and precision has its own folder."""
    round_products(False)  # reset what an earlier Trainer in this process has set
    round_products(False, "cpu")
    for network, half in (("small", False), ("other", False), ("small", True)):
        encoder = with_cache(frozen_encoder(), tmp_path, network)
        with torch.autocast("cpu", torch.bfloat16, enabled=half):
            encoder(batch.images, batch.masks)
        assert encoder.aggregator.patch_embed.cache.read == 0
    names = {"small-float32-float16", "other-float32-float16", "small-bfloat16-float16"}
    assert {path.name for path in tmp_path.iterdir()} == names


def test_predictions_and_parts_of_photographs_are_computed(tmp_path, batch):
    """The cache is used only in training on whole images."""
    encoder = with_cache(frozen_encoder(), tmp_path)
    exact = frozen_encoder()
    found = encoder.eval()(batch.images, batch.masks)
    assert torch.equal(found.semantic, exact.eval()(batch.images, batch.masks).semantic)
    with_cache(frozen_encoder(tokens="subject", margin=0), tmp_path)(batch.images, batch.masks)
    assert not list(tmp_path.iterdir())


def test_values_beyond_half_precision_are_refused(tmp_path, batch):
    encoder = with_cache(frozen_encoder(), tmp_path)
    torch.nn.init.constant_(encoder.aggregator.patch_embed.norm.bias, 1e5)
    with pytest.raises(InputError, match=r"feature_cache: expected none where tokens are too large"):
        encoder(batch.images, batch.masks)
    assert not list(tmp_path.iterdir())


def test_the_encoder_alone_runs_in_bfloat16_where_the_device_has_it(batch, monkeypatch):
    """On other devices it runs in float32, with the same result as without the option."""
    expected = frozen_encoder()(batch.images, batch.masks)
    encoder = frozen_encoder(precision="bfloat16")
    seen = []
    layer = encoder.aggregator.global_blocks[0].mlp.fc2
    layer.register_forward_hook(lambda module, inputs, out: seen.append(out.dtype))
    for has, dtype in ((False, torch.float32), (True, torch.bfloat16)):
        monkeypatch.setattr("ghgs_lit.geometry.precision.has_bfloat16", lambda device, has=has: has)
        found = encoder(batch.images, batch.masks)
        assert seen.pop() == dtype
        error = (found.latent[1].float() - expected.latent[1]).abs().max()
        assert (error == 0) == (not has)
        assert error < 0.1 * expected.latent[1].abs().max()
    assert encoder_module.bfloat16_where_possible(torch.device("cpu")) is not None
    assert all(parameter.dtype == torch.float32 for parameter in encoder.parameters())


def data_of(**augmentation):
    """Stand-in for a data module with two people in 16 positions each."""
    dataset = SimpleNamespace(size=(518, 512))
    subjects = {name: tuple(range(16)) for name in ("a", "b")}
    module = SimpleNamespace(dataset=dataset, augmentation=Augmentation(**augmentation))
    module.subjects = lambda phase: subjects
    return module


def test_it_says_how_much_room_it_needs_before_it_writes(tmp_path, caplog, monkeypatch):
    """The size is that of 32 images of 37 x 37 patches with 32 channels of two bytes; a full disk is
    reported before training."""
    caplog.set_level(logging.INFO)
    model = SimpleNamespace(encoder=make_encoder(**SMALL_VGGT))
    options = DiskFeatureCache(folder=tmp_path / "features")
    options.attach(model, data_of())
    assert "tokens of 32 photographs of training, 0.0028 GB" in caplog.text
    vit = model.encoder.aggregator.patch_embed
    assert vit.cache.folder == tmp_path / "features"
    other = SimpleNamespace(encoder=make_encoder(**SMALL_VGGT))
    options.attach(other, data_of())
    assert other.encoder.aggregator.patch_embed.cache.network != vit.cache.network
    monkeypatch.setattr(shutil, "disk_usage", lambda path: SimpleNamespace(free=1_000_000))
    with pytest.raises(InputError, match=r"expected 0.0028 GB of room for tokens; found '0.001 GB"):
        options.attach(model, data_of())


def test_it_is_off_where_each_step_sees_other_photographs(tmp_path, caplog):
    """It stays on if augmentation changes only cameras."""
    caplog.set_level(logging.INFO)
    model = SimpleNamespace(encoder=make_encoder(**SMALL_VGGT))
    options = DiskFeatureCache(folder=tmp_path)
    for augmentation in ({"exposure": 0.3}, {"sizes": ((42, 42), (56, 56))}, {"cut": 0.1}):
        options.attach(model, data_of(**augmentation))
        assert model.encoder.aggregator.patch_embed.cache is None
    assert caplog.text.count("feature_cache: off") == 3
    options.attach(model, data_of(calibration=2.0))
    assert model.encoder.aggregator.patch_embed.cache is not None


@pytest.mark.parametrize(
    "options", [{"trainable": "all"}, {"vit": {"kind": "conv"}}], ids=["learns", "no ViT"]
)
def test_a_network_that_learns_has_no_cache(tmp_path, options):
    model = SimpleNamespace(encoder=make_encoder(**{**SMALL_VGGT, **options}))
    with pytest.raises(InputError, match=r"feature_cache: expected none where encoder.vit is no dinov2"):
        DiskFeatureCache(folder=tmp_path).attach(model, data_of())


def test_a_run_and_its_rest_read_what_is_there(tmp_path, monkeypatch):
    """A run from the command line and its continuation share the cached tokens."""
    monkeypatch.chdir(tmp_path)
    boxes = tmp_path / "rendered"
    render_boxes(boxes, tmp_path / "scans", train=1, val=1)
    encoder = "encoder={width: 32, heads: 2, depth: 4, layers: [0, 1, 2, 3], image_size: 28}"
    vit = "encoder.vit={depth: 2, heads: 2}"
    common = [
        "model=paper", "encoder=vggt_1b", encoder, vit, "recalibration.num_heads=2", "data=scans",
        "allow_random_encoder=true", f"data.root={boxes}", "data.size=28", "views=v3", "logger=none",
        "callbacks=none",
        "evaluation.targets=[midway]", "evaluation.pictures=0", "trainer.val_check_interval=1",
        "trainer.limit_val_batches=0",
    ]  # fmt: skip
    cache = ["feature_cache.kind=disk", "feature_cache.folder=features"]
    assert ghgs("train", *common, *cache, "trainer.max_steps=2", "hydra.run.dir=cached") == 0
    files = {path: path.stat().st_mtime_ns for path in Path("features").rglob("*.npy")}
    assert files
    rest = ["resume=cached/checkpoints/last.ckpt"]
    assert ghgs("train", *common, *cache, "trainer.max_steps=4", *rest, "hydra.run.dir=rest") == 0
    after = {path: path.stat().st_mtime_ns for path in Path("features").rglob("*.npy")}
    assert len({path.parents[1] for path in after}) == 1
    assert after.items() >= files.items()
