"""Which trainings keep tokens on disk, and what they say before."""

import json
import logging
import shutil
from pathlib import Path
from types import SimpleNamespace

import pytest

from ghgs_lit.data.augmentation import Augmentation
from ghgs_lit.errors import InputError
from ghgs_lit.training.features import DiskFeatureCache
from tests.helpers.encoders import SMALL_VGGT, make_encoder
from tests.helpers.people import render_boxes
from tests.helpers.verbs import ghgs


def data_of(**augmentation):
    """A data module of two people in 16 positions each."""
    dataset = SimpleNamespace(size=(518, 512))
    subjects = {name: tuple(range(16)) for name in ("a", "b")}
    module = SimpleNamespace(dataset=dataset, augmentation=Augmentation(**augmentation))
    module.subjects = lambda phase: subjects
    return module


def test_it_says_how_much_room_it_needs_before_it_writes(tmp_path, caplog, monkeypatch):
    """32 photographs of 37 x 37 patches, 32 channels of two bytes;
    a full disk is found at the start."""
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
    """But not where augmentation moves cameras alone."""
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
    """From the command line: a run that is stopped, its rest,
    and the same run without the cache."""
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
    cache = ["feature_cache=disk", "feature_cache.folder=features"]
    assert ghgs("train", *common, *cache, "trainer.max_steps=2", "hydra.run.dir=cached") == 0
    files = {path: path.stat().st_mtime_ns for path in Path("features").rglob("*.npy")}
    assert files
    rest = ["resume=cached/checkpoints/last.ckpt"]
    assert ghgs("train", *common, *cache, "trainer.max_steps=4", *rest, "hydra.run.dir=rest") == 0
    after = {path: path.stat().st_mtime_ns for path in Path("features").rglob("*.npy")}
    assert len({path.parents[1] for path in after}) == 1
    assert after.items() >= files.items()
    assert ghgs("train", *common, "trainer.max_steps=4", "hydra.run.dir=plain") == 0
    psnr = []
    for run in ("rest", "plain"):
        psnr.append(json.loads(Path(run, "metrics.json").read_text())["rows"][0]["psnr"])
    assert psnr[0] == pytest.approx(psnr[1], abs=0.05)
