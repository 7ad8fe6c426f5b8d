"""Frozen people: definition, appearance and rejected settings."""

import functools
import shutil

import numpy as np
import pytest

from ghgs_lit.config import build, compose
from ghgs_lit.data.layout import Layout, position_name
from ghgs_lit.data.view import View
from ghgs_lit.errors import InputError
from ghgs_people import bench, datasets
from ghgs_people.jobs import RenderOptions, SyntheticSource, render_people
from ghgs_people.rig import Rig

#: The first and the last of each split.
SOME = {split: (bench.names(split)[0], bench.names(split)[-1]) for split in bench.SPLITS}


class Kept(SyntheticSource):
    """Generate each person once for all tests."""

    load = functools.cache(SyntheticSource.load)


def render(root, split, size):
    """Some of the people, as defined."""
    settings = RenderOptions(size=size, positions=bench.POSITIONS, views=(0,))
    render_people(root, {split: SOME[split]}, Kept(0), Rig(height=None), settings, 0, workers=0)
    return Layout(root, split, SOME[split])


@pytest.fixture(scope="module")
def rendered(tmp_path_factory):
    root = tmp_path_factory.mktemp("bench")
    render(root, "bench", bench.definition("bench")["size"])
    return root


def test_the_people_look_as_they_were_published(rendered, tmp_path):
    """A failure means that the people have changed: results on them need a new version of the definition."""
    bench.check_photographs("bench", Layout(rendered, "bench", SOME["bench"]))
    bench.check_photographs("sealed", render(tmp_path, "sealed", bench.definition("sealed")["size"]))


@pytest.mark.parametrize("split", bench.SPLITS)
def test_other_sizes_are_the_same_people(tmp_path, split):
    """The sets are used at 140 and 252 pixels, and for trials at fewer."""
    bench.check_photographs(split, render(tmp_path, split, bench.LEAST))


def test_another_person_is_refused_by_name(rendered, tmp_path):
    """Also if only one photograph of one person is wrong."""
    root = tmp_path / "swapped"
    shutil.copytree(rendered, root)
    for kind in ("img", "mask"):
        folder = root / "bench" / kind
        first, last = (folder / position_name(name, 8) for name in SOME["bench"])
        shutil.rmtree(last)
        shutil.copytree(first, last)
    with pytest.raises(InputError, match=f"expected {SOME['bench'][1]} of split=bench"):
        bench.check_photographs("bench", Layout(root, "bench", SOME["bench"]))


@pytest.mark.parametrize(("split", "count"), [("bench", 40), ("sealed", 16)])
def test_the_people_are_different_ones(split, count):
    """The number of people, all distinguishable by their thumbnails."""
    assert len(set(bench.names(split))) == len(bench.thumbnails(split)) == count
    flat = bench.thumbnails(split).reshape(count, -1).astype(float)
    apart = np.sqrt(np.square(flat[:, None] - flat).mean(-1))
    assert apart[~np.eye(count, dtype=bool)].min() > 1.3 * bench.OTHER_SIZE


def test_nobody_trains_on_them():
    """The largest numbers of people in a configuration overlap neither set, and the sets do not overlap."""
    most = datasets.FIRST_VAL - 1
    data = datasets.Synthetic.model_construct(
        people=datasets.People(train=most, val=1),
        active=datasets.ActivePeople(train=1, val=most),
        motion=0,
    )
    last = max(int(person[1:]) for phase in ("train", "val") for person in data.subject_names(phase))
    sets = [{int(person[1:]) for person in bench.names(split)} for split in bench.SPLITS]
    assert last < min(set.union(*sets))
    assert not set.intersection(*sets)
    with pytest.raises(InputError, match=r"train: expected .* < 1000000"):
        datasets.People.read({"train": datasets.FIRST_VAL}, "data.people")


def synthetic(tmp_path, *overrides):
    config = compose(
        "evaluate", ["data=synthetic", f"data.cache_dir={tmp_path}", "data.render_workers=0", *overrides]
    )
    return build(config.data, "data", views=config.views, targets=config.targets, seed=1)


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("data.rig.height=1.8", r"data\.rig\.height: expected None, with which split=bench"),
        ("data/rig=varied", r"data\.rig\.\S+: expected"),
        ("data.size=42", r"data\.size: expected 56 pixels or more with split=bench; found 42"),
        ("data.render.samples=1", r"data\.render\.samples: expected 3"),
    ],
)
def test_another_definition_is_refused_before_anything_is_rendered(tmp_path, override, message):
    """Otherwise results on it would be attributed to the frozen set."""
    with pytest.raises(InputError, match=message):
        synthetic(tmp_path, override).prepare_data(["bench"])
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("split", bench.SPLITS)
def test_only_the_split_that_is_measured_is_rendered(tmp_path, monkeypatch, split):
    """Only the split is rendered: its forty people take minutes, sixty-four of training more; any size."""
    asked = []
    monkeypatch.setattr(datasets, "render_people", lambda root, names, *rest: asked.append(names))
    monkeypatch.setattr(bench, "check_photographs", lambda split, reader: None)
    monkeypatch.setattr(datasets.Synthetic, "reader", lambda self, phase: None)
    data = synthetic(tmp_path, "data.size=252")
    data.prepare_data([split])
    data.prepare_data(["val"])
    data.prepare_data()
    assert [list(names) for names in asked] == [[split], ["val"], ["train", "val"]]
    assert asked[0][split] == bench.names(split)
    with pytest.raises(InputError, match=r"split: expected .*bench"):
        data.prepare_data(["bensch"])
    assert "version 2" in data.dataset.split_facts(split)[split]
    assert split not in data.dataset.split_facts("val")


def test_thumbnails_are_means_of_photograph_and_mask():
    """Thumbnails by their definition, with colours that are not weighted by the mask."""
    rng = np.random.default_rng(0)
    image, mask = rng.integers(0, 256, (64, 96, 3), dtype=np.uint8), rng.random((64, 96)) > 0.5
    found = bench.thumbnail(View(image, mask, None, np.eye(3), np.eye(4)))
    both = np.dstack((image, mask * 255.0)).reshape(16, 4, 16, 6, 4).mean((1, 3))
    assert np.abs(found - both).max() <= 1
