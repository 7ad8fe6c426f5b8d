"""The whole package on a pretend device that rejects mixing with the CPU, as a GPU would."""

import dataclasses

import lightning.pytorch as L
import pytest
import torch
from lightning.pytorch.accelerators import CPUAccelerator
from lightning.pytorch.strategies import SingleDeviceStrategy
from torch.utils.data import DataLoader

from benchmarks import device as device_counts
from ghgs_capture.verbs import predict
from ghgs_lit.config import conf_dir
from ghgs_lit.evaluation.baselines import BASELINES, baseline
from ghgs_lit.evaluation.measure import ModelMethod, measure
from ghgs_lit.execution import Predictor
from ghgs_lit.method.bounds import box
from ghgs_lit.metrics import MetricsOptions
from ghgs_lit.ops import ray_marching
from ghgs_lit.refinement import CameraRefinement, Refinement
from ghgs_lit.rendering import Renderer
from ghgs_lit.training import GHGSModule, Optimization
from ghgs_lit.training.callbacks import PicturesOptions
from ghgs_lit.training.checkpoints import CheckpointOptions
from ghgs_lit.types import Targets
from ghgs_lit.weights.checkpoint import write_checkpoint
from tests.helpers.losses import losses_of
from tests.helpers.models import close, config, load_model, make_model
from tests.helpers.models import predict as predicted
from tests.helpers.people import render_boxes
from tests.helpers.pretend_device import DEVICE, pretend_device
from tests.helpers.scenes import make_batch
from tests.helpers.verbs import ghgs

PRESETS = sorted(path.stem for path in (conf_dir() / "skip").glob("*.yaml"))
MODELS = ["model=paper", "model=hull", "compat=release"]
WEIGHTS = {"render_l1": 0.8, "render_ssim": 0.2, "chamfer": 0.01, "depth": 0.5}
REFERENCE = Renderer(backend="reference")


pytestmark = pytest.mark.usefixtures("one_thread")


def full_batch(count=2):
    """Elements with everything that data can contain; the first view is also the target."""
    batch = make_batch(count, 3, 28, 42)
    generator = torch.Generator().manual_seed(0)
    return dataclasses.replace(
        batch,
        targets=Targets(batch.images[:, :1], batch.masks[:, :1], batch.cameras[:, :1], protocols=("own",)),
        body_vertices=[torch.rand(40, 3, generator=generator) for _ in batch.images],
        subjects=("a", "b")[:count],
    )


@pytest.mark.parametrize("skip", PRESETS)
@pytest.mark.parametrize("kind", MODELS)
def test_every_stage_runs_there_and_predicts_the_same(kind, skip):
    """A tensor created on the wrong device fails at its line."""
    model, batch = make_model(kind, f"skip={skip}").eval(), make_batch(2, 3, 28, 42)
    with torch.no_grad():
        expected = predicted(model, batch)
        with pretend_device():
            found = predicted(model.to(DEVICE), batch.to(DEVICE))
            assert found.gaussians.means.device == found.points.tokens.device == DEVICE
            found = found.to("cpu")
    # Unbounded depths amplify rounding errors.
    close(found.gaussians, expected.gaussians, 1e-3 if kind == "compat=release" else 1e-6)
    assert torch.equal(found.depth_valid, expected.depth_valid)


class PretendAccelerator(CPUAccelerator):
    """Accelerator for Lightning on the pretend device."""

    def setup_device(self, device):
        """Do nothing; the CPU's accelerator would reject the device."""


def train(folder, **place):
    """Module after two steps and a validation with callbacks."""
    options = Optimization(lr=1e-3, warmup=0.0, freeze_until={"gaussian_head.opacity": 0.4})
    module = GHGSModule(
        make_model("model=hull"), REFERENCE, losses_of(WEIGHTS), options, config("model=hull")
    )
    loader = DataLoader([full_batch()] * 2, batch_size=None, collate_fn=lambda batch: batch)
    trainer = L.Trainer(
        **place,
        max_steps=2,
        limit_val_batches=1,
        default_root_dir=folder,
        callbacks=[
            PicturesOptions(subjects=1).build(),
            CheckpointOptions(filename="last", every_n_train_steps=2).build(),
        ],
        logger=False,
        enable_progress_bar=False,
        enable_model_summary=False,
        num_sanity_val_steps=0,
    )
    trainer.fit(module, loader, loader)
    return module


def test_training_there_changes_the_weights_alike_and_its_checkpoint_loads_anywhere(tmp_path, monkeypatch):
    """Steps with clipping, a validation and callbacks; the checkpoint loads on the CPU and back.

    Logged values of a step are tensors on the device: copying a Python number would synchronize it with
    the host.
    """
    log_dict, logged = GHGSModule.log_dict, {}

    def noted(self, values, **options):
        logged.update(values)
        return log_dict(self, values, **options)

    monkeypatch.setattr(GHGSModule, "log_dict", noted)
    expected = train(tmp_path / "cpu", accelerator="cpu")
    batch = make_batch(1, 3, 28, 42)
    path = tmp_path / "there" / "checkpoints" / "last.ckpt"
    with pretend_device():
        trained = train(tmp_path / "there", strategy=SingleDeviceStrategy(DEVICE, PretendAccelerator()))
        of_step = [value for name, value in logged.items() if name.startswith(("train/", "loss/"))]
        assert len(of_step) > 4
        assert all(isinstance(value, torch.Tensor) and value.device == DEVICE for value in of_step)
        again = load_model(path, map_location=DEVICE)
        with torch.no_grad():
            found = predicted(again, batch.to(DEVICE)).to("cpu")
        trained.to("cpu")
    for (name, a), b in zip(trained.named_parameters(), expected.named_parameters(), strict=True):
        torch.testing.assert_close(a, b[1], atol=1e-4, rtol=1e-3, msg=name)
    with torch.no_grad():
        close(predicted(load_model(path), batch).gaussians, found.gaussians)


def test_batches_are_copied_there_without_a_wait():
    """From pinned memory such copies overlap with the previous step."""
    module = GHGSModule(make_model("model=hull"), REFERENCE, losses_of(WEIGHTS), Optimization(lr=1e-3), {})
    with pretend_device() as log:
        batch = module.transfer_batch_to_device(full_batch(), DEVICE, 0)
        assert log.calls.total() >= 8
        assert log.waits.total() == 0
        full_batch().to(DEVICE)
        assert log.waits.total() >= 8
    assert batch.body_vertices[0].device == batch.targets.cameras.extrinsics.device == DEVICE


def test_everything_is_measured_there(tmp_path, monkeypatch):
    """The model, with refinement, and all baselines, with all metrics and pictures: same rows as on the
    CPU."""
    monkeypatch.setattr("ghgs_lit.refinement.cameras._STEPS", 3)
    metrics = MetricsOptions(lpips="off").build()

    def rows(device):
        def build():
            return Predictor(make_model("model=paper").to(device).eval())

        methods = {name: baseline(name, REFERENCE, 1) for name in BASELINES}
        methods["model"] = ModelMethod(build(), REFERENCE)
        methods["refined"] = ModelMethod(build(), REFERENCE, Refinement(1, REFERENCE))
        refined = build()
        cameras = CameraRefinement(1, refined, REFERENCE)
        methods["cameras"] = ModelMethod(refined, REFERENCE, cameras=cameras)
        found = []
        for name, method in methods.items():
            found += measure(method, name, [full_batch(1)], metrics.to(device), device, tmp_path, 1)
        return found

    expected = rows("cpu")
    with pretend_device():
        found = rows(DEVICE)
    for a, b in zip(found, expected, strict=True):
        numbers = [key for key, value in b.items() if isinstance(value, float) and key != "seconds"]
        assert "psnr_subject" in numbers
        assert [a[key] for key in numbers] == pytest.approx(
            [b[key] for key in numbers], rel=1e-4, abs=1e-4, nan_ok=True
        )


def test_predict_runs_there(tmp_path, monkeypatch):
    """From images on disk to a splat and a turntable on disk."""
    render_boxes(tmp_path / "data", tmp_path / "scans", train=1, val=1)
    checkpoint = tmp_path / "a.ckpt"
    write_checkpoint(checkpoint, make_model("model=hull").state_dict(), config("model=hull"))
    monkeypatch.setattr(predict.inputs, "pick_device", lambda _: DEVICE)
    with pretend_device():
        code = ghgs(
            "predict", f"checkpoint={checkpoint}", "data=scans", f"data.root={tmp_path / 'data'}",
            "data.size=42", "views=v3", "turntable.frames=1", "renderer.backend=reference",
            f"hydra.run.dir={tmp_path / 'run'}",
        )  # fmt: skip
    assert code == 0
    assert list((tmp_path / "run").glob("*.ply"))


def test_the_hull_of_larger_photographs_is_found_without_asking_for_the_number_of_rays(monkeypatch):
    """As on a CPU, although the rays are padded by repeating the first one."""
    monkeypatch.setattr(box, "RESOLUTION", 28)
    monkeypatch.setattr(ray_marching, "_DEPTHS", (20_000, 20_000))
    stage, batch = make_model("model=hull").bounds, make_batch(2, 3, 56, 42)
    expected = stage(batch)
    with pretend_device() as log:
        there = batch.to(DEVICE)
        log.clear()
        found = stage(there)
        assert log.waits.total() == 1  # for the extents, which other stages read as well
        found = found.to("cpu")
    torch.testing.assert_close(found.near, expected.near, atol=1e-5, rtol=1e-5)
    torch.testing.assert_close(found.far, expected.far, atol=1e-5, rtol=1e-5)


class Planted:
    """A stage with a planted defect in its input."""

    def __init__(self, stage, defect):
        self.stage, self.defect = stage, defect

    def __call__(self, depth_maps, tokens, batch):
        return self.stage(self.defect(depth_maps), tokens, batch)


def _buffer_on_the_cpu(maps):
    return dataclasses.replace(maps, depth=maps.depth * torch.ones(maps.depth.shape[-1]))


def _to_numpy(maps):
    return dataclasses.replace(maps, depth=torch.as_tensor(maps.depth.numpy()))


def _mask_on_the_cpu(maps):
    mask = torch.ones(maps.depth.shape, dtype=torch.bool)
    return dataclasses.replace(maps, valid=maps.valid & mask)


def _index_on_the_cpu(maps):
    return dataclasses.replace(maps, depth=maps.depth[torch.arange(len(maps.depth))])


@pytest.mark.parametrize(
    ("defect", "said"),
    [
        (_buffer_on_the_cpu, r"aten::mul: .*\(42,\).* on the CPU"),
        (_to_numpy, "can't convert a tensor on pretend:0 to numpy"),
        (_mask_on_the_cpu, r"aten::(__and__|bitwise_and).*: .* on the CPU"),
        (_index_on_the_cpu, r"aten::index: .* on the CPU"),
    ],
)
def test_a_planted_defect_is_caught(defect, said):
    """Each defect works on the CPU, but fails on a GPU or synchronizes there without need."""
    model, batch = make_model("model=paper").eval(), make_batch(1, 3, 28, 42)
    model.unprojection = Planted(model.unprojection, defect)
    with torch.no_grad():
        predicted(model, batch)
        with pretend_device():
            model, batch = model.to(DEVICE), batch.to(DEVICE)
            with pytest.raises((RuntimeError, TypeError), match=said):
                predicted(model, batch)


def test_calls_and_waits_are_counted_by_stage(monkeypatch, capsys):
    """Counts of a prediction and of a training step, as shown in the guide on GPUs."""
    small = "device.py model=recurrent rounds.slopes=true --batches 1 --views 2 --size 28"
    monkeypatch.setattr("sys.argv", small.split())
    device_counts.main()
    rows = {
        line.split()[0]: line.split()[1:] for line in capsys.readouterr().out.splitlines() if line.strip()
    }
    for stage in ("bounds", "encoder", "depth_head", "gaussian_head", "rounds", "backward", "optimizer"):
        calls, launches, _ = map(int, rows[stage])
        assert calls > launches > 0
