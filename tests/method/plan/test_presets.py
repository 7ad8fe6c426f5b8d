"""``skip=auto``: the cheapest preset within a budget, for each subject by its masks alone."""

from dataclasses import replace

import pytest
import torch

from ghgs_lit.diagnostics.benchmark.stages import FlopsProbe
from ghgs_lit.errors import InputError
from ghgs_lit.method.model import GHGS
from ghgs_lit.method.plan.presets import SkipOptions, encoder_products
from ghgs_lit.weights.checkpoint import load_weights, write_checkpoint
from tests.helpers.models import close, config, make_model
from tests.helpers.scenes import hard_subjects, make_batch, stack


def people():
    """Subjects for which different presets are the cheapest:
    in front of much and of little background."""
    masks = torch.zeros(3, 3, 84, 84, dtype=torch.bool)
    masks[0] = True  # exact: there is no background
    masks[1, :, 20:78, 20:78] = True  # balanced: the margin of fast is more than the window
    # fast: two people, far from each other
    masks[2, :, 2:12, 2:12] = masks[2, :, 72:82, 72:82] = True
    return [replace(make_batch(1, 3, 84, 84), masks=mask[None]) for mask in masks]


@pytest.mark.parametrize("skip", ["exact", "balanced", "fast"])
def test_the_cost_is_what_the_blocks_compute(skip):
    """A preset must not be chosen for products that it does not save;
    against PyTorch's own counter."""
    model, batch = make_model(f"skip={skip}").eval(), stack(list(hard_subjects().values()))
    aggregator = model.encoder.aggregator
    with torch.no_grad(), FlopsProbe() as probe:
        for name, module in (("all", aggregator), ("patches", aggregator.patch_embed)):
            module.register_forward_pre_hook(lambda *_, n=name: probe.begin(n))
            module.register_forward_hook(lambda *_, n=name: probe.end(n))
        model(batch)
    counted = probe.flops["all"] - probe.flops["patches"]
    products = encoder_products(model.encoder, model.encoder.keeps(batch.masks).flatten(2).sum(-1))
    expected = len(aggregator.global_blocks) * products.sum().item()
    assert counted == pytest.approx(expected, rel=1e-9)


def test_each_subject_gets_the_cheapest_preset_and_it_is_what_runs():
    """The choice is a subject's own, and the prediction that of the preset itself."""
    batches, model = people(), make_model("skip=auto").eval()
    with torch.no_grad():
        together = model(stack(batches))
        names = [decision.preset for decision in together.decisions]
        assert names == ["exact", "balanced", "fast"]
        for b, (name, batch) in enumerate(zip(names, batches, strict=True)):
            close(together.gaussians[b], make_model(f"skip={name}").eval()(batch).gaussians)


@pytest.mark.parametrize(
    ("said", "expected"),
    [
        (["skip.choices.balanced=0.2"], ("exact", "exact", "fast")),
        (["skip.budget_db=0.01"], ("exact",) * 3),
        # Equal cost goes to the more exact preset:
        # here fast keeps the window of the second subject.
        (["skip.margin=0"], ("exact", "balanced", "fast")),
    ],
)
def test_budget_and_margin_count(said, expected):
    """A preset beyond the budget must not run, and the line says why not."""
    model, batch = make_model("skip=auto", *said), stack(people())
    plan, masks = model.plan(batch), batch.masks
    decisions, kept = plan.decisions, plan.kept
    assert tuple(decision.preset for decision in decisions) == expected
    line = model.auto.report(decisions)
    assert "\n" not in line
    assert ("not balanced: may lose" in line) == ("balanced" not in expected)
    # Nobody has measured these weights: what a preset loses is what its file says.
    unsure = [name for name in ("balanced", "fast") if name in expected]
    note = f"what {' and '.join(unsure)} may lose is configured, `ghgs benchmark` measures it"
    assert (note in line) == bool(unsure)
    for b, name in enumerate(expected):
        own = make_model(f"skip={name}", *(key for key in said if key == "skip.margin=0")).encoder
        assert torch.equal(kept.row[kept.image // 3 == b], own.keeps(masks)[b].nonzero()[:, 1])
        every = torch.full((1, 3), 36)
        counts = own.keeps(masks)[b : b + 1].flatten(2).sum(-1)
        products = [encoder_products(own, each).item() for each in (counts, every)]
        assert decisions[b].products == pytest.approx(products[0] / products[1])


@pytest.mark.parametrize(
    ("trained", "left"),
    [
        ("skip=exact", ["exact"]),
        ("skip=balanced", ["exact", "balanced"]),
        (["all", "window", 0, 1], ["exact", "balanced", "fast"]),
        (["all", 2], ["exact"]),
        ("skip=fast", ["exact", "fast"]),
    ],
)
def test_presets_that_the_training_did_not_show_are_left_out(tmp_path, trained, left):
    """What a preset loses is known only for weights that have seen what it sees."""
    settings = config(trained) if isinstance(trained, str) else {**config(), "token_budgets": trained}
    path = tmp_path / "a.ckpt"
    write_checkpoint(path, make_model().state_dict(), settings)
    model = GHGS.from_config(config("skip=auto"))
    load_weights(model, path)
    assert list(model.auto.presets) == left
    decisions = model.plan(people()[2]).decisions
    assert {decision.preset for decision in decisions} == {"fast" if "fast" in left else "exact"}
    assert model.auto.report(decisions).count("not shown in training") == 3 - len(left)


@pytest.mark.parametrize("name", ["exact", "balanced", "fast"])
def test_the_presets_to_choose_from_are_those_of_their_files(name):
    """One of them that is changed in its file alone would be another one with skip=auto."""
    auto, own = (SkipOptions.read(config(f"skip={option}")["skip"], "skip") for option in ("auto", name))
    assert dict(auto.presets[name]) == {key: value for key, value in own if key != "choices"}


def test_the_authors_weights_have_seen_all_tokens_only(tmp_path):
    """Their file may be written with any preset;
    what their training did not show must not be chosen."""
    path, model = tmp_path / "release.ckpt", make_model("skip=auto")
    write_checkpoint(path, make_model().state_dict(), config("skip=fast"), imported={"release": "x"})
    load_weights(model, path)
    assert list(model.auto.presets) == ["exact"]


def test_keys_that_would_be_ignored_are_refused():
    """What is said must act."""
    for said, message in (
        ("skip.budget_db=0", r"skip\.budget_db: expected 0\.001 or more with skip=auto; found 0"),
        ("skip.budget_db=null", r"skip\.budget_db: expected 0\.001 or more"),
        ("skip.tokens=subject", r"skip\.tokens: expected all with skip=auto"),
        ("skip.choices.fast=-1", r"skip\.choices\.fast: expected a number >= 0 or null; found -1"),
    ):
        with pytest.raises(InputError, match=message):
            make_model("skip=auto", said)
