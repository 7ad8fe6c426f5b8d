"""Rendering jobs: killed halfway, started twice, in several processes, with other settings."""

import errno
import os
import signal
import subprocess
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from ghgs_lit.data.layout import Layout
from ghgs_lit.errors import InputError
from ghgs_people import figures, jobs
from ghgs_people.jobs import SyntheticSource, render_people
from ghgs_people.scans import ScanSource
from tests.helpers.people import RIG, TINY, render_boxes, write_obj_scan
from tests.helpers.processes import PREPARED, run_block

SMALL = TINY.replace(positions=(0, 4, 8), views=(0, 3))


def contents(root: Path) -> dict[str, bytes]:
    """Every data file below ``root``."""
    files = (p for phase in ("train", "val") for p in (root / phase).rglob("*") if p.is_file())
    return {p.relative_to(root).as_posix(): p.read_bytes() for p in files}


@dataclass(frozen=True)
class Counting:
    """A source that logs loaded names and processes in ``log``, waits ``pause`` seconds, and fails on
    request."""

    source: ScanSource | None
    log: Path
    fail: tuple[str, ...] = ()
    pause: float = 0.0

    def load(self, name):
        with open(self.log, "a") as file:
            file.write(f"{name} {os.getpid()}\n")
        time.sleep(self.pause)
        if name in self.fail:
            raise InputError(f"{name}: expected a person; found a test")
        return self.source.load(name)

    def facing(self, name):
        return 0.0


def logged(log: Path) -> list[tuple[str, int]]:
    """Names and processes in a log."""
    lines = log.read_text().splitlines() if log.exists() else []
    return [(line.split()[0], int(line.split()[1])) for line in lines]


@pytest.fixture(scope="module")
def scans(tmp_path_factory):
    folder = tmp_path_factory.mktemp("scans")
    for i in range(4):
        write_obj_scan(folder, f"s{i}", color=(40 * i + 40, 90, 200 - 40 * i))
    return folder


@pytest.fixture(scope="module")
def reference(scans, tmp_path_factory):
    root = tmp_path_factory.mktemp("reference") / "out"
    render_boxes(root, scans, 3, 1, settings=SMALL)
    return contents(root)


def render_and_die(root: Path, scans: Path, moves: int) -> None:
    """Render until ``moves`` folders or files were moved, then exit as after ``kill -9``."""
    count, replace_file = [0], os.replace

    def dying(*paths):
        count[0] += 1
        if count[0] > moves:
            os.kill(os.getpid(), signal.SIGKILL)
        replace_file(*paths)

    os.replace = dying
    render_boxes(root, scans, 3, 1, settings=SMALL)


def test_a_killed_run_leaves_nothing_that_looks_whole_and_goes_on(scans, reference, tmp_path):
    """Killed in the middle of moving the second subject to its place."""
    root = tmp_path / "out"
    process = PREPARED.Process(target=render_and_die, args=(root, scans, 25))
    process.start()
    process.join()
    assert process.exitcode == -signal.SIGKILL
    assert list(Layout(root, "train", names=["s0"]).subjects) == ["s0"]
    half = {p.name for p in (root / "train").glob("*/s1_*")}
    assert half  # some of the second subject did arrive
    for names in (None, ["s1"]):
        with pytest.raises(InputError, match=r"\(s1 is missing or half-rendered: render again to finish\)"):
            Layout(root, "train", names=names)
    log = tmp_path / "log"
    source = Counting(ScanSource(scans), log)
    names = {"train": ["s0", "s1", "s2"], "val": ["s3"]}
    assert render_people(root, names, source, RIG, SMALL, 0, workers=0) == 3
    assert [name for name, _ in logged(log)] == ["s1", "s2", "s3"]
    assert contents(root) == reference
    assert not (root / "rendering" / "tmp").exists()
    assert render_people(root, names, source, RIG, SMALL, 0, workers=0) == 0


def test_an_interrupted_rendering_begins_no_further_people(tmp_path, monkeypatch):
    def interrupt(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(jobs.log, "warning", interrupt)
    names = [f"s{i}" for i in range(12)]
    slow = Counting(None, tmp_path / "log", fail=tuple(names), pause=0.3)
    with pytest.raises(KeyboardInterrupt):
        render_people(tmp_path / "out", {"train": names}, slow, RIG, SMALL, 0, workers=2)
    assert len(logged(tmp_path / "log")) < 12


def render_at_once(barrier, root: Path, scans: Path, log: Path) -> None:
    barrier.wait()
    names = {"train": ["s0", "s1", "s2"], "val": ["s3"]}
    render_people(root, names, Counting(ScanSource(scans), log), RIG, SMALL, 0, workers=0)


def test_two_processes_at_once_share_the_work(scans, reference, tmp_path):
    """Two runs on one folder neither collide nor render twice."""
    barrier, root, log = PREPARED.Barrier(2), tmp_path / "out", tmp_path / "log"
    processes = [PREPARED.Process(target=render_at_once, args=(barrier, root, scans, log)) for _ in range(2)]
    for process in processes:
        process.start()
    for process in processes:
        process.join()
        assert process.exitcode == 0
    assert sorted(name for name, _ in logged(log)) == ["s0", "s1", "s2", "s3"]  # each rendered once
    assert contents(root) == reference


def render_stuck(root: Path, scans: Path, log: Path) -> None:
    names = {"train": ["s0", "s1", "s2"], "val": ["s3"]}
    render_people(root, names, Counting(ScanSource(scans), log, pause=60), RIG, SMALL, 0, workers=2)


def lives(pid: int) -> bool:
    """Whether a process runs; zombies do not."""
    state = subprocess.run(["ps", "-o", "stat=", "-p", str(pid)], capture_output=True, text=True).stdout
    return state.strip()[:1] not in ("", "Z")


def test_workers_end_with_the_process_that_started_them(scans, tmp_path):
    """A killed run leaves no processes behind."""
    log = tmp_path / "log"
    process = PREPARED.Process(target=render_stuck, args=(tmp_path / "out", scans, log))
    process.start()
    limit = time.monotonic() + 300
    while len(logged(log)) < 2 and time.monotonic() < limit:
        time.sleep(0.05)
    workers = [pid for _, pid in logged(log)]
    assert all(map(lives, workers))
    process.kill()
    process.join()
    while any(map(lives, workers)) and time.monotonic() < limit:
        time.sleep(0.05)
    assert not any(map(lives, workers))


UNGUARDED = """
import sys
from pathlib import Path
from ghgs_people.jobs import RenderOptions, render_people
from ghgs_people.rig import Rig
from ghgs_people.scans import ScanSource

root, scans = map(Path, sys.argv[1:])
render_people(root, {"train": ["s0", "s1"]}, ScanSource(scans), Rig(), RenderOptions(size=42), 0, workers=2)
"""


def test_a_script_without_a_main_guard_ends_with_a_reason(scans, tmp_path):
    """Workers run the script again, and would deadlock with their parent."""
    script = tmp_path / "script.py"
    script.write_text(UNGUARDED)
    argv = [str(path) for path in (script, tmp_path / "out", scans)]
    run = f"import runpy, sys; sys.argv = {argv}; runpy.run_path({str(script)!r}, run_name='__main__')"
    path = {"PYTHONPATH": str(Path(__file__).parents[2])}
    code, said = run_block(run, tmp_path, {**os.environ, **path})
    assert code == 1
    assert f'{script}: expected `if __name__ == "__main__":` around' in said


def test_several_workers_make_the_same_files(scans, reference, tmp_path, monkeypatch):
    """Files are independent of the number of processes."""
    # spawned ones import all
    monkeypatch.setattr(jobs.multiprocessing, "get_context", lambda *_: PREPARED)
    render_boxes(tmp_path / "out", scans, 3, 1, settings=SMALL, workers=2)
    assert contents(tmp_path / "out") == reference


def test_people_are_rendered_inside_a_worker_of_joblib(scans, reference, tmp_path):
    """A sweep with ``hydra/launcher=joblib`` renders in subprocesses of joblib's worker."""
    loky = pytest.importorskip("joblib.externals.loky")
    # Not the executor that joblib shares in a process: it would lack what joblib gives its own.
    with loky.ProcessPoolExecutor(max_workers=1) as worker:
        worker.submit(render_boxes, tmp_path / "out", scans, 3, 1, settings=SMALL, workers=2).result()
    assert contents(tmp_path / "out") == reference


@pytest.mark.parametrize("workers", [0, 2])
def test_bad_people_are_named_when_the_others_are_rendered(scans, reference, tmp_path, workers, caplog):
    """An error loses neither finished nor remaining work, and leaves no incomplete subject."""
    root = tmp_path / "out"
    names = {"train": ["s0", "s1", "s2"], "val": ["s3"]}
    source = Counting(ScanSource(scans), tmp_path / "log", fail=("s0", "s2"))
    line = r"^s0: expected a person; found a test \(2 of 4 people are bad; the others are rendered\)$"
    with pytest.raises(InputError, match=line):
        render_people(root, names, source, RIG, SMALL, 0, workers=workers)
    assert "s2 is not rendered: s2: expected a person; found a test" in caplog.text
    assert not list((root / "rendering").glob("tmp/*"))
    assert sorted(path.name for path in root.glob("rendering/done/*/*")) == ["s1", "s3"]
    assert set(contents(root).items()) < set(reference.items())
    assert render_people(root, names, ScanSource(scans), RIG, SMALL, 0, workers=0) == 2
    assert contents(root) == reference


def test_textures_without_lights_come_back_as_they_are(scans, reference, tmp_path):
    """Without lights, lighting in textures is not applied twice; geometry and cameras equal those of lit
    photographs."""
    root, unlit = tmp_path / "out", SMALL.replace(lights="none")
    render_boxes(root, scans, 1, 0, settings=unlit)
    files = contents(root)
    for name in (name for name in files if not name.startswith("train/img")):
        assert files[name] == reference[name]
    layout = Layout(root, "train")
    for position in (0, 4, 8):
        view = layout.read_view("s0", position, 0, depth=False)
        inside = view.image[view.matte == 255]
        assert np.abs(inside.mean(0) - [40, 90, 200]).max() < 2
    with pytest.raises(InputError, match=r"expected render\.lights = None; found none \(render into another"):
        render_boxes(root, scans, 2, 0, settings=SMALL)


def test_a_full_disk_names_the_folder_of_the_data_set(scans, tmp_path, monkeypatch):
    """The system's error contains no file, and must not be attributed to the run's directory."""

    def full(*_):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(jobs, "write_view", full)
    with pytest.raises(OSError, match="No space left") as caught:
        render_people(tmp_path / "out", {"train": ["s0"]}, ScanSource(scans), RIG, SMALL, 0, workers=0)
    assert caught.value.filename == str(tmp_path / "out")


def test_other_settings_and_other_folders_are_refused(scans, tmp_path):
    """Renderings with different settings are never mixed, and no foreign file is changed."""
    root = tmp_path / "out"
    render_boxes(root, scans, 1, 0, settings=SMALL)
    before = contents(root)
    with pytest.raises(
        InputError,
        match=r"settings\.json: expected render\.quality = 90; found 98 .render into another folder",
    ):
        render_boxes(root, scans, 2, 0, settings=SMALL.replace(quality=90))
    with pytest.raises(InputError, match=r"settings\.json: expected seed = 1; found 0"):
        render_boxes(root, scans, 2, 0, settings=SMALL, seed=1)
    assert contents(root) == before
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.txt").write_text("years of work")
    with pytest.raises(
        InputError, match="expected an empty folder or one rendered here before; found 'other files'"
    ):
        render_boxes(tmp_path / "mine", scans, 1, 0, settings=SMALL)
    assert sorted(p.name for p in (tmp_path / "mine").iterdir()) == ["thesis.txt"]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"size": 0}, r"data\.render\.size: expected an integer >= 1"),
        ({"samples": 0}, r"data\.render\.samples: expected an integer >= 1 and <= 16; found 0"),
        ({"views": (0, 9)}, r"data\.render\.views: expected a list"),
        ({"quality": 0}, r"data\.render\.quality"),
    ],
)
def test_impossible_settings_fail_at_once(changes, message):
    """An invalid value fails before rendering starts, with its key in the message."""
    with pytest.raises(InputError, match=message):
        TINY.replace(**changes)


def test_positions_beyond_the_ring_are_refused(scans, tmp_path):
    """A position that the ring lacks is rejected before anything is written."""
    with pytest.raises(InputError, match=r"data\.render\.positions: expected some of 0 to 15"):
        render_boxes(tmp_path / "out", scans, 1, 0, settings=TINY.replace(positions=(0, 16)))
    assert not (tmp_path / "out").exists()


def test_portrait_photographs(scans, tmp_path):
    """Photographs need not be square: focal length and centre depend on the height."""
    render_boxes(tmp_path / "out", scans, 1, 0, settings=SMALL.replace(size=(56, 28)))
    view = Layout(tmp_path / "out", "train").read_view("s0", 0, 0, depth=True)
    assert view.image.shape == (56, 28, 3)
    assert view.intrinsics[0, 0] == pytest.approx(0.8 * 56)
    columns = np.flatnonzero(view.mask.any(0))
    assert abs((columns[0] + columns[-1] + 1) / 2 - 14) < 3


def test_two_seeds_of_rendering_differ_and_one_repeats(scans, reference, tmp_path):
    """Heights, directions and lights differ: no photograph and no camera equals that of the other seed."""
    for seed in (0, 1):
        render_boxes(tmp_path / str(seed), scans, 3, 1, settings=SMALL, seed=seed)
    assert contents(tmp_path / "0") == reference
    other = contents(tmp_path / "1")
    assert other.keys() == reference.keys()
    differing = [name for name in other if "/img/" in name or name.endswith("extrinsic.npy")]
    assert len(differing) == 4 * 3 * 2 * 2
    assert all(other[name] != reference[name] for name in differing)


def test_generated_people_are_those_of_their_seed(monkeypatch):
    monkeypatch.setattr(figures, "generate", lambda seed, index, active: (seed, index, active))
    assert SyntheticSource(7).load("p12") == (7, 12, False)
    assert SyntheticSource(8).load("a03") == (8, 3, True)
