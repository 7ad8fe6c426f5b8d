"""Tokens on disk: the same tokens, never those of something else."""

import dataclasses
import multiprocessing
import os

import pytest
import torch

from ghgs_lit.encoder import FeatureCache, FeatureCacheOptions, PhotographCache
from ghgs_lit.errors import InputError
from ghgs_lit.types import DepthBounds
from tests.helpers.encoders import make_encoder
from tests.helpers.models import close, make_model
from tests.helpers.scenes import make_batch

OPTIONS = {"width": 32, "heads": 2, "depth": 2, "layers": (0, 1), "vit": {"kind": "stem", "channels": 8}}


def make(seed=0, **options):
    torch.manual_seed(seed)
    return make_encoder(**{**OPTIONS, "trainable": "none", **options})


def views(b=1, v=2, height=70, width=84, seed=1):
    g = torch.Generator().manual_seed(seed)
    masks = torch.zeros(b, v, height, width, dtype=torch.bool)
    masks[:, :, 30:40, 30:33] = True
    return torch.rand(b, v, 3, height, width, generator=g), masks


def same(a, b):
    assert (a.grid, a.patch_size) == (b.grid, b.patch_size)
    for field in ("semantic", "image", "row", "column"):
        assert torch.equal(getattr(a, field), getattr(b, field))
    assert len(a.latent) == len(b.latent)
    assert all(torch.equal(x, y) and x.dtype == y.dtype for x, y in zip(a.latent, b.latent, strict=True))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64, torch.bfloat16])
def test_all_tokens_come_back_bit_for_bit(tmp_path, dtype):
    """A cached run must see exactly the tokens of an uncached one."""
    encoder = make().to(dtype)
    images, masks = views(b=2)
    expected = [encoder(images[b : b + 1], masks[b : b + 1]) for b in range(2)]
    stored = {torch.float64: "float32"}.get(dtype, str(dtype).removeprefix("torch."))
    cache = FeatureCache(tmp_path, dtype=stored)
    first, second = (encoder(images, masks, cache=cache) for _ in range(2))
    same(first, second)
    assert (cache.hits, cache.made) == (2, 2)
    if dtype != torch.float64:
        for b, one in enumerate(expected):
            mine = first.image // 2 == b
            assert all(torch.equal(x[mine], y) for x, y in zip(first.latent, one.latent, strict=True))
    assert first.latent[0].dtype == dtype


@pytest.mark.parametrize("change", ["weight", "image", "mask", "bounds", "option", "autocast"])
def test_whatever_changes_the_tokens_misses(tmp_path, change):
    """A hit for other weights or photographs would be a silent wrong result."""
    encoder = make(bounds_input=change == "bounds", mask_input=True)
    images, masks = views()
    depth = torch.ones_like(masks, dtype=torch.float32)
    bounds, cache = DepthBounds(depth, 2 * depth), FeatureCache(tmp_path)
    encoder(images, masks, bounds, cache)
    assert encoder(images, masks, bounds, cache) is not None
    assert (cache.hits, cache.made) == (1, 1)
    if change == "weight":
        encoder.aggregator.frame_blocks[0].mlp.fc1.weight[0, 0] += 1e-3
    elif change == "image":
        images[0, 1, 2, 3, 4] += 1e-3
    elif change == "mask":
        masks[0, 0, 0, 0] = True
    elif change == "bounds":
        bounds.far[0, 1, 2, 3] += 1e-3
    elif change == "option":
        cache, encoder.options = FeatureCache(tmp_path), encoder.options.replace(heads=4)
    made = cache.made
    with torch.autocast("cpu", torch.bfloat16, enabled=change == "autocast"):
        encoder(images, masks, bounds, cache)
    assert cache.made == made + 1


def test_masks_that_nothing_reads_do_not_miss(tmp_path):
    """A mask that has no influence must not make the cache encode again."""
    encoder = make()
    images, masks = views()
    cache = FeatureCache(tmp_path)
    encoder(images, masks, cache=cache)
    encoder(images, ~masks, cache=cache)
    assert (cache.hits, cache.made) == (1, 1)


def test_few_tokens_are_cached_as_they_are(tmp_path):
    """Tokens without a background depend on the mask and on what is kept, and come back as they were."""
    images, masks = views()
    for margin, made in ((0, 1), (1, 2)):
        encoder, cache = make(tokens="subject", margin=margin), FeatureCache(tmp_path)
        expected = encoder(images, masks)
        assert not expected.is_dense
        same(encoder(images, masks, cache=cache), expected)
        same(encoder(images, masks, cache=cache), expected)
        assert (cache.hits, cache.made) == (1, 1)
        assert len(list(tmp_path.glob("*/*.safetensors"))) == made
    masks[0, 1] = False
    assert len(encoder(images, masks, cache=cache).image) == len(expected.image) / 2
    assert cache.made == 2


@pytest.mark.parametrize("left", [0, 7, 2000])
def test_a_truncated_file_is_written_again(tmp_path, left, capsys):
    """A file that a crash cut off must be replaced, with a message."""
    encoder = make()
    images, masks = views()
    cache = FeatureCache(tmp_path)
    expected = encoder(images, masks, cache=cache)
    (path,) = tmp_path.glob("*/*.safetensors")
    path.write_bytes(path.read_bytes()[:left])
    same(encoder(images, masks, cache=cache), expected)
    assert str(path) in capsys.readouterr().out
    same(encoder(images, masks, cache=cache), expected)
    assert (cache.hits, cache.made) == (1, 2)
    assert list(path.parent.iterdir()) == [path]


def test_half_precision_files_give_the_same_twice(tmp_path):
    """The first run must see the rounded tokens that later runs see."""
    encoder = make()
    images, masks = views()
    exact = encoder(images, masks)
    cache = FeatureCache(tmp_path, dtype="bfloat16")
    first, second = (encoder(images, masks, cache=cache) for _ in range(2))
    same(first, second)
    assert first.latent[0].dtype == torch.float32
    error = (first.latent[0] - exact.latent[0]).abs().max()
    assert 0 < error <= 2**-8 * exact.latent[0].abs().max()


def _work(directory, queue):
    torch.set_num_threads(1)
    encoder, cache = make(), FeatureCache(directory)
    found = [encoder(*views(seed=seed), cache=cache).latent[1].sum().item() for seed in range(6)]
    queue.put((found, cache.hits + cache.made))


def test_two_processes_share_a_directory(tmp_path):
    """Runs of a sweep must not corrupt each other's files."""
    context = multiprocessing.get_context("fork")
    queue = context.Queue()
    workers = [context.Process(target=_work, args=(tmp_path, queue)) for _ in range(2)]
    for worker in workers:
        worker.start()
    found = [queue.get(timeout=60) for _ in workers]
    for worker in workers:
        worker.join()
        assert worker.exitcode == 0
    assert found[0] == found[1]
    assert found[0][1] == 6
    assert len(list(tmp_path.glob("*/*"))) == 6


def test_an_encoder_that_learns_is_refused(tmp_path):
    """Tokens from disk carry no gradient: a trained encoder would not learn."""
    encoder, cache = make(trainable="last_1"), FeatureCache(tmp_path)
    with pytest.raises(InputError, match="feature_cache: expected a frozen encoder"):
        encoder(*views(), cache=cache)
    with torch.no_grad():
        encoder(*views(), cache=cache)
    assert cache.made == 1


def test_the_report_says_how_much_there_is(tmp_path):
    """The user must see whether the cache worked and what it takes on disk."""
    encoder, cache = make(), FeatureCache(tmp_path / "new")
    images, masks = views()
    encoder(images, masks, cache=cache)
    encoder(images, masks, cache=cache)
    size = sum(path.stat().st_size for path in tmp_path.glob("new/*/*"))
    assert cache.report() == (
        f"feature cache {tmp_path / 'new'}: 1 found, 1 made ({size / 1e6:.1f} MB; tokens, float32);"
        f" 1 files, {size / 1e6:.1f} MB in all"
    )


def test_the_oldest_files_make_room(tmp_path):
    """A training of days must not fill the disk: the size is bounded and the newest samples stay."""
    encoder = make()
    first = FeatureCache(tmp_path)
    encoder(*views(seed=1), cache=first)
    one = first.written
    for place, file in enumerate(tmp_path.glob("*/*")):
        os.utime(file, (place, place))
    cache = FeatureCache(tmp_path, max_gb=2.5 * one / 1e9)
    for seed in (2, 3, 4):
        encoder(*views(seed=seed), cache=cache)
        assert sum(file.stat().st_size for file in tmp_path.glob("*/*")) <= 2.5 * one
    assert (cache.made, cache.deleted) == (3, 2)
    assert "2 old ones deleted (feature_cache.max_gb)" in cache.report()
    encoder(*views(seed=4), cache=cache)
    encoder(*views(seed=1), cache=cache)
    assert (cache.hits, cache.made) == (1, 4)


@pytest.mark.parametrize("option", [{"of": "most"}, {"dtype": "int8"}, {"max_gb": 0}, {"max_gb": -1.5}])
def test_impossible_options_are_refused(tmp_path, option):
    """A bad value is found when the configuration is read, by its key."""
    with pytest.raises(InputError, match=f"feature_cache.{next(iter(option))}"):
        FeatureCacheOptions(directory=str(tmp_path), **option)


def test_tokens_of_a_hit_need_no_encoder(tmp_path, monkeypatch):
    """A hit must not run the encoder, which is the point of the cache."""
    encoder = make()
    images, masks = views()
    cache = FeatureCache(tmp_path)
    expected = encoder(images, masks, cache=cache)
    monkeypatch.setattr(encoder, "encode", lambda *_: pytest.fail("encoded"))
    same(encoder(images, masks, cache=cache), expected)
    assert dataclasses.asdict(expected)["grid"] == (1, 2, 5, 6)


@pytest.mark.parametrize("recalibrated", ["subject", "all"])
def test_predictions_are_those_without_a_cache(tmp_path, recalibrated):
    """Recalibration and heads must not see other tokens."""
    model = make_model("model=paper", f"recalibration.tokens={recalibrated}").eval()
    batch = make_batch(height=140, width=112, views=3)
    with torch.no_grad():
        expected = model(batch)
        model.feature_cache = cache = FeatureCacheOptions(directory=str(tmp_path)).build()
        first, second = model(batch), model(batch)
    assert (cache.hits, cache.made) == (1, 1)
    close(second.gaussians, first.gaussians, 0.0)
    assert torch.equal(first.gaussians.means, expected.gaussians.means)


def test_no_directory_is_no_cache():
    """Without a directory nothing is written, and a model has no cache of its own."""
    assert FeatureCacheOptions().build() is None
    assert make_model("model=paper").feature_cache is None


DINO = {"vit": {"kind": "dinov2", "depth": 2, "heads": 2}, "image_size": 70}


@pytest.mark.parametrize("tokens", ["all", "subject"])
def test_photographs_are_found_in_any_order(tmp_path, tokens):
    """Training draws views at random: each photograph must be encoded once, with the result of no cache."""
    encoder, cache = make(tokens=tokens, **DINO), PhotographCache(tmp_path)
    images, masks = views(b=2, v=3)
    for order, made in (([0, 1], 4), ([1, 0], 4), ([2, 1], 6)):
        expected = encoder(images[:, order], masks[:, order])
        same(encoder(images[:, order], masks[:, order], cache=cache), expected)
        assert cache.made == made
    assert cache.hits == 6
    assert "patch tokens of photographs" in cache.report()


def test_photographs_are_encoded_once_where_the_aggregator_learns(tmp_path):
    """The frozen part comes from disk, the rest gets the gradient that it has without a cache."""
    encoder, cache = make(trainable="last_1", **DINO), PhotographCache(tmp_path)
    images, masks = views()
    gradients = []
    for used in (None, cache, cache):
        encoder.zero_grad()
        encoder(images, masks, cache=used).latent[1].square().sum().backward()
        gradients.append([p.grad.clone() for p in encoder.parameters() if p.grad is not None])
    assert (cache.hits, cache.made) == (2, 2)
    assert len(gradients[0]) > 10
    for found in gradients[1:]:
        assert all(torch.equal(a, b) for a, b in zip(found, gradients[0], strict=True))


@pytest.mark.parametrize("change", ["weight", "image", "kept", "autocast", "aggregator"])
def test_only_what_a_photograph_depends_on_misses(tmp_path, change):
    """Another patch encoder or photograph must not be served; other blocks of the aggregator may be."""
    encoder, cache = make(tokens="subject", **DINO), PhotographCache(tmp_path)
    images, masks = views()
    encoder(images, masks, cache=cache)
    if change == "weight":
        encoder.aggregator.patch_embed.blocks[0].mlp.fc1.weight[0, 0] += 1e-3
    elif change == "image":
        images[0, 1, 2, 3, 4] += 1e-3
    elif change == "kept":
        masks[0, 1, 60, 60] = True
    elif change == "aggregator":
        encoder.aggregator.frame_blocks[0].mlp.fc1.weight[0, 0] += 1e-3
    with torch.autocast("cpu", torch.bfloat16, enabled=change == "autocast"):
        encoder(images, masks, cache=cache)
    new = {"weight": 2, "image": 1, "kept": 1, "autocast": 2, "aggregator": 0}[change]
    assert (cache.made, cache.hits) == (2 + new, 2 - new)


def test_a_patch_encoder_that_learns_is_refused(tmp_path):
    """Patch tokens from disk carry no gradient."""
    with pytest.raises(InputError, match="feature_cache: expected a frozen patch encoder"):
        make(trainable="all", **DINO)(*views(), cache=PhotographCache(tmp_path))


def test_a_cache_is_of_views_or_of_photographs(tmp_path):
    """A typing error must not choose another cache."""
    options = {"directory": str(tmp_path), "dtype": "bfloat16", "max_gb": 2}
    assert isinstance(FeatureCacheOptions(**options, of="views").build(), FeatureCache)
    cache = FeatureCacheOptions(**options, of="photographs").build()
    assert (type(cache), cache.dtype, cache.limit) == (PhotographCache, "bfloat16", 2_000_000_000)
    with pytest.raises(InputError, match=r"feature_cache\.of: expected one of views, photographs"):
        FeatureCacheOptions(**options, of="people")
