"""The selfcheck: it passes where nothing is wrong, and a planted defect fails in its row,
in none before."""

import dataclasses

import pytest
import torch

from ghgs_lit.config import run_of
from ghgs_lit.diagnostics.doctor import selfcheck as module
from ghgs_lit.diagnostics.doctor.selfcheck import (
    FAILED,
    PASSED,
    SKIPPED,
    Outcome,
    compared,
    gradient,
    renderer,
    selfcheck,
    stages,
    table,
)
from ghgs_lit.execution import Predictor
from ghgs_lit.geometry.precision import rounds_products
from ghgs_lit.geometry.unprojection import Unprojection
from ghgs_lit.method.recalibration import Recalibration
from ghgs_lit.ops.rasterization import cpu
from tests.helpers.models import TINY
from tests.helpers.pretend_device import DEVICE, pretend_device
from tests.helpers.verbs import ghgs

CPU = torch.device("cpu")


def settings(*overrides):
    return run_of("doctor", [*TINY, "model=hull", "data.size=56", "loss=depth", *overrides])


def statuses(outcomes):
    return {outcome.check: outcome.status for outcome in outcomes}


def failures(outcomes):
    return [outcome.check for outcome in outcomes if outcome.status == FAILED]


def test_the_verb_finds_nothing_on_the_cpu_and_writes_a_table(tmp_path, capsys):
    """All checks; what needs CUDA is skipped with the reason."""
    code = ghgs(
        "doctor", "task=selfcheck", *TINY, "data.size=56", "loss=depth", "device=cpu",
        f"hydra.run.dir={tmp_path}",
    )  # fmt: skip
    out = capsys.readouterr().out
    assert code == 0, out
    text = (tmp_path / "selfcheck.md").read_text()
    rows = [line.split(" | ") for line in text.splitlines() if line.startswith("| ")]
    found = {check.removeprefix("| "): status for check, status, _ in rows}
    assert found["gradient of the weights, float32"] == PASSED
    assert found["renderer cpu, thresholds: gradient of opacities"] == PASSED
    assert found["model, float32: recalibration"] == PASSED
    assert "float16 runs on CUDA only, not on cpu" in text
    assert "- versions: ghgs-lit" in text
    assert FAILED not in found.values()


def test_it_runs_on_the_pretend_device():
    """Every check; the renderer is the reference, as no other one knows the device."""
    with pretend_device():
        found = list(selfcheck(settings("renderer.backend=reference", "data.size=28"), DEVICE))
    assert failures(found) == []
    assert statuses(found)["model, float16"] == SKIPPED
    assert statuses(found)["model, float32: gaussian_head, means"] == PASSED


def test_it_checks_what_a_user_has(monkeypatch):
    """``inherit`` leaves the process as it is, with convolutions in TF32, and may round as much;
    the gradient is that of a training in float32."""
    right, seen = Predictor._predict, []

    def noted(self, prepared, coarse):
        if prepared.batch.images.dtype == torch.float32:
            seen.append((self.precision, self.model.training, rounds_products("cuda")))
        return right(self, prepared, coarse)

    monkeypatch.setattr(Predictor, "_predict", noted)
    # PyTorch's default, which trainings change
    monkeypatch.setattr(torch.backends.cudnn, "allow_tf32", True)
    with pretend_device():
        found = [*stages(settings(), DEVICE), *gradient(settings(), DEVICE)]
    assert failures(found) == []
    assert seen[:2] == [("inherit", False, True), ("float32", False, False)]
    assert seen[2] == ("inherit", False, False)
    limits = {o.check: o.found.split("limit ")[1] for o in found if "encoder" in o.check}
    assert limits == {"model, inherit: encoder": "4e-03", "model, float32: encoder": "1e-04"}


def test_a_stage_that_is_wrong_fails_and_none_before_it(monkeypatch):
    """Points rounded to half precision: on a GPU a product that autocast has caught."""
    right = Unprojection.__call__

    def rounded(self, *inputs):
        points = right(self, *inputs)
        if points.tokens.dtype == torch.float64:  # what is compared with
            return points
        return dataclasses.replace(points, tokens=points.tokens.half().float())

    monkeypatch.setattr(Unprojection, "__call__", rounded)
    found = [outcome for outcome in stages(settings(), CPU) if "float32" in outcome.check]
    assert failures(found)[0] == "model, float32: unprojection"
    assert statuses(found)["model, float32: depth_head"] == PASSED


@pytest.mark.parametrize(
    ("planted", "row"),
    [
        ({"alpha_min": 0.5 / 255}, "renderer cpu, thresholds: image"),
        ({"stop": 1e-6}, "renderer cpu, thresholds: image"),
        ({"extent": 2.5}, "renderer cpu, random splats: image"),
        ({"low_pass": 0.31}, "renderer cpu, random splats: image"),
        ({"antialiased": False}, "renderer cpu, antialiased: image"),
    ],
    ids=str,
)
def test_a_renderer_with_other_constants_fails(planted, row, monkeypatch):
    """Each of them is compiled into gsplat, and another version may have another."""
    right = cpu.rasterize
    monkeypatch.setattr(cpu, "rasterize", lambda g, c, s, *rest: right(g, c, s.replace(**planted), *rest))
    assert row in failures(renderer(settings(), CPU))


def test_a_weight_without_its_gradient_fails(monkeypatch):
    """The gradient of one stage of several is missing."""
    right = Recalibration.forward

    def detached(self, tokens, points, plan):
        out = right(self, tokens, points, plan)
        return out if out.latent[0].dtype == torch.float64 else out.detach()

    monkeypatch.setattr(Recalibration, "forward", detached)
    assert failures(gradient(settings(), CPU)) == ["gradient of the weights, float32"]


def test_an_error_is_an_outcome_and_other_checks_go_on(monkeypatch):
    """What a machine cannot do at all belongs into the table."""

    def broken(run, device):
        yield Outcome("first", PASSED, "1")
        raise RuntimeError("CUDA error:\nno kernel image")

    monkeypatch.setattr(module, "CHECKS", (broken, renderer))
    found = list(selfcheck(settings(), CPU))
    assert found[1] == Outcome("broken", FAILED, "RuntimeError: CUDA error: no kernel image")
    assert found[2].status == PASSED


def test_nan_and_another_shape_fail_and_a_table_has_three_columns():
    """A comparison with NaN is false: it must not pass."""
    one = torch.ones(3)
    assert compared("a", one * torch.nan, one, 1.0).status == FAILED
    assert compared("a", one[:2], one, 1.0).status == FAILED
    assert compared("a", one, one, 0.0).status == PASSED
    assert compared("a", one * 0, one * 0, 0.0).status == PASSED
    assert all(line.count("|") == 4 for line in table([Outcome("a", PASSED, "x|y")]).splitlines())
