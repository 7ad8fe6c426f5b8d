"""What ``ghgs predict`` says beside its files: why a prediction may be poor, and what may help."""

import json
from collections.abc import Iterator
from pathlib import Path
from statistics import geometric_mean

from ghgs_capture.export.reports import REPORT
from ghgs_capture.tones import tone_lines

#: PSNR in dB, in the subject's box, below which the render of an input counts as poor.
LOW_PSNR = 25.0


def advice_of(directory: Path) -> Iterator[str]:
    """Advice from a prediction's report.

    Args:
        directory: where the report lies.

    Yields:
        Lines about gains that were undone, why the prediction may be poor and what may help.
    """
    report = json.loads((directory / REPORT).read_text())
    shares = {name: geometric_mean(each) - 1 for name, each in report.get("gains", {}).items()}
    deviations = []
    for name, share in shares.items():
        if round(100 * share):
            deviations.append(f"{name} {abs(share):.0%} {'darker' if share < 0 else 'brighter'}")
    if deviations:
        yield f"gains: {', '.join(deviations)} than the mean of the cameras, undone"
    yield from tone_lines(report.get("tones", {}), "undone (refine_tones=0 leaves it)")
    quality = report["psnr_box_of_inputs"].values()
    if len(quality) < 3:
        yield f"{len(quality)} photographs leave much unseen: 3 to 5 all around show a person"
    low = min(quality)
    high = max(quality)
    if low < LOW_PSNR:
        left = [key for key in ("refine_cameras", "refine_masks") if key not in report]
        hint = f" ({' and '.join(f'{key}=4' for key in left)} may mend them)" if left else ""
        yield (
            f"photographs come back at {low:.1f} to {high:.1f} dB only, sound ones at 30 or more:"
            f" mostly cameras or masks are off{hint}; sheet.png shows where"
        )


def moved_line(moved: dict[str, float]) -> str:
    """The message about corrected cameras, which names them if only some moved.

    Args:
        moved: pixels by which the subject moved in each photograph, by camera.

    Returns:
        A line of text.
    """
    off = [name for name, pixels in moved.items() if pixels]
    moved_alone = f": {', '.join(off)} beside the others" if 0 < len(off) < len(moved) else ""
    return f"refine_cameras: moved by {', '.join(f'{p:.2f}' for p in moved.values())} pixels{moved_alone}"
