"""Random token budgets: each corresponds to a preset of skipping, and the sample depends only on the
step."""

from collections import Counter
from types import SimpleNamespace

import lightning.pytorch as L
import pytest
import torch

from ghgs_lit.cli.verbs import Train
from ghgs_lit.errors import InputError
from ghgs_lit.training import GHGSModule, Optimization
from ghgs_lit.training.module import sample_budget, token_budget
from tests.helpers.losses import losses_of
from tests.helpers.models import close, make_model, predict
from tests.helpers.scenes import make_batch
from tests.helpers.training import Standin, StepData, flat_renderer

# The configured preset, a budget, and the preset to which the budget corresponds.
PRESETS = [
    ("fast", "all", ["skip=exact"]),
    ("exact", "window", ["skip=balanced"]),
    ("balanced", 2, ["skip=fast", "skip.margin=2"]),
]


@pytest.mark.parametrize(("configured", "budget", "preset"), PRESETS)
def test_a_budget_is_a_preset_while_it_lasts(configured, budget, preset):
    """Otherwise weights would be trained on other tokens than those of the preset that they are for."""
    model, batch = make_model(f"skip={configured}"), make_batch(views=2, height=112, width=84)
    expected = make_model(*preset)
    expected.load_state_dict(model.state_dict())
    with torch.no_grad():
        before = predict(model, batch).gaussians
        with token_budget(model, budget):
            close(predict(model, batch).gaussians, predict(expected, batch).gaussians)
        assert torch.equal(predict(model, batch).gaussians.means, before.means)


def test_the_draw_is_even_and_depends_on_all_numbers():
    """If the step, the seed or the part of an accumulated step had no effect, budgets would repeat."""
    budgets = ["all", "window", 0, 0]
    drawn = [
        [sample_budget(budgets, [seed, step, part]) for step in range(400)]
        for seed in (0, 1)
        for part in (0, 1)
    ]
    shares = Counter(drawn[0])
    assert set(shares) == {"all", "window", 0}
    assert 160 < shares[0] < 240
    assert len({tuple(row) for row in drawn}) == 4
    assert drawn[0] == [sample_budget(budgets, [0, step, 0]) for step in range(400)]


class Watched(Standin):
    """Stand-in that records the budgets of training and of validation."""

    def __init__(self):
        super().__init__()
        self.encoder = SimpleNamespace(tokens="subject", margin=7)
        self.trained, self.validated = [], []

    def forward(self, batch):
        seen = self.trained if torch.is_grad_enabled() else self.validated
        seen.append((self.encoder.tokens, self.encoder.margin))
        return super().forward(batch)


def fit(folder, steps, resume=None):
    model = Watched()
    options = Optimization(lr=0.05)
    budgets = ["all", "window", 0, 1, 2]
    module = GHGSModule(model, flat_renderer, losses_of({"render_l1": 1.0}), options, {"seed": 3}, budgets)
    trainer = L.Trainer(
        accelerator="cpu", max_steps=steps, max_epochs=-1, default_root_dir=folder, logger=False,
        enable_checkpointing=False, enable_progress_bar=False, enable_model_summary=False,
        num_sanity_val_steps=0, check_val_every_n_epoch=None, val_check_interval=6,
    )  # fmt: skip
    trainer.fit(module, StepData(), ckpt_path=resume)
    trainer.save_checkpoint(folder / "end.ckpt")
    return model


def test_a_resumed_run_draws_as_the_whole_one_and_validates_as_configured(tmp_path):
    """Otherwise weights would depend on interruptions, and scores on samples."""
    (tmp_path / "half").mkdir()
    whole, half = fit(tmp_path, 18), fit(tmp_path / "half", 12)
    torch.manual_seed(99)  # the state of the global generator must not matter
    rest = fit(tmp_path / "half", 18, resume=tmp_path / "half" / "end.ckpt")
    assert whole.trained == half.trained + rest.trained
    assert len(set(whole.trained)) == 5
    assert set(whole.validated) == {("subject", 7)}


@pytest.mark.parametrize("choices", [[], ["windows"], [-1], ["all", "1"]])
def test_budgets_that_do_not_exist_are_refused(choices):
    """A typing error must not lead to another training."""
    with pytest.raises(InputError, match="token_budgets"):
        Train(token_budgets=choices)
