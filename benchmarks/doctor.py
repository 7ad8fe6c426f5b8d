"""What ``ghgs doctor`` says of planted mistakes: ``python benchmarks/doctor.py photographs cameras.json``.

The capture must be right. Each mistake of ``tests/helpers/mistakes.py`` is planted in a copy of it, in all
cameras or in the second one, and two cameras, two masks and a camera and its copy are exchanged.
"""

import argparse
import json
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
from PIL import Image

sys.path.insert(0, str(Path(__file__).parents[1]))
from ghgs_lit import Capture
from ghgs_lit.prediction.capture.camera_report import Diagnosis, diagnose
from ghgs_lit.prediction.capture.folder import CaptureFolder
from tests.helpers.mistakes import ALL, ONE


def cameras_of(capture: Capture) -> dict[str, dict]:
    """The cameras as the package's JSON has them."""
    found = {}
    for photograph in capture.photographs:
        height, width = photograph.mask.shape
        matrices = {name: getattr(photograph, name).tolist() for name in ("intrinsics", "extrinsics")}
        found[photograph.name] = {**matrices, "width": width, "height": height}
    return found


def planted(capture: Capture) -> Iterator[tuple[str, Diagnosis, bool]]:
    """What was planted, what was found, and whether it was named."""
    cameras = cameras_of(capture)
    names = list(cameras)
    first, second = names[:2]
    for name, (mistake, option) in ALL.items():
        found = examine(capture, {key: mistake(camera) for key, camera in cameras.items()})
        yield f"all: {name}", found, found.option == option
    for name, (mistake, words) in ONE.items():
        found = examine(capture, {**cameras, second: mistake(cameras[second])})
        yield f"{second}: {name}", found, found.suspects == (second,) and any(words in x for x in found.lines)
    swapped = {**cameras, first: cameras[second], second: cameras[first]}
    found = examine(capture, swapped)
    yield "cameras exchanged", found, set(found.suspects) == {first, second}
    found = examine(capture, {**cameras, names[-1]: cameras[second]})
    yield "a camera twice", found, set(found.suspects) == {second, names[-1]}
    found = examine(capture, cameras, exchange=(first, second))
    yield "masks exchanged", found, "masks" in found.lines[0] and set(found.suspects) == {first, second}
    for photograph in capture.photographs:
        found = examine(headless(capture, photograph.name), cameras)
        yield f"{photograph.name}: its mask lacks the head", found, found.suspects == (photograph.name,)


def headless(capture: Capture, name: str) -> Capture:
    """The capture, where the mask of one photograph lacks the upper seventh."""
    photographs = []
    for photograph in capture.photographs:
        matte, (top, bottom) = photograph.matte.copy(), photograph.extents[0]
        if photograph.name == name:
            matte[: top + (bottom - top) // 7] = 0
        photographs.append(replace(photograph, matte=matte))
    return replace(capture, photographs=tuple(photographs))


def resized(mask: np.ndarray, like: np.ndarray) -> np.ndarray:
    """A mask at the size of another."""
    return np.asarray(Image.fromarray(mask).resize(like.shape[::-1]))


def examine(capture: Capture, cameras: dict[str, dict], exchange: tuple[str, str] | None = None) -> Diagnosis:
    """The doctor's findings; ``exchange`` names two photographs that have each other's masks."""
    masks = {photograph.name: photograph.mask for photograph in capture.photographs}
    if exchange is not None:
        one, other = exchange
        masks[one], masks[other] = (resized(masks[other], masks[one]), resized(masks[one], masks[other]))
    with tempfile.TemporaryDirectory() as folder:
        for photograph in capture.photographs:
            Image.fromarray(photograph.image).save(Path(folder, f"{photograph.name}.png"))
            Image.fromarray(masks[photograph.name]).save(Path(folder, f"{photograph.name}_mask.png"))
        path = Path(folder, "cameras.json")
        path.write_text(json.dumps({"cameras": cameras}))
        return diagnose(CaptureFolder(folder, path))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("images", type=Path)
    parser.add_argument("cameras", type=Path)
    options = parser.parse_args()
    capture = Capture.read(options.images, options.cameras)
    right = examine(capture, cameras_of(capture))
    print(f"as it is: {'no alarm' if right.consistent else 'FALSE ALARM: ' + right.lines[0]}")
    print("\n| planted | named | what the doctor says |\n|---|---|---|")
    verdicts = []
    for name, found, named in planted(capture):
        verdicts.append(named)
        print(
            f"| {name} | {'yes' if named else 'NO'} | {found.lines[-1 if found.consistent else 0]} |",
            flush=True,
        )
    print(f"\n{sum(verdicts)} of {len(verdicts)} named")


if __name__ == "__main__":
    main()
