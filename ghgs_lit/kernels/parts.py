"""Dividing work into parts that fit in memory."""


def even_parts(count: int, most: int) -> list[slice]:
    """Slices of at most ``most`` of ``count`` rows, of equal size (a small last part would be slow)."""
    parts = max(1, -(-count // max(1, most)))
    return [slice(count * i // parts, count * (i + 1) // parts) for i in range(parts)]
