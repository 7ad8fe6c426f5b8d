"""Commands that cannot work, of every verb: an exit code and one line, never a traceback.

A row is a command, its exit code, and parts of its line: the path or key, what was expected, what was found.
``{tmp}`` is the folder of the test; the files in braces are made by the fixture ``files``.
"""

import errno
import os
import resource
import shlex
import signal
import subprocess
import sys
import time
from unittest.mock import Mock

import pytest
import torch
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig

from ghgs_lit.cli import main as cli
from ghgs_lit.synthesis import datasets
from ghgs_lit.weights.checkpoint import write_checkpoint
from tests.helpers.models import config, make_model

BETWEEN = "before or after all key=value"

USAGE = [
    ("", 2, "usage: ghgs <verb>"),
    ("trian", 2, "expected a verb", "found 'trian'", "did you mean train?"),
    ("evalute", 2, "found 'evalute'", "did you mean evaluate?"),
    ("xyz", 2, "expected a verb (prepare, train", "found 'xyz'"),
    ("--cfg job", 2, "expected a verb", "found '--cfg'"),
    ("train seed=1 -m seed=2", 2, BETWEEN, "'seed=2'"),
    ("evaluate data=synthetic --config-dir . seed=1", 2, BETWEEN, "'seed=1'"),
    ("train --confg job", 2, "--confg: expected a flag"),
    ("train --cfg everything", 2, "invalid choice: 'everything'"),
    ("train --config-dir", 2, "--config-dir", "expected one argument"),
    ("predict --multi_run", 2, "--multi_run: expected a flag"),
    ("train --config-dir {tmp}/none", 1, "{tmp}/none", "not found"),
    ("train --config-name trian", 1, "--config-name", "'trian'"),
    ("train seed", 1, "seed: expected key=value"),
    ("train views=[4", 1, "views=[4: expected key=value"),
    ("train 'data.people={{train: 4'", 1, "data.people={{train: 4: expected key=value"),
    ("table runs={tmp} columns=[psnr", 1, "columns=[psnr: expected key=value"),
]

MISSPELT = [
    ("train experiment=demo ~evaluation.views", 1, "evaluation.views: expected a value", "~evaluation.views"),
    ("train ~data.size", 1, "data.size: expected a value", "~data.size"),
    ("train optimizer.lrr=1", 1, "optimizer.lrr: expected a key", "did you mean optimizer.lr?"),
    ("train lr=1e-3", 1, "lr: expected a key", "did you mean optimizer.lr?"),
    ("train max_steps=10", 1, "max_steps: expected a key", "did you mean trainer.max_steps?"),
    ("train data.batchsize=2", 1, "data.batchsize", "did you mean data.batch_size?"),
    ("train trainer.max_step=2", 1, "trainer.max_step", "did you mean trainer.max_steps?"),
    ("train sed=1", 1, "sed: expected a key", "did you mean seed?"),
    ("train optimizer.lr.x=3", 1, "optimizer.lr.x", "did you mean optimizer.lr?"),
    ("train encodr=vggt_nano", 1, "encodr: expected a key or group", "did you mean encoder?"),
    ("train recalibraton.k=4", 1, "recalibraton.k", "did you mean recalibration.k?"),
    ("evaluate optimizer.lr=1", 1, "optimizer.lr: expected a key or group of this verb"),
    ("evaluate checkpont=x.ckpt", 1, "checkpont", "did you mean checkpoint?"),
    ("predict turntable.frame=3", 1, "turntable.frame", "did you mean turntable.frames?"),
    ("prepare taks=check", 1, "taks", "did you mean task?"),
    ("import relase=x.pth", 1, "relase", "did you mean release?"),
    ("export vgt=x.pt", 1, "vgt", "did you mean vggt?"),
    ("table run={tmp}", 1, "run: expected a key", "did you mean runs?"),
    ("table runs={tmp} test.unt=1", 1, "test.unt", "did you mean test.unit?"),
    ("train encoder=vggt_nanoo", 1, "encoder: expected one of vggt_1b", "'vggt_nanoo'", "vggt_nano?"),
    ("train model=hul", 1, "model: expected one of hull, paper", "did you mean hull?"),
    ("train ablation=no_semantics", 1, "ablation: expected one of", "did you mean no_semantic?"),
    ("train views=4", 1, "views=4: expected overrides that Hydra can apply", "found"),
    ("train skip=balancd", 1, "skip: expected one of", "did you mean balanced?"),
    ("train sweep=table5", 1, "sweep: expected one of table1", "found 'table5'"),
    ("train experiment=demoo", 1, "experiment: expected one of", "did you mean demo?"),
    ("train hydra/launcher=jobib", 1, "hydra/launcher: expected one of", "did you mean joblib?"),
    ("train hydra/launcher=ray_jobs", 1, "hydra/launcher: expected one of", "the extra ray has it"),
    ("evaluate data=syntetic", 1, "data: expected one of", "did you mean synthetic?"),
    ("predict renderer=gspat checkpoint=x", 1, "renderer: expected one of", "did you mean gsplat?"),
    ("prepare data=thuman", 1, "data: expected one of", "did you mean thuman2?"),
    ("import compat=relase out=x", 1, "compat: expected one of none, release", "did you mean release?"),
    ("train +optimizer.lrr=1", 1, "optimizer", "lrr"),
    ("train +seed=3", 1, "+seed=3: expected", "already at 'seed'"),
    ("train ~sed", 1, "~sed: expected", "does not exist"),
]

MISSING = [
    ("train ~optimizer", 1, "optimizer: expected a key or group of ghgs train; found none"),
    ("train ~seed", 1, "seed: expected a key or group of ghgs train; found none"),
    ("train optimizer=null", 1, "optimizer=null: expected"),
    ("train 'seed=${{foo}}'", 1, "seed: expected a value that can be resolved", "'foo'"),
    ("train seed=", 1, "seed: expected an integer", "found ''"),
    ("train data=thuman2 model.pad=multiple", 1, "data.root: expected", "found null"),
    (
        "train data=zju_mocap model.pad=multiple targets=cameras evaluation.targets=[cameras]",
        1,
        "data.root: expected",
        "found null",
    ),
    ("train data=scans data.root={tmp}/none", 1, "{tmp}/none: expected the folder of the data set"),
    ("train data=thuman2 model.pad=multiple data.root={empty}", 1, "{empty}"),
    (
        "train data=humman model.pad=multiple data.root={empty} targets=cameras evaluation.targets=[cameras]",
        1,
        "data.smpl_model: expected",
    ),
    (
        "train data=zju_mocap model.pad=multiple data.root={empty} targets=cameras "
        "evaluation.targets=[cameras]",
        1,
        "{empty}",
    ),
    ("evaluate", 1, "data: expected data=<option>"),
    ("evaluate data=synthetic", 1, "checkpoint: expected a checkpoint or baselines=[...]; found neither"),
    ("evaluate checkpoint={tmp}/none.ckpt", 1, "{tmp}/none.ckpt: expected"),
    ("evaluate checkpoint={ckpt}", 1, "data: expected data=<option>", "{ckpt}"),
    ("evaluate checkpoint={ckpt} data=thuman2 model.pad=multiple", 1, "data.root: expected", "found null"),
    ("predict", 1, "checkpoint: expected a value", "found none"),
    ("predict checkpoint={tmp}/none.ckpt", 1, "{tmp}/none.ckpt: expected"),
    (
        "predict checkpoint={ckpt} data=thuman2 model.pad=multiple data.root={tmp}/none",
        1,
        "{tmp}/none: expected",
    ),
    ("prepare task=check data=thuman2 data.root={tmp}/none", 1, "expected nothing missing or broken"),
    ("prepare data=scans", 1, "data.source: expected", "found null"),
    ("prepare data=scans data.root={tmp}/out data.source={tmp}/none", 1, "{tmp}/none"),
    ("prepare data=thuman2 data.source={empty} data.root={tmp}/out", 1, "{empty}"),
    ("prepare task=miniature data=zju_mocap", 1, "data.root: expected", "found null"),
    ("import", 1, "out: expected a value (out=...); found none"),
    ("import out={tmp}/x.ckpt encoder=vggt_nano compat=none", 1, "vggt: expected a file"),
    ("import out={tmp}/x.ckpt vggt={tmp}/none.pt encoder=vggt_nano compat=none", 1, "{tmp}/none.pt"),
    ("export", 1, "checkpoint: expected a value", "found none"),
    ("export checkpoint={ckpt}", 1, "vggt: expected vggt=<file>, release=<file> or inference"),
    ("export checkpoint={tmp}/none.ckpt vggt={tmp}/x.pt", 1, "{tmp}/none.ckpt: expected"),
    ("table", 1, "runs: expected a value (runs=...); found none"),
    ("table runs={tmp}/none", 1, "{tmp}/none: expected a directory of runs"),
    ("table runs={empty}", 1, "{empty}: expected runs with a metrics.json"),
    ("table runs=[]", 1, "runs: expected", "found []"),
    ("train resume={tmp}/none.ckpt", 1, "{tmp}/none.ckpt: expected"),
    ("train init_from={tmp}/none.ckpt", 1, "{tmp}/none.ckpt: expected"),
]

NUMBERS = [
    ("train optimizer.lr=abc", 1, "optimizer.lr: expected a number > 0; found 'abc'"),
    ("train optimizer.lr=0", 1, "optimizer.lr: expected a number > 0; found 0"),
    ("train optimizer.lr=nan", 1, "optimizer.lr: expected a number > 0; found nan"),
    ("train optimizer.lr=true", 1, "optimizer.lr: expected a number > 0; found True"),
    ("train optimizer.betas=[0.9]", 1, "optimizer.betas: expected a list of 2 values", "[0.9]"),
    ("train optimizer.betas=[0.9,1.5]", 1, "optimizer.betas: expected", "< 1", "1.5"),
    ("train optimizer.clip=-1", 1, "optimizer.clip: expected a number > 0; found -1"),
    ("train optimizer.warmup=1", 1, "optimizer.warmup: expected", "< 1", "found 1"),
    ("train optimizer.weight_decay=-1", 1, "optimizer.weight_decay: expected a number >= 0"),
    ("train seed=true", 1, "seed: expected an integer >= 0", "found True"),
    ("train seed=-1", 1, "seed: expected an integer >= 0", "found -1"),
    ("train seed=1.5", 1, "seed: expected an integer", "found 1.5"),
    ("train seed=4294967296", 1, "seed: expected", "<= 4294967295"),
    ("train seed=one", 1, "seed: expected an integer", "found 'one'"),
    ("evaluate seed=null data=synthetic", 1, "seed: expected an integer", "found None"),
    ("prepare seed=1.5", 1, "seed: expected an integer", "found 1.5"),
    ("train trainer.max_steps=abc", 1, "trainer.max_steps: expected an integer >= -1; found 'abc'"),
    ("train trainer.max_steps=1.5", 1, "trainer.max_steps: expected an integer >= -1; found 1.5"),
    ("train trainer.max_steps=1e5", 1, "trainer.max_steps: expected an integer >= -1; found 100000.0"),
    ("train trainer.max_steps=-2", 1, "trainer.max_steps: expected an integer >= -1; found -2"),
    ("train trainer.max_time=10", 1, "trainer.max_time: expected days:hours:minutes:seconds", "found 10"),
    ("train trainer.max_time=ten", 1, "trainer.max_time: expected", "found 'ten'"),
    ("train 'trainer.max_time=\"1:2\"'", 1, "trainer.max_time: expected", "found '1:2'"),
    ("train trainer.val_check_interval=0", 1, "trainer.val_check_interval: expected an integer >= 1", "0"),
    ("train trainer.val_check_interval=-5", 1, "trainer.val_check_interval: expected", "found -5"),
    ("train trainer.devices=0", 1, "trainer.devices: expected an integer >= 1", "found 0"),
    ("train trainer.devices=[a]", 1, "trainer.devices: expected", "found ['a']"),
    ("train trainer.accumulate_grad_batches=0", 1, "trainer.accumulate_grad_batches: expected"),
    ("train trainer.limit_val_batches=-1", 1, "trainer.limit_val_batches: expected", "found -1"),
    ("train trainer.deterministic=maybe", 1, "trainer.deterministic: expected true or false"),
    ("train data.batch_size=1.5", 1, "data.batch_size: expected an integer >= 1; found 1.5"),
    ("train data.batch_size=0", 1, "data.batch_size: expected an integer >= 1; found 0"),
    ("train data.size=100000", 1, "data.size: expected", "<= 8192", "found 100000"),
    ("prepare data.size=100000", 1, "data.size: expected", "<= 8192", "found 100000"),
    ("train data.size=0", 1, "data.size: expected an integer >= 1", "found 0"),
    ("train data.size=[140]", 1, "data.size: expected", "list of 2 values", "found [140]"),
    ("train data.workers=-1", 1, "data.workers: expected an integer >= 0", "found -1"),
    ("train data.workers=two", 1, "data.workers: expected", "found 'two'"),
    ("train data.people.train=0", 1, "data.people.train: expected an integer >= 1; found 0"),
    ("train data.people=4", 1, "data.people: expected a mapping of its keys; found 4"),
    ("train data.root=7 data=thuman2", 1, "data.root: expected a path or null; found 7"),
    ("train data.rig.pitch=100", 1, "data.rig.pitch: expected", "< 89", "found 100"),
    ("train data.rig.look_at=[0,0]", 1, "data.rig.look_at: expected a list of 3 values", "[0, 0]"),
    ("prepare data.render.samples=99", 1, "data.render.samples: expected", "<= 16", "found 99"),
    ("prepare data.render.quality=0", 1, "data.render.quality: expected", "found 0"),
    ("prepare data.render.lights.count=0", 1, "data.render.lights.count: expected", "found 0"),
    ("prepare check.min_iou=2", 1, "check.min_iou: expected", "<= 1", "found 2"),
    ("prepare miniature.size=big task=miniature", 1, "miniature.size: expected", "found 'big'"),
    ("prepare miniature.people.train=-1", 1, "miniature.people.train: expected", "found -1"),
    ("train data=thuman2 data.limit.val=0", 1, "data.limit.val: expected an integer >= 1 or null; found 0"),
    ("train 'data.evaluation_positions={{4: [a]}}'", 1, "data.evaluation_positions.4: expected", "['a']"),
    ("train data.apply_mask=2", 1, "data.apply_mask: expected true or false; found 2"),
    ("train encoder.patch_size=0", 1, "encoder.patch_size: expected an integer >= 1", "found 0"),
    ("train encoder.width=1000000000", 1, "encoder.width: expected", "<= 65536"),
    ("train encoder.layers=all", 1, "encoder.layers: expected a list", "found 'all'"),
    ("train encoder.depth=4.0", 1, "encoder.depth: expected an integer", "found 4.0"),
    ("train encoder.mask_input=some", 1, "encoder.mask_input: expected true or false"),
    ("train recalibration.k=0", 1, "recalibration.k: expected an integer >= 1; found 0"),
    ("train recalibration.s_min=0", 1, "recalibration.s_min: expected a number > 0", "found 0"),
    ("train bounds.cells=100000", 1, "bounds.cells: expected", "<= 512"),
    ("train bounds.dilation=wide", 1, "bounds.dilation: expected a number", "found 'wide'"),
    ("train depth_head.start=1", 1, "depth_head.start: expected", "< 1", "found 1"),
    ("train gaussian_head.hidden=[16]", 1, "gaussian_head.hidden: expected a list of 2 values"),
    ("train gaussian_head.attributes.scale_floor=0", 1, "gaussian_head.attributes.scale_floor: expected"),
    ("train renderer.near=close", 1, "renderer.near: expected a number > 0; found 'close'"),
    ("train renderer.background=white", 1, "renderer.background: expected", "found 'white'"),
    ("train loss.weights.chamfer=-1", 1, "loss.weights.chamfer: expected a number >= 0; found -1"),
    ("train loss.chamfer_points=0", 1, "loss.chamfer_points: expected", "found 0"),
    ("train views.training_counts=4", 1, "views.training_counts: expected a list", "found 4"),
    ("train views.evaluation_count=1", 1, "views.evaluation_count: expected an integer >= 2; found 1"),
    ("train targets.per_subject=some", 1, "targets.per_subject: expected an integer >= 1 or all"),
    ("train targets.per_step=0", 1, "targets.per_step: expected an integer >= 1; found 0"),
    ("train evaluation.views=[1]", 1, "evaluation.views: expected", ">= 2", "found [1]"),
    ("evaluate evaluation.views=[0] data=synthetic", 1, "evaluation.views: expected", "found [0]"),
    ("train evaluation.pictures=-1", 1, "evaluation.pictures: expected an integer >= 0; found -1"),
    ("train callbacks.pictures.subjects=-1", 1, "callbacks.pictures.subjects: expected", "found -1"),
    ("train callbacks.last_by_time.minutes=0", 1, "callbacks.last_by_time.minutes: expected", "found 0"),
    ("train callbacks.attention.token=[1]", 1, "callbacks.attention.token: expected a list of 3 values"),
    ("train callbacks.best.mode=best", 1, "callbacks.best.mode: expected one of max, min; found 'best'"),
    ("train metrics.box_margin=-1", 1, "metrics.box_margin: expected a number >= 0; found -1"),
    ("evaluate splats.opacity=2 data=synthetic", 1, "splats.opacity: expected", "<= 1", "found 2"),
    ("predict checkpoint=x turntable.frames=-1", 1, "turntable.frames: expected an integer >= 0; found -1"),
    ("predict checkpoint=x subject=1.5", 1, "subject: expected a text or an integer", "found 1.5"),
    ("predict checkpoint=5", 1, "checkpoint: expected a path or null; found 5"),
    ("import out=x dtype=float8", 1, "dtype: expected one of float32, bfloat16, float16; found 'float8'"),
    ("import out=x depth_head_start=old", 1, "depth_head_start: expected one of fresh, vggt; found 'old'"),
    ("table runs={tmp} test.alpha=2", 1, "test.alpha: expected", "< 1", "found 2"),
    ("table runs={tmp} evaluation.views=four", 1, "evaluation.views: expected", "found 'four'"),
    ("table runs={tmp} reported=maybe", 1, "reported: expected true or false; found 'maybe'"),
    ("table runs={tmp} columns=[1]", 1, "columns: expected", "found [1]"),
    ("train -m seed=1,x", 1, "seed: expected an integer", "found 'x'"),
    ("train -m seed=1,2 data.batch_size=0", 1, "data.batch_size: expected", "found 0"),
    ("train sweep=table2 dry_run=true encoder.width=0", 1, "encoder.width: expected", "found 0"),
    ("train hydra.mode=all", 1, "hydra.mode=all: expected", "RUN, MULTIRUN"),
]

NAMES = [
    ("train recalibration.similarity=cosine", 1, "recalibration.similarity: expected one of", "'cosine'"),
    ("train recalibration.neighbors=some", 1, "recalibration.neighbors: expected one of", "'some'"),
    ("train depth_head.parameterization=sqrt", 1, "depth_head.parameterization: expected one of", "'sqrt'"),
    ("train depth_head.parameterization=inverse_linear", 1, "expected", "found"),
    ("train bounds=none", 1, "bounds: expected", "found"),
    ("train model.pad=all", 1, "model.pad: expected one of none, multiple; found 'all'"),
    ("train encoder.vit.kind=resnet", 1, "encoder.vit.kind: expected one of", "'resnet'"),
    ("train encoder.trainable=some", 1, "encoder.trainable: expected all, none or last_<n>", "'some'"),
    ("train renderer.backend=opengl", 1, "renderer.backend: expected one of", "'opengl'"),
    ("train loss.chamfer=cubic", 1, "loss.chamfer: expected one of", "'cubic'"),
    ("train +loss.weights.lpips=1", 1, "loss.weights: expected one of", "'lpips'"),
    ("train views.training=odd", 1, "views.training: expected one of any, even; found 'odd'"),
    ("train targets.kind=other", 1, "targets.kind: expected one of", "'other'"),
    ("train targets.view=9", 1, "targets.view: expected one of", "found 9"),
    ("train trainer.precision=8", 1, "trainer.precision: expected", "found 8"),
    ("train trainer.accelerator=abacus", 1, "trainer", "abacus"),
    ("train data._target_=os.system", 1, "data._target_: expected a class of ghgs_lit", "'os.system'"),
    ("train renderer._target_=7", 1, "renderer._target_: expected a text; found 7"),
    ("evaluate data=synthetic baselines=[white]", 1, "baselines: expected one of black", "'white'"),
    ("evaluate data=synthetic baselines=all device=tpu", 1, "device: expected one of auto", "'tpu'"),
    ("evaluate checkpoint={ckpt} data=synthetic precision=int8", 1, "precision: expected one of", "'int8'"),
    ("predict checkpoint={ckpt} data=synthetic device=gpu", 1, "device: expected one of auto", "'gpu'"),
    ("prepare task=paint", 1, "task: expected one of render, miniature, check; found 'paint'"),
    ("table runs={tmp} layout=table9", 1, "layout: expected one of ablation", "found 'table9'"),
    ("table runs={tmp} test.kind=anova", 1, "test.kind: expected one of", "'anova'"),
    ("table runs={tmp} test.unit=x", 1, "test.unit: expected a regular expression with a group"),
    ("table runs={tmp} 'test.unit=\"(\"'", 1, "test.unit: expected a regular expression"),
    ("import out={tmp}/x.ckpt encoder=vggt_nano", 1, "compat: expected none", "found 'release'"),
]

FOREIGN = [
    ("evaluate checkpoint={text} data=synthetic", 1, "{text}: expected weights"),
    ("evaluate checkpoint={empty} data=synthetic", 1, "{empty}: expected weights", "found a directory"),
    ("evaluate checkpoint={list} data=synthetic", 1, "{list}: expected a checkpoint", "found a list"),
    ("evaluate checkpoint={tensors} data=synthetic", 1, "{tensors}: expected a checkpoint with", "'weight'"),
    ("predict checkpoint={text}", 1, "{text}: expected weights"),
    ("predict checkpoint={hollow} data=synthetic", 1, "{hollow}", "expected"),
    ("predict checkpoint={newer}", 1, "{newer}: expected format_version 1 to", "newer version"),
    ("train resume={text}", 1, "{text}: expected weights"),
    ("train init_from={tensors}", 1, "{tensors}: expected a checkpoint with"),
    ("train init_from={ckpt} init_strict=true encoder.width=64", 1, "{ckpt}"),
    ("export checkpoint={text} vggt={tmp}/x.pt", 1, "{text}: expected weights"),
    ("export checkpoint={ckpt} release={tmp}/x.pth", 1, "{ckpt}", "expected", "found"),
    ("import out={tmp}/x.ckpt vggt={text} encoder=vggt_nano compat=none", 1, "{text}: expected weights"),
    ("table runs={text}", 1, "{text}: expected a directory of runs"),
    ("table runs={broken}", 1, "{broken}/run/metrics.json: expected"),
    ("table runs={empty} others={text} layout=table1", 1, "{text}: expected"),
    ("prepare data=thuman2 data.source={empty} data.root={tmp}/o data.split={text}", 1, "{empty}"),
]

SYSTEM = [
    ("train hydra.run.dir=/dev/null/run", 1, "/dev/null/run", "expected a file", "Not a directory"),
    ("train hydra.run.dir=/proc/run", 1, "/proc/run: expected a file"),
    ("train hydra.run.dir={text}/run", 1, "{text}/run: expected", "Not a directory"),
    ("evaluate hydra.run.dir=/dev/null/run", 1, "/dev/null/run", "Not a directory"),
    ("predict checkpoint=x hydra.run.dir=/dev/null/run", 1, "/dev/null/run", "Not a directory"),
    ("prepare hydra.run.dir=/dev/null/run", 1, "/dev/null/run", "Not a directory"),
    ("table runs={tmp} hydra.run.dir=/dev/null/run", 1, "/dev/null/run", "Not a directory"),
    ("export checkpoint={ckpt} vggt=/dev/null/x.pt", 1, "/dev/null/x.pt: expected a file", "File exists"),
    ("export checkpoint={ckpt} vggt=/proc/x.pt", 1, "/proc/x.pt: expected a file"),
    ("export checkpoint={ckpt} vggt={empty}", 1, "{empty}: expected", "a directory"),
    ("train -m seed=1,2 hydra.sweep.dir=/dev/null/s", 1, "/dev/null/s/", "Not a directory"),
]

#: Commands whose answer is not yet as it should be: the row, and what is missing.
# What is checked before any photograph is rendered, and what would destroy a run.
EARLY = [
    ("train evaluation.targets=[relase]", 1, "evaluation.targets: expected one of", "did you mean release?"),
    ("train evaluation.split=foo", 1, "evaluation.split: expected", "'foo'"),
    ("train data.size=150", 1, "data.size: expected", "150"),
    ("train encoder.trainable=none", 1, "init_from", "ghgs import"),
    ("train hydra.run.dir={broken}/run", 1, "{broken}/run", "resume=", "overwrite=true"),
    ("evaluate checkpoint={ckpt} data=synthetic device=cuda", 1, "device: expected", "cuda"),
]

ROWS = [*USAGE, *MISSING, *NAMES, *FOREIGN, *SYSTEM, *MISSPELT, *NUMBERS, *EARLY]


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """Files and folders that commands name, by their names in rows."""
    folder = tmp_path_factory.mktemp("files")
    places = {name: folder / name for name in ("ckpt", "text", "empty", "list", "tensors", "hollow", "newer")}
    places["broken"] = folder / "broken"
    write_checkpoint(places["ckpt"], make_model().state_dict(), config())
    write_checkpoint(places["hollow"], {}, config())
    places["text"].write_text("no weights\n")
    places["empty"].mkdir()
    torch.save([1, 2], places["list"])
    torch.save({"weight": torch.zeros(2)}, places["tensors"])
    torch.save({"state_dict": {}, "config": {}, "format_version": 99}, places["newer"])
    (places["broken"] / "run").mkdir(parents=True)
    (places["broken"] / "run" / "metrics.json").write_text("{")
    return places


def call(monkeypatch, capfd, tmp_path, command: str) -> tuple[int, str]:
    """The exit code and the standard error of ``ghgs <command>`` in the folder ``tmp_path``."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("GHGS_CACHE", str(tmp_path / "cache"))
    monkeypatch.setenv("HYDRA_FULL_ERROR", "0")
    monkeypatch.setattr("sys.argv", ["ghgs", *shlex.split(command)])
    monkeypatch.setattr(HydraConfig.instance(), "cfg", None)
    # Rendering takes minutes, so all that can be checked is checked before.
    started = AssertionError("work started before all was checked")
    monkeypatch.setattr(datasets, "render_people", Mock(side_effect=started))
    GlobalHydra.instance().clear()
    try:
        code = cli.main()
    except SystemExit as stop:
        code = int(stop.code or 0)
    out, err = capfd.readouterr()
    return code, err or out


@pytest.mark.parametrize(
    ("command", "expected", "parts"),
    [pytest.param(row[0], row[1], row[2:], id=row[0] or "nothing") for row in ROWS],
)
def test_a_bad_command_gets_its_exit_code_and_one_line(
    monkeypatch, capfd, tmp_path, files, command, expected, parts
):
    """Users and scripts must learn what was wrong: the path or key, what was expected, what was found."""
    names = {**files, "tmp": tmp_path}
    code, text = call(monkeypatch, capfd, tmp_path, command.format(**names))
    assert code == expected, text
    assert "Traceback" not in text
    if command:  # without a verb it is the usage
        assert len(text.strip().splitlines()) == 1, text
    for part in parts:
        assert part.format(**names) in text


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EROFS, errno.EACCES, errno.EDQUOT])
@pytest.mark.parametrize(
    "command",
    [
        "train",
        "evaluate data=synthetic",
        "predict checkpoint={ckpt} data=synthetic",
        "import out=x.ckpt",
        "export checkpoint={ckpt} vggt=x.pt",
        "table runs={empty}",
    ],
)
def test_a_disk_that_refuses_a_file_is_one_line_with_its_path(
    monkeypatch, capfd, tmp_path, files, command, number
):
    """A full disk or a read-only folder ended in a traceback without the path."""

    def refuse(*_):
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(os, "replace", refuse)
    code, text = call(monkeypatch, capfd, tmp_path, f"{command.format(**files)} hydra.run.dir={tmp_path}/run")
    verb = command.split()[0]
    assert code == 1, text
    assert text == (
        f"ghgs {verb}: {tmp_path}/run/config.yaml: expected a file that can be read or written;"
        f" found {os.strerror(number)}\n"
    )


def test_weights_that_do_not_fit_the_disk_are_one_line_with_their_path(monkeypatch, capfd, tmp_path, files):
    """PyTorch reports a full disk by an error of its own; here files may have 64 KiB."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1 << 16, before[1]))
    try:
        path = tmp_path / "encoder.pt"
        code, text = call(monkeypatch, capfd, tmp_path, f"export checkpoint={files['ckpt']} vggt={path}")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert code == 1, text
    assert text == f"ghgs export: {path}: expected a file that can be read or written; found File too large\n"
    assert not path.exists()


@pytest.mark.parametrize(
    ("number", "expected"),
    [
        (signal.SIGINT, 130),
        (signal.SIGTERM, 143),
    ],
)
def test_a_signal_is_an_exit_code_and_one_line(tmp_path, number, expected):
    """Scripts and batch systems tell an interrupted verb from one that failed or succeeded."""
    command = [sys.executable, "-m", "ghgs_lit", "prepare", "data.people.train=5000", "data.render_workers=0"]
    command += [f"data.cache_dir={tmp_path / 'cache'}", f"hydra.run.dir={tmp_path / 'run'}"]
    process = subprocess.Popen(command, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True)
    try:
        for _ in range(1200):
            if any(tmp_path.glob("cache/*/*")) or process.poll() is not None:
                break
            time.sleep(0.1)
        process.send_signal(number)
        _, text = process.communicate(timeout=60)
    finally:
        process.kill()
    assert process.returncode == expected, text
    assert "Traceback" not in text
    assert text.strip().splitlines()[-1].startswith("ghgs prepare: ")
