"""Configurations of earlier versions are read in today's names."""

from ghgs_lit.config import compose, legacy, resolve
from ghgs_lit.config.build import _targets


def test_keys_classes_and_values_are_renamed(monkeypatch):
    """Each kind of table must work, for values and whole nodes, without a change of its input."""
    monkeypatch.setattr(legacy, "TARGETS", {"old.Class": "new.Class"})
    monkeypatch.setattr(legacy, "KEYS", {"a.b": "c.d.e", "node": "c.node", "absent.key": "c.absent"})
    monkeypatch.setattr(legacy, "VALUES", {("c.mode", "old"): "new"})
    monkeypatch.setattr(legacy, "STEPS", [lambda config: config.update(step=True)])
    before = {
        "a": {"b": 1, "rest": 2},
        "node": {"x": [{"_target_": "old.Class"}]},
        "c": {"mode": "old", "text": "old.Class"},
    }
    stored = repr(before)
    assert legacy.upgrade(before) == {
        "a": {"rest": 2},
        "c": {
            "mode": "new",
            "text": "old.Class",
            "d": {"e": 1},
            "node": {"x": [{"_target_": "new.Class"}]},
        },
        "step": True,
    }
    assert repr(before) == stored


def test_todays_configuration_is_unchanged():
    """A table that changes a name of today would damage every checkpoint that is read."""
    config = resolve(compose("train"))
    assert legacy.upgrade(config) == config
    assert not {target for _, target in _targets(config)} & set(legacy.TARGETS)
