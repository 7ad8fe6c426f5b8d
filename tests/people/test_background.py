"""People who are rendered beside training: the first are waited for,
the others join when they are whole."""

import pytest

from ghgs_lit.data.layout import Layout
from ghgs_people import background, datasets
from ghgs_people.jobs import render_people
from ghgs_people.scans import ScanSource
from tests.helpers.people import RIG, TINY, write_obj_scan
from tests.people.test_capture_rig import ring

NAMES = ["s0", "s1", "s2"]
SMALL = TINY.replace(positions=(0, 4), views=(0,))


@pytest.fixture
def begun(tmp_path):
    """A data set of which only the first person is rendered, and where the scans are."""
    scans, root = tmp_path / "scans", tmp_path / "out"
    for i, name in enumerate(NAMES):
        write_obj_scan(scans, name, color=(40 * i + 40, 90, 200))
    render_people(root, {"train": NAMES[:1]}, ScanSource(scans), RIG, SMALL, 0, workers=0)
    return root, ScanSource(scans)


def joining(root):
    layout = Layout(root, "train", NAMES[:1])
    return layout, background.Joining(layout, NAMES)


def test_others_join_when_they_are_whole(begun):
    """Whoever looked before sees them, and their photographs are read."""
    root, source = begun
    layout, subjects = joining(root)
    assert list(subjects) == ["s0"]
    render_people(root, {"train": ["s1"]}, source, RIG, SMALL, 0, workers=0)
    assert list(subjects) == list(layout.subjects) == ["s0", "s1"]
    assert subjects["s1"] == (0, 4)
    assert layout.read_view("s1", 4, 0, depth=False).image.shape == (*SMALL.size, 3)


def test_the_rest_is_rendered_in_another_process(begun):
    """Once only, the same photographs as without it;
    nothing is started for people who are whole."""
    root, source = begun
    arguments = (root, NAMES, source, RIG, SMALL, 0)
    background.render_beside(*arguments)
    process = background._running[root]
    background.render_beside(*arguments)
    assert background._running[root] is process
    process.join(300)
    assert process.exitcode == 0
    layout, subjects = joining(root)
    assert list(subjects) == NAMES
    other = root.parent / "other"
    render_people(other, {"train": NAMES}, source, RIG, SMALL, 0, workers=0)
    whole = Layout(other, "train", NAMES)
    for name in NAMES:
        assert (layout.read_view(name, 0, 0, False).image == whole.read_view(name, 0, 0, False).image).all()
    background.render_beside(*arguments)
    assert background._running[root] is process


def test_people_who_cannot_be_made_are_said(begun, capfd):
    """Training goes on with the others."""
    root, source = begun
    background.render_beside(root, ["s0", "nobody"], source, RIG, SMALL, 0)
    background._running[root].join(60)
    assert "training goes on with the people rendered so far: " in capfd.readouterr().err
    assert list(joining(root)[1]) == ["s0"]


@pytest.mark.parametrize("workers", [None, 0])
def test_training_waits_for_the_first_people_only(workers, monkeypatch, tmp_path):
    """Eight of both kinds, and who is measured; for all where no further process is allowed."""
    waited, later = [], []
    monkeypatch.setattr(datasets, "render_people", lambda root, names, *_: waited.append(names))
    monkeypatch.setattr(datasets, "render_beside", lambda root, names, *_: later.append(names))
    people, active = datasets.People(train=12, val=1), datasets.ActivePeople(train=6, val=1)
    cameras = {str(i): camera.model_dump() for i, camera in enumerate(ring())}
    options = {"people": people, "active": active, "cache_dir": tmp_path, "render_workers": workers}
    datasets.PeopleInRig(cameras=cameras, **options).prepare()
    pairs = [f"{kind}{i:07d}" for i in range(12) for kind in "pa" if kind == "p" or i < 6]
    first = {"train": pairs if workers == 0 else pairs[:8], "val": ["p1000000", "a1000000"]}
    assert waited == [first]
    assert later == ([] if workers == 0 else [pairs])
