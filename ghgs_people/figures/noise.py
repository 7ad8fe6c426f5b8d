"""Smooth random fields that repeat without a seam."""

import numpy as np


class Noise:
    """A periodic field with zero mean, unit variance and a power spectrum of 1 / f^(2 slope).

    Args:
        rng: samples the field.
        slope: larger values are smoother.
        fineness: lowest number of waves per period.
        size: values per period, along both axes.
    """

    def __init__(self, rng: np.random.Generator, slope: float = 1.2, fineness: float = 2.0, size: int = 256):
        frequency = np.hypot(np.fft.fftfreq(size)[:, None], np.fft.rfftfreq(size)[None]) * size
        spectrum = np.fft.rfft2(rng.standard_normal((size, size)))
        gain = np.where(frequency >= fineness, 1.0 / np.maximum(frequency, 1.0) ** slope, 0.0)
        field = np.fft.irfft2(spectrum * gain, (size, size))
        self.size = size
        self.field = (field / field.std()).astype(np.float32)

    def __call__(self, u: np.ndarray, v: np.ndarray) -> np.ndarray:
        """Sample bilinearly, in float32 and faster than SciPy.

        Args:
            u: column in periods, any shape; the field repeats.
            v: row in periods, of the shape of ``u``.
        """
        x = np.asarray(u, np.float32) * np.float32(self.size)
        y = np.asarray(v, np.float32) * np.float32(self.size)
        left = np.floor(x)
        top = np.floor(y)
        fx = x - left
        fy = y - top
        i = left.astype(np.int32) % self.size
        j = top.astype(np.int32) % self.size
        k = (i + 1) % self.size
        row = j * self.size
        below = (j + 1) % self.size * self.size
        field = self.field.ravel()
        a = field[row + i]
        b = field[below + i]
        upper = a + (field[row + k] - a) * fx
        lower = b + (field[below + k] - b) * fx
        return upper + (lower - upper) * fy
