"""What is refused before anything starts: random frozen encoders,
presets that depend on the training."""

import pytest

from ghgs_lit.config import run_of
from ghgs_lit.errors import InputError
from ghgs_lit.runs.job import check_config
from tests.helpers.jobs import executed


def run(*overrides: str):
    return run_of("train", overrides)


def test_a_frozen_encoder_without_weights_is_refused(verb, tmp_path):
    """The paper's sweeps would train for days on the features of a random encoder."""
    for name in ("sweep=table4", "experiment=zju_mocap", "experiment=thuman2"):
        where = (f"hydra.sweep.dir={tmp_path / 'sweep'}", f"hydra.run.dir={tmp_path / 'run'}")
        code, _, err = verb(name, f"data.root={tmp_path}", *where)
        assert code == 1
        assert "init_from: expected a checkpoint with the encoder's weights" in err
        assert "ghgs import" in err
    assert not executed(tmp_path / "sweep")
    code, out, _ = verb("sweep=table4", f"hydra.sweep.dir={tmp_path / 'sweep'}", "dry_run=true")
    assert code == 1
    assert out.count("would be refused: init_from: expected") == 1


@pytest.mark.parametrize(
    "overrides",
    [
        ("encoder.trainable=all",),
        ("encoder.trainable=none", "init_from=vggt.ckpt"),
        ("encoder.trainable=last_1", "resume=last.ckpt"),
        ("encoder.trainable=none", "allow_random_encoder=true"),
    ],
)
def test_encoders_that_learn_or_have_weights_pass(overrides):
    """Fine-tuning, resumed runs and experiments on purpose must still start."""
    check_config(run(*overrides))


def test_a_partly_frozen_encoder_needs_weights_too():
    """The blocks below the last one would stay random."""
    with pytest.raises(InputError, match=r"init_from: .*encoder\.trainable=last_1"):
        check_config(run("encoder.trainable=last_1"))


def test_a_semantic_branch_needs_weights():
    """It does not learn in training, so that it would stay random."""
    branch = "encoder.semantic={width: 16, depth: 1, heads: 2, channels: 8}"
    with pytest.raises(InputError, match="init_from: expected a checkpoint of `ghgs pretext`"):
        check_config(run(branch))
    check_config(run(branch, "init_from=pretext.ckpt"))
    check_config(run(branch, "allow_random_encoder=true"))


def test_a_sweep_overwrites_nothing(verb, tmp_path):
    """Sweeps go on with their own runs; ``overwrite`` would train all of them again."""
    code, _, err = verb("-m", f"hydra.sweep.dir={tmp_path}", "seed=1,2", "overwrite=true")
    assert code == 1
    assert "overwrite: expected false in a sweep" in err
