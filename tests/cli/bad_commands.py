"""Invalid commands, grouped by what is wrong with them.

A row is a command, its exit code, and parts of its message: the path or key, what was expected, and what
was found. ``{tmp}`` is the folder of the test; the files in braces are created by the fixture ``files``
of ``test_bad_commands``.
"""

USAGE = [
    ("", 2, "usage: ghgs <verb>"),
    ("trian", 2, "expected a verb", "found 'trian'", "did you mean train?"),
    ("xyz", 2, "expected a verb (train, ", "found 'xyz'"),
    ("--cfg job", 2, "expected a verb", "found '--cfg'"),
    ("train --confg job", 2, "unrecognized arguments: --confg"),
    ("train --cfg everything", 2, "argument --cfg/-c: invalid choice: 'everything'"),
    ("train --config-dir", 2, "--config-dir/-cd: expected one argument"),
    ("train --config-dir {tmp}/none", 1, "{tmp}/none", "not found"),
    (
        "train --config-dir {yaml} views=cut",
        1,
        "{yaml}/views/cut.yaml: expected YAML; found",
        " in line 3, column 1",
    ),
    (
        "train --config-dir {yaml} views=tagged",
        1,
        "{yaml}/views/tagged.yaml: expected YAML; found",
        "getcwd' in line 1,",
    ),
    ("predict images=a cameras=b out={loop}/x", 1, "{loop}/x", "found Too many levels of symbolic"),
    ("train +bounds._target_=os.system", 1, "bounds._target_: expected one of", "found '_target_'"),
    ("train --config-dir {yaml} encoder=calls", 1, "encoder._target_: expected one of", "found '_target_'"),
    ("train resume={loop}/x", 1, "{loop}/x: expected a path; found links in a loop"),
    ("train --config-name trian", 1, "--config-name", "'trian'"),
    ("train seed", 1, "seed: expected key=value or group=option"),
    ("train seed=1,2", 1, "seed: expected key=value", "Ambiguous value for argument 'seed=1,2'"),
    ("train ablation=full,neither", 1, "ablation: expected key=value", "add --multirun"),
    ("train -m seed=1, 2", 1, "seed=1,: expected key=value"),
    ("train -m seed=1,2 hydra.run.dir=x", 1, "hydra.run.dir: expected hydra.sweep.dir, where a sweep", "'x'"),
    ("train hydra.sweep.dir=x", 1, "hydra.sweep.dir: expected hydra.run.dir, where a single run"),
    ("train 'data.people={{train: 4'", 1, "data.people={{train: 4: expected key=value"),
    ("table runs={tmp} columns=[psnr", 1, "columns=[psnr: expected key=value"),
    (
        "evaluate checkpoint=epoch=3.ckpt",
        1,
        "checkpoint=epoch=3.ckpt: expected key",
        "(special characters in quotes: ",
    ),
    ("predict images=照片", 1, "images=照片: expected key=value"),
]

MISSPELT = [
    ("train experiment=demo ~evaluation.views", 1, "evaluation.views: expected a value", "~evaluation.views"),
    ("train optimizer.lrr=1", 1, "optimizer.lrr: expected one of ", "did you mean lr?"),
    ("train rouns=null", 1, "rouns: expected a key", "(did you mean rounds?)"),
    ("train model=recurrent rouns.height=null", 1, "rouns.height: expected", "(did you mean rounds?)\n"),
    ("train data=humman data.rot=x", 1, "data.rot: expected", "(did you mean root?)"),
    ("train optimizer.learning_rate=1", 1, "optimizer.learning_rate: expected one of "),
    ("train lr=1e-3", 1, "lr: expected a key or group of this verb; found none of that name"),
    ("train callbacks=none callbacks.pictures.subjects=4", 1, "callbacks.pictures.subjects: expected a key"),
    ("train data.root={empty}", 1, "data.root: expected one of "),
    ("train rounds.count=2", 1, "rounds.count: expected a key", "found none of that name\n"),
    ("train hydra.job.env_set.A=b", 1, "hydra.job.env_set.A: expected a key"),
    ("train foo=1", 1, "foo: expected a key or group of this verb; found none of that name\n"),
    ("train optimizer.lr.x=3", 1, "optimizer.lr: expected a number > 0; found {{'x': 3}}"),
    (
        "train gaussian_head.attributes.inwards=0",
        1,
        "gaussian_head.attributes.inwards: expected",
        "(did you mean inward?)\n",
    ),
    ("train model=pixel recalibration.k=3", 1, "recalibration.k: expected no keys"),
    ("train --cfg job optimizer.lrr=1", 1, "optimizer.lrr: expected one of ", "did you mean lr?"),
    ("train -m optimizer.lrr=1,2", 1, "optimizer.lrr: expected one of ", "did you mean lr?"),
    ("train encodr=vggt_nano", 1, "encodr: expected a key or group", "did you mean encoder?"),
    ("evaluate optimizer.lr=1", 1, "optimizer.lr: expected a key or group of this verb"),
    ("export inferense=x.pt", 1, "inferense", "did you mean inference?"),
    ("table runs={tmp} colums=1", 1, "colums", "did you mean columns?"),
    ("train encoder=vggt_nanoo", 1, "encoder: expected one of vggt_1b", "'vggt_nanoo'", "vggt_nano?"),
    ("view runs/x", 1, "runs/x: expected key=value"),
    ("train -sc install=bash", 2, "--shell-completion: ghgs has none"),
    ("train views=4", 1, "views: expected one of random, v3, v4, v5; found 4"),
    ("train -m views=3,4", 1, "views: expected one of random, v3, v4, v5; found 3,4"),
    ("train -m skip=exact,balanced views=4", 1, "views: expected one of random, v3, v4, v5; found 4"),
    ("train sweep=table5", 1, "sweep: expected one of table1", "found 'table5'"),
    ("train hydra/launcher=jobib", 1, "hydra/launcher: expected one of", "did you mean joblib?"),
    (
        "train hydra/launcher=joblib_of_a_far_lab",
        1,
        "hydra/launcher: expected one of ",
        "found 'joblib_of_a_far_lab'",
    ),
    ("train +optimizer.lrr=1", 1, "optimizer", "lrr"),
    ("train +sed=3", 1, "sed: expected one of allow_random_encoder"),
    ("train +seed=3", 1, "seed: expected", "already at 'seed'"),
    ("train ~sed", 1, "sed: expected a value", "~sed"),
]

MISSING = [
    ("train ~optimizer", 1, "optimizer: expected a value", "~optimizer"),
    ("train ~seed", 1, "seed: expected a value", "~seed"),
    ("train optimizer=null", 1, "optimizer: expected one of from_scratch, release, short; found null"),
    ("train 'seed=${{foo}}'", 1, "seed: expected a value that can be resolved", "'foo'"),
    ("train seed=", 1, "seed: expected an integer", "found ''"),
    ("train data=thuman2 model.pad=multiple", 1, "data.root: expected", "found null"),
    ("train data=scans data.root={tmp}/none", 1, "{tmp}/none: expected the folder"),
    ("train data=scans 'data.root={tmp}/${{data.name}}'", 1, "{tmp}/scans: expected the folder"),
    (
        "train data=humman model.pad=multiple data.root={empty} targets=cameras evaluation.targets=[cameras]",
        1,
        "{empty}: expected sequences such as",
    ),
    ("doctor", 1, "images: expected images=<folder", "or task=machine; found None"),
    ("evaluate", 1, "data: expected data=<option>"),
    ("evaluate data=synthetic", 1, "checkpoint: expected a checkpoint or baselines=[...]; found neither"),
    ("evaluate data=synthetic checkpoint=shipped skip=temporal", 1, "skip: expected one of", "temporal"),
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
    ("prepare task=check data=thuman2 data.root={tmp}/none", 1, "{tmp}/none: expected the folder"),
    ("prepare data=scans", 1, "data.source: expected", "found null"),
    ("prepare data=scans data.root={tmp}/out data.source={tmp}/none", 1, "{tmp}/none"),
    ("prepare data=thuman2 data.source={empty} data.root={tmp}/out", 1, "{empty}"),
    ("import", 1, "out: expected a value (out=...); found none"),
    ("import out={tmp}/x.ckpt encoder=vggt_nano compat=none", 1, "vggt: expected a file"),
    ("import out={tmp}/x.ckpt vggt={tmp}/none.pt encoder=vggt_nano compat=none", 1, "{tmp}/none.pt"),
    ("export", 1, "checkpoint: expected a value", "found none"),
    ("export checkpoint={ckpt}", 1, "inference: expected a value"),
    ("export checkpoint={tmp}/none.ckpt inference={tmp}/x.pt", 1, "{tmp}/none.ckpt: expected"),
    ("table", 1, "runs: expected a value (runs=...); found none"),
    ("table runs={tmp}/none", 1, "{tmp}/none: expected a directory of runs"),
    ("table runs={empty}", 1, "{empty}: expected runs with a metrics.json"),
    ("table runs=[]", 1, "runs: expected", "found []"),
    ("train resume={tmp}/none.ckpt", 1, "{tmp}/none.ckpt: expected"),
]

NUMBERS = [
    ("train optimizer.lr=abc", 1, "optimizer.lr: expected a number > 0; found 'abc'"),
    ("train seed=-1", 1, "seed: expected an integer >= 0", "found -1"),
    ("evaluate seed=null data=synthetic", 1, "seed: expected an integer", "found None"),
    ("train data.batch_size=0", 1, "data.batch_size: expected an integer >= 1 and <= 1024; found 0"),
    ("predict checkpoint=x subject=1.5", 1, "subject: expected a text (in quotes", "found 1.5"),
    ("import out=x dtype=float8", 1, "dtype: expected one of float32, bfloat16, float16; found 'float8'"),
    ("table runs={tmp} columns=[psnr,psnr]", 1, "columns: expected different values; found ['psnr', 'psnr']"),
    ("table runs={tmp} by=[seed,seed]", 1, "by: expected different values"),
    ("prepare task=check data=scans data.root={loop}", 1, "{loop}: expected", "links in a loop"),
    ("table runs={loop}", 1, "{loop}: expected", "links in a loop"),
    ("train data=scans 'data.root=\"~nobody-here/x\"'", 1, "~nobody-here/x: expected the folder"),
    (
        "predict images={empty} 'cameras=\"~nobody-here/x\"'",
        1,
        "cameras: expected a path, after ~ nothing or",
    ),
    ("predict images={empty} cameras={loop}", 1, "{loop}: expected"),
    ("predict out={loop} images={empty} cameras={text}", 1, "{loop}: expected"),
    ("export checkpoint=shipped inference={loop}", 1, "{loop}: expected"),
    (
        "export checkpoint={ckpt} inference=/dev/full",
        1,
        "/dev/full: expected a file to write; found 'a device",
    ),
    ("export checkpoint={ckpt} inference={ckpt}", 1, "inference: expected a file of its own"),
    ("export checkpoint={ckpt} inference={text}", 1, "inference: expected a path where there is no file"),
    ("import vggt={text} compat=none out={text}", 1, "out: expected a file of its own"),
    ("import vggt={ckpt} compat=none out={text}", 1, "out: expected a path where there is no file"),
    ("adapt cameras={text} out={text}", 1, "out: expected a path where there is no file"),
    ("train seed=" + "9" * 400, 1, "seed: expected an integer >= 0"),
    ("train seed=" + "9" * 5000, 1, ": expected key=value"),
    ("train -m seed=1,x", 1, "seed: expected an integer", "found 'x'"),
    ("train -m seed=1,2 data.batch_size=0", 1, "data.batch_size: expected", "found 0"),
    ("train hydra.mode=all", 1, "hydra.mode=all: expected", "RUN", "MULTIRUN"),
]

NAMES = [
    ("train depth_head.parameterization=inverse_linear", 1, "expected", "found"),
    ("train loss.weights.render_l2=1", 1, "loss.weights.render_l2: expected one of", "mean render_l1?"),
    ("train trainer.accelerator=abacus", 1, "trainer", "abacus"),
    ("train data.kind=os.system", 1, "data.kind: expected one of humman", "'os.system'"),
    ("evaluate data=synthetic baselines=[white]", 1, "baselines: expected one of nearest_view", "'white'"),
    ("evaluate checkpoint={ckpt} data=synthetic precision=int8", 1, "precision: expected one of", "'int8'"),
    ("prepare task=paint", 1, "task: expected one of render, check; found 'paint'"),
]

FOREIGN = [
    ("evaluate checkpoint={text} data=synthetic", 1, "{text}: expected weights"),
    ("evaluate checkpoint={empty} data=synthetic", 1, "{empty}: expected weights", "found a directory"),
    ("evaluate checkpoint={list} data=synthetic", 1, "{list}: expected a checkpoint", "found a list"),
    ("evaluate checkpoint={tensors} data=synthetic", 1, "{tensors}: expected a checkpoint with", "'weight'"),
    ("predict checkpoint={hollow} data=synthetic", 1, "{hollow}", "expected"),
    ("predict checkpoint={newer}", 1, "{newer}: expected format_version 1 to", "newer version"),
    ("train resume={text}", 1, "{text}: expected weights"),
    ("train init_from={tensors}", 1, "{tensors}: expected a checkpoint with"),
    ("train init_from={ckpt} init_strict=true encoder.width=64", 1, "{ckpt}"),
    ("import out={tmp}/x.ckpt vggt={text} encoder=vggt_nano compat=none", 1, "{text}: expected weights"),
    ("table runs={text}", 1, "{text}: expected a directory of runs; found a file"),
    ("table runs={broken}", 1, "{broken}/run/metrics.json: expected"),
    ("prepare data=thuman2 data.source={empty} data.root={tmp}/o data.split={text}", 1, "{empty}"),
]

SYSTEM = [
    (
        "train hydra.run.dir=/dev/null/run",
        1,
        "/dev/null/run: expected a file or folder",
        "found Not a directory",
    ),
    ("train hydra.run.dir={text}/run", 1, "{text}/run: expected a file or folder"),
    (
        "export checkpoint={ckpt} inference=/dev/null/x.pt",
        1,
        "/dev/null/x.pt: expected a file or folder",
        "found Not a directory",
    ),
    ("export checkpoint={ckpt} inference={empty}", 1, "{empty}: expected", "a directory"),
    (
        "train -m seed=1,2 hydra.sweep.dir=/dev/null/s",
        1,
        "hydra.sweep.dir: expected a folder that can be written to for the runs; found '/dev/null'\n",
    ),
]

# Unlimited values would run until killed, or exhaust memory.
ENDLESS = [
    ("benchmark data=synthetic timing.repeats=1000000000", 1, "timing.repeats: expected", "<= 1000"),
    ("adapt cameras=a minutes=1000000000", 1, "minutes: expected", "<= 1440"),
    ("train 'trainer.max_time=\"99999999999:0:0:0\"'", 1, "trainer.max_time: expected days:hours"),
    ("train 'trainer.max_time={{hours: 1e300}}'", 1, "trainer.max_time: expected days:hours"),
]

# Checks before any image is rendered, and protection of existing runs.
EARLY = [
    ("train evaluation.targets=[relase]", 1, "evaluation.targets: expected one of", "did you mean release?"),
    ("train evaluation.split=foo", 1, "evaluation.split: expected", "'foo'"),
    ("train data.size=150", 1, "data.size: expected sides divisible by the patch size 14 (or", "150"),
    (
        "evaluate checkpoint={ckpt} data=synthetic data.size=[140,150] device=cpu",
        1,
        "data.size: expected sides divisible by the patch size 14 (or model.pad=multiple); found [140, 150]",
    ),
    ("train encoder.trainable=none", 1, "init_from", "ghgs import"),
    ("train hydra.run.dir={broken}/run", 1, "{broken}/run", "found metrics.json", "hydra.run.dir"),
    ("evaluate checkpoint={ckpt} data=synthetic device=cuda", 1, "device: expected", "cuda"),
]

ROWS = [*USAGE, *MISSING, *NAMES, *FOREIGN, *SYSTEM, *MISSPELT, *NUMBERS, *ENDLESS, *EARLY]
