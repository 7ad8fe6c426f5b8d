"""The frozen people: their definition, what they look like, and what is refused."""

import shutil

import numpy as np
import pytest

from ghgs_lit.config import build, compose
from ghgs_lit.data.layout import Layout, position_name
from ghgs_lit.data.view import View
from ghgs_lit.errors import InputError
from ghgs_lit.synthesis import bench, datasets
from ghgs_lit.synthesis.jobs import RenderOptions, SyntheticSource, render_people
from ghgs_lit.synthesis.rig import Rig

#: The first and the last of them.
SOME = (bench.names()[0], bench.names()[-1])


def render(root, size):
    """Some of the people, as defined."""
    settings = RenderOptions(size=size, positions=bench.POSITIONS, views=(0,))
    render_people(root, {"bench": SOME}, SyntheticSource(0), Rig(height=None), settings, 0, workers=0)
    return root


@pytest.fixture(scope="module")
def rendered(tmp_path_factory):
    return render(tmp_path_factory.mktemp("bench"), bench.definition()["size"])


def test_the_people_look_as_they_were_published(rendered):
    """If this fails, the people have changed: results on them need another version of the definition."""
    bench.check_photographs(Layout(rendered, "bench", SOME))


def test_other_sizes_are_the_same_people(tmp_path):
    """The set is measured at 140 and 252 pixels, and tried at fewer."""
    bench.check_photographs(Layout(render(tmp_path, bench.LEAST), "bench", SOME))


def test_another_person_is_refused_by_name(rendered, tmp_path):
    """Also where only one photograph of one person is wrong."""
    root = tmp_path / "swapped"
    shutil.copytree(rendered, root)
    for kind in ("img", "mask"):
        folder = root / "bench" / kind
        shutil.rmtree(folder / position_name(SOME[1], 8))
        shutil.copytree(folder / position_name(SOME[0], 8), folder / position_name(SOME[1], 8))
    with pytest.raises(InputError, match=f"expected {SOME[1]} of split=bench"):
        bench.check_photographs(Layout(root, "bench", SOME))


def test_nobody_trains_on_them():
    """Their numbers are beyond those of any training or validation person; forty different ones."""
    assert len(set(bench.names())) == len(bench.thumbnails()) == 40
    assert int(bench.names()[0][1:]) >= 2 * datasets.FIRST_VAL
    flat = bench.thumbnails().reshape(40, -1).astype(float)
    apart = np.sqrt(np.square(flat[:, None] - flat).mean(-1))
    assert apart[~np.eye(40, dtype=bool)].min() > 1.3 * bench.OTHER_SIZE


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
    """Results on it would be called those of the frozen set."""
    with pytest.raises(InputError, match=message):
        synthetic(tmp_path, override).prepare_data(["bench"])
    assert not list(tmp_path.iterdir())


def test_only_the_split_that_is_measured_is_rendered(tmp_path, monkeypatch):
    """Forty people take minutes, sixty-four of the training more; the size is free."""
    asked = []
    monkeypatch.setattr(datasets, "render_people", lambda root, names, *rest: asked.append(names))
    monkeypatch.setattr(bench, "check_photographs", lambda reader: None)
    monkeypatch.setattr(datasets.Synthetic, "reader", lambda self, phase: None)
    data = synthetic(tmp_path, "data.size=252")
    data.prepare_data(["bench"])
    data.prepare_data(["val"])
    data.prepare_data()
    assert [list(names) for names in asked] == [["bench"], ["val"], ["train", "val"]]
    assert asked[0]["bench"] == bench.names()
    with pytest.raises(InputError, match=r"split: expected .*bench"):
        data.prepare_data(["bensch"])
    assert "version 1" in data.dataset.split_facts("bench")["bench"]
    assert "bench" not in data.dataset.split_facts("val")


def test_thumbnails_are_means_of_photograph_and_mask():
    """By their definition, with colours that the mask does not weigh."""
    rng = np.random.default_rng(0)
    image, mask = rng.integers(0, 256, (64, 96, 3), dtype=np.uint8), rng.random((64, 96)) > 0.5
    found = bench.thumbnail(View(image, mask, None, np.eye(3), np.eye(4)))
    both = np.dstack((image, mask * 255.0)).reshape(16, 4, 16, 6, 4).mean((1, 3))
    assert np.abs(found - both).max() <= 1
