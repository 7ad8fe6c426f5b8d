"""Invalid values of stages are rejected when the configuration is read, by key."""

import pytest

from ghgs_lit.errors import InputError
from ghgs_lit.method.bounds import VisualHull
from ghgs_lit.method.heads.depth import DepthHeadOptions
from ghgs_lit.method.rounds import RoundsOptions
from tests.helpers.encoders import make_encoder
from tests.helpers.tokens import make_stage
from tests.method.heads.test_gaussian import make_head

SMALL = {"width": 32, "heads": 2, "depth": 2, "layers": (0, 1), "vit": {"kind": "stem", "channels": 8}}
BRANCH = {"width": 16, "depth": 2, "heads": 2, "channels": 8}
DINO = {"kind": "dinov2", "depth": 1, "heads": 2}


def encoder(**options):
    return make_encoder(**{**SMALL, **options})


REFUSED = [
    (encoder, {"heads": 5}, "encoder.width"),
    (encoder, {"layers": (1, 0)}, "encoder.layers"),
    (encoder, {"layers": (0, 2)}, "encoder.layers"),
    (encoder, {"layers": (0,)}, "encoder.layers"),
    (encoder, {"vit": {"kind": "resnet"}}, "encoder.vit.kind: .* one of conv, stem, dinov2; found 'resnet'"),
    (encoder, {"vit": {"kind": "stem", "chanels": 8}}, "encoder.vit.chanels: .*found 'chanels'"),
    (encoder, {"vit": {"kind": "stem"}}, "vit.channels: expected a number with kind=stem; found None"),
    (encoder, {"vit": {"kind": "conv", "heads": 2}}, "vit.heads: expected null with kind=conv; found 2"),
    (encoder, {"vit": DINO, "image_size": 100}, "encoder.image_size"),
    (encoder, {"vit": {**DINO, "heads": 3}}, "a multiple of vit.heads=3; found 32"),
    (encoder, {"patch_size": 0}, "encoder.patch_size: expected an integer >= 1 and <= 1024; found 0"),
    (encoder, {"trainable": "last_3"}, "encoder.trainable"),
    (encoder, {"trainable": "some"}, "encoder.trainable"),
    (encoder, {"semantic": {**BRANCH, "heads": 3}}, "encoder.semantic.width: expected a multiple of 4"),
    (encoder, {"semantic": {**BRANCH, "chanels": 8}}, "semantic.chanels: expected one of .*found 'chanels'"),
    (VisualHull, {"tolerance": -1}, r"bounds\.tolerance"),
    (VisualHull, {"samples": 1}, r"bounds\.samples"),
    (VisualHull, {"dilation": 0.9}, r"bounds\.dilation"),
    (DepthHeadOptions, {"parameterization": "linar"}, "depth_head.parameterization: .* bounded_inverse"),
    (DepthHeadOptions, {"pixels": "all"}, "depth_head.pixels: expected one of .*; found 'pixels'"),
    (DepthHeadOptions, {"start": 1.0}, "depth_head.start"),
    (DepthHeadOptions, {"guide": False, "consistency_depths": 4}, r"depth_head\.consistency_depths"),
    (DepthHeadOptions, {"guide": True, "consistency_depths": -1}, r"depth_head\.consistency_depths"),
    (make_head, {"photo_consistency": True}, r"gaussian_head\.photo_consistency"),
    (make_head, {"parameterization": "ours"}, "gaussian_head.parameterization"),
    (make_head, {"pixels": "all"}, "gaussian_head.pixels: expected one of .*; found 'pixels'"),
    (make_head, {"hidden": [32]}, "gaussian_head.hidden"),
    (make_head, {"attributes": {"scale_start": 0.1}}, "gaussian_head.attributes.scale_start"),
    (make_head, {"attributes": {"thickness_start": 0.0}}, "gaussian_head.attributes.thickness_start"),
    (make_head, {"attributes": {"thickness_start": 5.0}}, "gaussian_head.attributes.thickness_start"),
    (make_head, {"attributes": {"inward": -1.0}}, "gaussian_head.attributes.inward"),
    (make_head, {"axes": "camera"}, "gaussian_head.axes"),
    (make_head, {"attributes": {"opacity_floor": 0.8}}, "gaussian_head.attributes.opacity_floor"),
    (make_stage, {"k": 0}, "recalibration.k"),
    (make_stage, {"k": 1.5}, "recalibration.k"),
    (make_stage, {"similarity": "cosine"}, "recalibration.similarity: expected one of product"),
    (make_stage, {"neighborhood": "feature"}, "recalibration.neighborhood: expected one of xyz, image_plane"),
    (make_stage, {"neighbors": "all"}, "recalibration.neighbors: expected one of .*found 'neighbors'"),
    (make_stage, {"tokens": "most"}, "recalibration.tokens"),
    (make_stage, {"num_heads": 5}, "recalibration.num_heads"),
    (make_stage, {"positions": "relative", "neighborhood": "image_plane"}, "positions: expected none with"),
    (RoundsOptions, {"exchange": 0}, r"rounds\.exchange: expected an integer >= 1 and <= 65536 or null"),
]


@pytest.mark.parametrize(("make", "options", "message"), REFUSED)
def test_impossible_options_are_refused(make, options, message):
    with pytest.raises(InputError, match=message):
        make(**options)
