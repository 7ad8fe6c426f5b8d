"""Tables of published prefixes of tensor names and ours; the rest of a name is the same."""

from collections.abc import Mapping

#: facebook/VGGT-1B. A file of the aggregator alone has no prefix ``aggregator.``.
VGGT = {
    "aggregator.": "encoder.aggregator.",
    "camera_token": "encoder.aggregator.camera_token",
    "register_token": "encoder.aggregator.register_token",
    "patch_embed.": "encoder.aggregator.patch_embed.",
    "frame_blocks.": "encoder.aggregator.frame_blocks.",
    "global_blocks.": "encoder.aggregator.global_blocks.",
}

#: Parts of VGGT-1B that the method does not have: 62, 62, 69 and 394 tensors.
VGGT_IGNORED = ("depth_head.", "point_head.", "camera_head.", "track_head.")

#: The checkpoint of the authors' release, under the key ``network``.
RELEASE = {
    "pos_head.": "depth_head.dpt.",
    "blk.": "recalibration.block.",
    "decoder.": "gaussian_head.decoder.",
    "offset_header.": "gaussian_head.offset_header.",
    "scale_header.": "gaussian_head.scale_header.",
    "rot_header.": "gaussian_head.rot_header.",
    "opacity_header.": "gaussian_head.opacity_header.",
}
RELEASE_ENTRY = "network"

UNPUBLISHED = ".guide."  #: Part of the names of tensors that only our variants of the model have


def to_ours(name: str, table: Mapping[str, str]) -> str | None:
    """Our name of a published tensor.

    Args:
        name: the published one.
        table: our prefixes by published ones.

    Returns:
        The name; None if ``table`` has none.
    """
    for published, ours in table.items():
        if name.startswith(published):
            return ours + name.removeprefix(published)
    return None


def to_published(name: str, table: Mapping[str, str]) -> str | None:
    """The published name of one of our tensors.

    Args:
        name: ours.
        table: our prefixes by published ones.

    Returns:
        The name; None if it has none.
    """
    if UNPUBLISHED in name:
        return None
    for published, ours in table.items():
        if name.startswith(ours):
            return published + name.removeprefix(ours)
    return None
