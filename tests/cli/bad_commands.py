"""Commands that cannot work, by what is wrong with them.

A row is a command, its exit code, and parts of its line: the path or key, what was expected, what was found.
``{tmp}`` is the folder of the test; the files in braces are made by the fixture ``files`` of
``test_bad_commands``.
"""

USAGE = [
    ("", 2, "usage: ghgs <verb>"),
    ("trian", 2, "expected a verb", "found 'trian'", "did you mean train?"),
    ("evalute", 2, "found 'evalute'", "did you mean evaluate?"),
    ("xyz", 2, "expected a verb (prepare, train", "found 'xyz'"),
    ("--cfg job", 2, "expected a verb", "found '--cfg'"),
    ("train --confg job", 2, "unrecognized arguments: --confg"),
    ("train --cfg everything", 2, "argument --cfg/-c: invalid choice: 'everything'"),
    ("train --config-dir", 2, "--config-dir/-cd: expected one argument"),
    ("predict --multi_run", 2, "unrecognized arguments: --multi_run"),
    ("train --config-dir {tmp}/none", 1, "{tmp}/none", "not found"),
    ("train --config-dir {yaml} views=cut", 1, "{yaml}/views/cut.yaml, line 3: expected YAML of plain data"),
    ("train --config-dir {yaml} views=tagged", 1, "{yaml}/views/tagged.yaml, line 1: expected YAML of plain"),
    ("predict images=a cameras=b out={loop}/x", 1, "{loop}/x", "found Too many levels of symbolic"),
    ("train +bounds._target_=os.system", 1, "bounds key: expected one of", "found '_target_'"),
    ("train --config-dir {yaml} bounds=calls", 1, "bounds key: expected one of", "found '_target_'"),
    ("train resume={loop}/x", 1, "{loop}/x: expected a path; found links in a loop"),
    ("train --config-name trian", 1, "--config-name", "'trian'"),
    ("train seed", 1, "seed: expected key=value"),
    ("train views=[4", 1, "views=[4: expected key=value"),
    ("train 'data.people={{train: 4'", 1, "data.people={{train: 4: expected key=value"),
    ("table runs={tmp} columns=[psnr", 1, "columns=[psnr: expected key=value"),
    ("evaluate checkpoint=epoch=3.ckpt", 1, "checkpoint: expected quotes", "'checkpoint=\"epoch=3.ckpt\"'"),
    ("predict images=照片", 1, "images: expected quotes", "'images=\"照片\"'; found 照片"),
]

MISSPELT = [
    ("train experiment=demo ~evaluation.views", 1, "evaluation.views: expected a value", "~evaluation.views"),
    ("train ~data.size", 1, "data.size: expected a value", "~data.size"),
    ("train optimizer.lrr=1", 1, "optimizer.lrr: expected a key", "did you mean optimizer.lr?"),
    ("train lr=1e-3", 1, "lr: expected a key", "did you mean optimizer.lr?"),
    ("train max_steps=10", 1, "max_steps: expected a key", "did you mean trainer.max_steps?"),
    ("train data.batchsize=2", 1, "data.batchsize", "did you mean data.batch_size?"),
    ("train trainer.max_step=2", 1, "trainer.max_step", "did you mean trainer.max_steps?"),
    (
        "train experiment=demo callbacks=none callbacks.pictures.subjects=4",
        1,
        "callbacks.pictures.subjects: expected a key",
        "found none of that name (callbacks=default has it)\n",
    ),
    ("train data.root=x", 1, "data.root", "(data=humman or scans or thuman2 or thuman2_ghg"),
    ("train rounds.count=2", 1, "found none of that name (model=recurrent has it)\n"),
    ("train optimizer.freeze_until.encoder=0.5", 1, "; +optimizer.freeze_until.encoder=... adds it"),
    ("train hydra.job.env_set.A=b", 1, "; +hydra.job.env_set.A=... adds it"),
    ("train foo=1", 1, "foo: expected a key or group of this verb; found none of that name\n"),
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
    ("train model=hul", 1, "model: expected one of gps, hull, paper", "did you mean hull?"),
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
    ("train ~sed", 1, "sed: expected a value", "~sed"),
]

MISSING = [
    ("train ~optimizer", 1, "optimizer: expected a value", "~optimizer"),
    ("train ~seed", 1, "seed: expected a value", "~seed"),
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
        "{empty}: expected sequences such as",
    ),
    (
        "train data=zju_mocap model.pad=multiple data.root={empty} targets=cameras "
        "evaluation.targets=[cameras]",
        1,
        "{empty}",
    ),
    ("doctor", 1, "images: expected images=<folder", "task=machine or task=selfcheck; found None"),
    ("evaluate", 1, "data: expected data=<option>"),
    ("evaluate data=synthetic", 1, "checkpoint: expected a checkpoint or baselines=[...]; found neither"),
    (
        "evaluate data=synthetic checkpoint=shipped skip=temporal",
        1,
        "skip.every: expected 1: ghgs evaluate",
        "found 8",
    ),
    ("evaluate checkpoint={tmp}/none.ckpt", 1, "{tmp}/none.ckpt: expected"),
    ("evaluate checkpoint={ckpt}", 1, "data: expected data=<option>", "{ckpt}"),
    ("evaluate checkpoint={ckpt} data=thuman2 model.pad=multiple", 1, "data.root: expected", "found null"),
    ("predict", 1, "data: expected images=<folder> cameras=<file>, or data=<option>", "found neither"),
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
    ("train data.batch_size=1.5", 1, "data.batch_size: expected an integer >= 1 and <= 1024; found 1.5"),
    ("train data.batch_size=0", 1, "data.batch_size: expected an integer >= 1 and <= 1024; found 0"),
    ("train data.size=100000", 1, "data.size: expected", "<= 8192", "found 100000"),
    ("prepare data.size=100000", 1, "data.size: expected", "<= 8192", "found 100000"),
    ("train data.size=0", 1, "data.size: expected an integer >= 1", "found 0"),
    ("train data.size=[140]", 1, "data.size: expected", "list of 2 values", "found [140]"),
    ("train data.workers=-1", 1, "data.workers: expected an integer >= 0", "found -1"),
    ("train data.workers=two", 1, "data.workers: expected", "found 'two'"),
    ("train data.people.train=0", 1, "data.people.train: expected an integer >= 1 and < 1000000; found 0"),
    ("train data.people=4", 1, "data.people: expected a mapping of its keys; found 4"),
    ("train data.root=7 data=thuman2", 1, "data.root: expected a path or null; found 7"),
    ("train data.rig.height=0", 1, "data.rig.height: expected a number > 0 or null", "found 0"),
    (
        "train data.rig.variation.radius=[2]",
        1,
        "data.rig.variation.radius: expected a list of 2 values",
        "[2]",
    ),
    ("prepare data.render.samples=99", 1, "data.render.samples: expected", "<= 16", "found 99"),
    ("prepare data.render.quality=0", 1, "data.render.quality: expected", "found 0"),
    ("prepare check.min_iou=2", 1, "check.min_iou: expected", "<= 1", "found 2"),
    ("train data=thuman2 data.limit.val=0", 1, "data.limit.val: expected an integer >= 1 or null; found 0"),
    (
        "train 'data.evaluation_positions=[[a]]'",
        1,
        "data.evaluation_positions: expected a list (each a list",
        "['a']",
    ),
    ("train data=zju_mocap data.undistorted=2", 1, "data.undistorted: expected true or false; found 2"),
    ("train encoder.patch_size=0", 1, "encoder.patch_size: expected an integer >= 1", "found 0"),
    ("train encoder.width=1000000000", 1, "encoder.width: expected", "<= 65536"),
    ("train encoder.layers=all", 1, "encoder.layers: expected a list", "found 'all'"),
    ("train encoder.depth=4.0", 1, "encoder.depth: expected an integer", "found 4.0"),
    ("train encoder.mask_input=some", 1, "encoder.mask_input: expected true or false"),
    (
        "train recalibration.k=0",
        1,
        "recalibration.k: expected an integer >= 1 or a number > 0 and < 1; found 0",
    ),
    ("train bounds.samples=100000", 1, "bounds.samples: expected", "<= 4096"),
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
    ("train callbacks.last.minutes=0", 1, "callbacks.last.minutes: expected", "found 0"),
    ("train callbacks.pictures.token=[1]", 1, "callbacks.pictures.token: expected a list of 3 values"),
    (
        "predict checkpoint=x turntable.frames=-1",
        1,
        "turntable.frames: expected an integer >= 0 and <= 2000; found -1",
    ),
    ("predict checkpoint=x subject=1.5", 1, "subject: expected a text or an integer", "found 1.5"),
    ("predict checkpoint=5", 1, "checkpoint: expected a path or null; found 5"),
    ("import out=x dtype=float8", 1, "dtype: expected one of float32, bfloat16, float16; found 'float8'"),
    ("table runs={tmp} test.alpha=2", 1, "test.alpha: expected", "< 1", "found 2"),
    ("table runs={tmp} evaluation.views=four", 1, "evaluation.views: expected", "found 'four'"),
    ("table runs={tmp} reported=maybe", 1, "reported: expected true or false; found 'maybe'"),
    ("table runs={tmp} columns=[psnr,psnr]", 1, "columns: expected different values; found ['psnr', 'psnr']"),
    ("table runs={tmp} evaluation.views=[4,4]", 1, "evaluation.views: expected different values", "[4, 4]"),
    ("table runs={tmp} evaluation.targets=[a,a]", 1, "evaluation.targets: expected different values"),
    ("table runs={tmp} by=[seed,seed]", 1, "by: expected different values"),
    ("prepare task=check data=scans data.root={loop}", 1, "{loop}: expected", "links in a loop"),
    ("table runs={loop}", 1, "{loop}: expected", "links in a loop"),
    ("predict images={empty} cameras={loop}", 1, "{loop}: expected"),
    ("predict out={loop} images={empty} cameras={text}", 1, "{loop}: expected"),
    ("export checkpoint=shipped inference={loop}", 1, "{loop}: expected"),
    (
        "export checkpoint={ckpt} inference=/dev/full",
        1,
        "/dev/full: expected a file to write; found 'a device",
    ),
    ("export checkpoint={ckpt} inference={ckpt}", 1, "inference: expected a file of its own"),
    ("export checkpoint={ckpt} vggt=a.pt release=a.pt", 1, "release: expected a file of its own"),
    ("export checkpoint={ckpt} inference={text}", 1, "inference: expected a path where there is no file"),
    ("import vggt={text} compat=none out={text}", 1, "out: expected a file of its own"),
    ("import vggt={ckpt} compat=none out={text}", 1, "out: expected a path where there is no file"),
    ("adapt cameras={text} out={text}", 1, "out: expected a path where there is no file"),
    ("doctor seed=" + "9" * 400, 1, "seed: expected an integer >= 0"),
    ("doctor seed=" + "9" * 5000, 1, "expected overrides"),
    ("doctor seed=1e999", 1, "seed: expected an integer >= 0", "found inf"),
    ("table runs={tmp} columns=[1]", 1, "columns: expected", "found [1]"),
    ("train -m seed=1,x", 1, "seed: expected an integer", "found 'x'"),
    ("train -m seed=1,2 data.batch_size=0", 1, "data.batch_size: expected", "found 0"),
    ("train sweep=table2 dry_run=true encoder.width=0", 1, "encoder.width: expected", "found 0"),
    ("train hydra.mode=all", 1, "hydra.mode=all: expected", "RUN", "MULTIRUN"),
]

NAMES = [
    ("train recalibration.similarity=cosine", 1, "recalibration.similarity: expected one of", "'cosine'"),
    ("train depth_head.parameterization=sqrt", 1, "depth_head.parameterization: expected one of", "'sqrt'"),
    ("train depth_head.parameterization=inverse_linear", 1, "expected", "found"),
    ("train bounds=none", 1, "bounds: expected", "found"),
    ("train model.pad=all", 1, "model.pad: expected one of none, multiple; found 'all'"),
    ("train encoder.vit.kind=resnet", 1, "encoder.vit.kind: expected one of", "'resnet'"),
    ("train encoder.trainable=some", 1, "encoder.trainable: expected all, none or last_<n>", "'some'"),
    ("train renderer.backend=opengl", 1, "renderer.backend: expected one of", "'opengl'"),
    ("train +loss.weights.lpips=1", 1, "loss.weights key: expected one of", "'lpips'"),
    ("train views.training=odd", 1, "views.training: expected one of any, even, uneven; found 'odd'"),
    ("train targets.kind=other", 1, "targets.kind: expected one of", "'other'"),
    ("train targets.view=9", 1, "targets.view: expected one of", "found 9"),
    ("train trainer.precision=8", 1, "trainer.precision: expected", "found 8"),
    ("train trainer.accelerator=abacus", 1, "trainer", "abacus"),
    ("train data.kind=os.system", 1, "data.kind: expected one of humman", "'os.system'"),
    ("train renderer.kind=7", 1, "renderer.kind: expected splats; found 7"),
    ("evaluate data=synthetic baselines=[white]", 1, "baselines: expected one of black", "'white'"),
    ("evaluate data=synthetic baselines=all device=tpu", 1, "device: expected one of auto", "'tpu'"),
    ("evaluate checkpoint={ckpt} data=synthetic precision=int8", 1, "precision: expected one of", "'int8'"),
    ("predict checkpoint={ckpt} data=synthetic device=gpu", 1, "device: expected one of auto", "'gpu'"),
    ("prepare task=paint", 1, "task: expected one of render, check; found 'paint'"),
    ("table runs={tmp} layout=table9", 1, "layout: expected one of ablation", "found 'table9'"),
    ("table runs={tmp} test.against=worst", 1, "test.against: expected one of", "'worst'"),
    ("table runs={tmp} test.unit=x", 1, "test.unit: expected a regular expression with a group"),
    ("table runs={tmp} 'test.unit=\"(\"'", 1, "test.unit: expected a regular expression"),
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
    ("export checkpoint={ckpt} vggt=/dev/null/x.pt", 1, "/dev/null/x.pt: expected a file", "Not a directory"),
    ("export checkpoint={ckpt} vggt=/proc/x.pt", 1, "/proc/x.pt: expected a file"),
    ("export checkpoint={ckpt} vggt={empty}", 1, "{empty}: expected", "a directory"),
    ("train -m seed=1,2 hydra.sweep.dir=/dev/null/s", 1, "/dev/null/s/", "Not a directory"),
]

# Values without end would run until somebody kills them, or take all memory. Command, key and limit:
_LIMITS = """
predict images=a cameras=b size 2072
train skip.margin 8192
predict images=a cameras=b refine 10000
predict images=a cameras=b refine_cameras 100
predict images=a cameras=b refine_masks 64
predict images=a cameras=b turntable.frames 2000
predict images=a cameras=b turntable.fps 1000
evaluate data=synthetic baselines=per_scene per_scene.steps 100000
benchmark data=synthetic timing.repeats 1000
benchmark data=synthetic threads 1024
train model=recurrent rounds.count 32
train model=recurrent rounds.depths 4096
train depth_head=stereo depth_head.updates 64
train trainer.devices 64
train data.batch_size 1024
train data.workers 1024
train augmentation.exposure 16
train augmentation.mask_offset 64
train callbacks.last.minutes 1000000
prepare data.render.samples 16
prepare data.render_workers 1024
adapt cameras=a minutes 1440
stress workers 1024
"""
ENDLESS = [
    (f"{command} {key}=1000000000", 1, f"{key}: expected", f"<= {limit}")
    for command, key, limit in (line.rsplit(maxsplit=2) for line in _LIMITS.split("\n")[1:-1])
] + [
    ("train model=recurrent 'rounds.training_counts=[1000000000]'", 1, "rounds.training_counts", "<= 32"),
    ("train 'token_budgets=[1000000000]'", 1, "token_budgets: expected", "<= 8192"),
    ("train 'trainer.max_time=\"99999999999:0:0:0\"'", 1, "trainer.max_time: expected days:hours"),
    ("train 'trainer.max_time={{hours: 1e300}}'", 1, "trainer.max_time: expected days:hours"),
]

# What is checked before any photograph is rendered, and what would destroy a run.
EARLY = [
    ("train evaluation.targets=[relase]", 1, "evaluation.targets: expected one of", "did you mean release?"),
    ("train evaluation.split=foo", 1, "evaluation.split: expected", "'foo'"),
    ("train data.size=150", 1, "data.size: expected", "150"),
    ("train encoder.trainable=none", 1, "init_from", "ghgs import"),
    ("train hydra.run.dir={broken}/run", 1, "{broken}/run", "found metrics.json", "hydra.run.dir"),
    ("evaluate checkpoint={ckpt} data=synthetic device=cuda", 1, "device: expected", "cuda"),
]

ROWS = [*USAGE, *MISSING, *NAMES, *FOREIGN, *SYSTEM, *MISSPELT, *NUMBERS, *ENDLESS, *EARLY]
