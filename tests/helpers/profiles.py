"""ICC profiles with three primaries and a curve, and their conversion to sRGB by the formulas."""

import struct

import numpy as np

#: Columns: red, green and blue in XYZ under D50.
SRGB = np.array([[0.43607, 0.38515, 0.14307], [0.22249, 0.71687, 0.06061], [0.01392, 0.09708, 0.71410]])
DISPLAY_P3 = np.array(
    [[0.51512, 0.29198, 0.15710], [0.24120, 0.69225, 0.06657], [-0.00105, 0.04189, 0.78407]]
)


def srgb_decoded(values: np.ndarray) -> np.ndarray:
    """Linear light of sRGB values, both in [0, 1]."""
    return np.where(values <= 0.04045, values / 12.92, ((values + 0.055) / 1.055) ** 2.4)


def srgb_encoded(light: np.ndarray) -> np.ndarray:
    """The inverse of :func:`srgb_decoded`; light outside [0, 1] is clipped."""
    light = np.clip(light, 0, 1)
    return np.where(light <= 0.0031308, light * 12.92, 1.055 * light ** (1 / 2.4) - 0.055)


def curve_of(gamma: float | None, values: np.ndarray) -> np.ndarray:
    """Linear light of values in [0, 1]. ``gamma``: the power; None: the curve of sRGB."""
    return srgb_decoded(values) if gamma is None else values**gamma


def in_srgb(pixels: np.ndarray, primaries: np.ndarray, gamma: float | None) -> np.ndarray:
    """Convert pixels [..., 3] uint8 of a profile to sRGB in [0, 255]."""
    light = curve_of(gamma, pixels / 255)
    return 255 * srgb_encoded(light @ (np.linalg.inv(SRGB) @ primaries).T)


def profile(primaries: np.ndarray | None, gamma: float | None) -> bytes:
    """An ICC profile of version 2. ``primaries``: as :data:`SRGB`; None: a grey profile."""
    table = np.round(65535 * curve_of(gamma, np.linspace(0, 1, 1024))).astype(">u2").tobytes()
    curve = b"curv" + struct.pack(">II", 0, 1024) + table
    tags = {b"wtpt": _xyz((0.9642, 1.0, 0.8249))}
    if primaries is None:
        tags[b"kTRC"] = curve
    else:
        for name, column in zip((b"r", b"g", b"b"), primaries.T, strict=True):
            tags |= {name + b"XYZ": _xyz(column), name + b"TRC": curve}
    space = b"GRAY" if primaries is None else b"RGB "
    entries, content, begin = b"", b"", 128 + 4 + 12 * len(tags)
    for name, data in tags.items():
        entries += name + struct.pack(">II", begin + len(content), len(data))
        content += data
    size = struct.pack(">I", begin + len(content))
    header = size + bytes(4) + b"\x02\x40\x00\x00mntr" + space + b"XYZ " + bytes(12) + b"acsp" + bytes(28)
    header += _xyz((0.9642, 1.0, 0.8249))[8:]
    return header.ljust(128, b"\0") + struct.pack(">I", len(tags)) + entries + content


def _xyz(numbers) -> bytes:
    return b"XYZ " + bytes(4) + struct.pack(">3i", *(round(65536 * float(n)) for n in numbers))
