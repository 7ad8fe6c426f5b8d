"""Encoders of any size."""

from ghgs_lit.method.encoder import VGGTEncoder, VGGTOptions


def make_encoder(tokens: str = "all", margin: int = 1, **options) -> VGGTEncoder:
    """The encoder of ``options`` for ``tokens`` and ``margin``."""
    return VGGTOptions(**options).build(tokens, margin)


#: A frozen ViT of the published kind below an aggregator whose last pair of blocks is trained.
SMALL_VGGT = {
    "width": 32, "heads": 2, "depth": 2, "layers": (0, 1), "image_size": 28,
    "vit": {"kind": "dinov2", "depth": 2, "heads": 2}, "trainable": "last_1",
}  # fmt: skip
