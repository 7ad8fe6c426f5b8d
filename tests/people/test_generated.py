"""Data modules from configurations, and generated people: caching, extension, invalid settings."""

from unittest.mock import Mock

import numpy as np
import pytest

from ghgs_lit.config import build, compose
from ghgs_lit.data.sampling import (
    TargetProtocol,
)
from ghgs_lit.errors import InputError
from ghgs_people import figures
from ghgs_people.datasets import Scans, Synthetic
from ghgs_people.jobs import RenderOptions
from tests.helpers.captures import refused
from tests.helpers.people import RELEASE, RIG, V4, box_person, equal


def built(*overrides):
    cfg = compose("prepare", overrides)
    return build(cfg.data, "data", views=cfg.views, targets=cfg.targets, seed=cfg.seed)


@pytest.mark.parametrize("views", ["v3", "v4", "v5", "random"])
@pytest.mark.parametrize("targets", ["release", "midway", "random"])
def test_configuration_groups_build(views, targets, tmp_path):
    """Every combination of views= and targets= builds; values in files equal the defaults of classes."""
    data = built("data=scans", f"views={views}", f"targets={targets}")
    assert data.targets.name == targets
    assert data.views.evaluation_count == {"v3": 3, "v4": 4, "v5": 5, "random": 4}[views]
    # Evaluating another protocol by its name gives the values of its file.
    by_name = TargetProtocol(name=targets)
    assert (data.targets.kind, data.targets.view, data.targets.per_subject) == (
        by_name.kind,
        by_name.view,
        by_name.per_subject,
    )
    synthetic = built(f"views={views}", f"targets={targets}", f"data.cache_dir={tmp_path}")
    assert isinstance(synthetic.dataset, Synthetic)
    assert synthetic.dataset.render.lights == "studio"


def test_configuration_of_the_rig_is_the_rigs_default():
    """YAML and code define the same rig."""
    data = built("data=scans")
    assert isinstance(data.dataset, Scans)
    assert data.dataset.rig.build() == RIG
    assert data.dataset.render == Scans.model_fields["render"].default == RenderOptions(lights="none")


def synthetic(tmp_path, seed=0, **changes):
    arguments = {
        "people": {"train": 2, "val": 1},
        "size": 28,
        "render": {"size": 28, "samples": 1},
        "cache_dir": str(tmp_path),
        "render_workers": 0,
    }
    return Synthetic(**(arguments | changes)).build(V4, RELEASE, seed)


@pytest.fixture
def generated(monkeypatch):
    """Boxes instead of people, and the list of generated ones."""
    made = []

    def generate(seed, index, active=False):
        made.append((seed, index, "active") if active else (seed, index))
        rng = np.random.default_rng([seed, index])
        return box_person(f"p{index}", rng.integers(60, 255, 3), (0.5, rng.uniform(1.5, 1.9), 0.3))

    monkeypatch.setattr(figures, "generate", generate, raising=False)
    return made


def test_generated_people_are_rendered_once_and_extended(tmp_path, generated):
    """More people extend the cache; nobody is generated twice."""
    data = synthetic(tmp_path)
    with pytest.raises(InputError, match="expected the folder of the data set; found no such folder"):
        data.train_dataloader()
    data.prepare_data()
    assert generated == [(0, 0), (0, 1), (0, 1_000_000)]
    first = data.training_batch(0)
    assert data.val_dataloader().dataset[0].subjects == ("p1000000",)
    again = synthetic(tmp_path)
    again.prepare_data()
    assert len(generated) == 3
    assert equal(first, again.training_batch(0))
    more = synthetic(tmp_path, people={"train": 3, "val": 1})
    more.prepare_data()
    assert generated[3:] == [(0, 2)]
    assert more.dataset.root == data.dataset.root
    assert len(more.subjects("train")) == 3
    assert len(synthetic(tmp_path).subjects("train")) == 2
    moving = synthetic(tmp_path, active={"val": 1})
    moving.prepare_data()
    assert generated[4:] == [(0, 1_000_000, "active")]
    assert moving.dataset.root == data.dataset.root
    assert [list(moving.subjects(phase)) for phase in ("train", "val")] == [
        ["p0000000", "p0000001"],
        ["p1000000", "a1000000"],
    ]


def test_the_cache_is_named_after_every_setting(tmp_path):
    """Different settings never share a cache, unless they do not change pixels."""
    roots = [
        synthetic(tmp_path, **changes).dataset.root
        for changes in (
            {},
            {"render": {"size": 42, "samples": 1}},
            {"render": {"size": 28, "samples": 2}},
            {"rig": {"height": 1.8}},
            {"rig": {"height": None, "variation": {"pitch": [-9.0, -9.0]}}},
        )
    ]
    assert len(set(roots)) == len(roots)
    assert synthetic(tmp_path, seed=5, size=14, people={"train": 9, "val": 3}).dataset.root == roots[0]


@pytest.mark.parametrize(
    ("changes", "line"),
    [
        (
            {"render": {"size": 28, "views": [0]}},
            r"data\.render\.views: expected \[0, 2, 3, 4\] for targets=release; found \[0\]",
        ),
        ({"people": {"train": 2, "val": 0}}, r"data\.people\.val: expected an integer >= 1 and .*; found 0"),
        ({"active": {"train": -1}}, r"data\.active\.train: expected an integer >= 0 and .*; found -1"),
        ({"rig": {"hieght": 3}}, r"data\.rig\.hieght: expected one of .*; found 'hieght'"),
        ({"rig": {"variation": {"colour": 3}}}, r"data\.rig\.variation\.colour: expected"),
    ],
)
def test_impossible_people_are_refused(tmp_path, changes, line):
    """Views that are not rendered, invalid numbers of people, misspelt keys."""
    refused(line, lambda: synthetic(tmp_path, **changes))


def test_a_user_without_a_home_learns_where_to_keep_people(monkeypatch):
    """Such as ``docker --user 12345``, who has no home directory."""
    monkeypatch.delenv("HOME", raising=False)
    monkeypatch.delenv("GHGS_CACHE", raising=False)
    monkeypatch.setattr("pwd.getpwuid", Mock(side_effect=KeyError))
    line = r"data\.cache_dir: expected a folder, or one in GHGS_CACHE, where there is no home directory"
    refused(line, lambda: Synthetic().root)
