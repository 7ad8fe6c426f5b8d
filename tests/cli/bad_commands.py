"""Commands that cannot work, by what is wrong with them.

A row is a command, its exit code, and parts of its line: the path or key, what was expected, what
was found. ``{tmp}`` is the folder of the test; the files in braces are made by the fixture
``files`` of ``test_bad_commands``.
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
    ("train --config-dir {yaml} views=cut", 1, "{yaml}/views/cut.yaml, line 3: expected YAML of plain data"),
    ("train --config-dir {yaml} views=tagged", 1, "{yaml}/views/tagged.yaml, line 1: expected YAML of plain"),
    ("predict images=a cameras=b out={loop}/x", 1, "{loop}/x", "found Too many levels of symbolic"),
    ("train +bounds._target_=os.system", 1, "bounds key: expected one of", "found '_target_'"),
    ("train --config-dir {yaml} bounds=calls", 1, "bounds key: expected one of", "found '_target_'"),
    ("train resume={loop}/x", 1, "{loop}/x: expected a path; found links in a loop"),
    ("train --config-name trian", 1, "--config-name", "'trian'"),
    ("train seed", 1, "seed: expected key=value or group=option; found no =\n"),
    ("train seed=1,2", 1, "seed: expected one value, a list ([1,2]), or -m for a run of each; found 1,2\n"),
    ("train ablation=full,neither", 1, "ablation: expected one value, ", "or -m for a run of each"),
    ("train -m seed=1, 2", 1, "seed: expected values without a space after the comma; found '1,'"),
    ("train -m seed=1,2 hydra.run.dir=x", 1, "hydra.run.dir: expected hydra.sweep.dir, where a sweep", "'x'"),
    ("train hydra.sweep.dir=x", 1, "hydra.sweep.dir: expected hydra.run.dir, where a single run"),
    ("train 'data.people={{train: 4'", 1, "data.people={{train: 4: expected key=value"),
    ("table runs={tmp} columns=[psnr", 1, "columns=[psnr: expected key=value"),
    ("evaluate checkpoint=epoch=3.ckpt", 1, "checkpoint: expected quotes", "'checkpoint=\"epoch=3.ckpt\"'"),
    ("predict images=照片", 1, "images: expected quotes", "'images=\"照片\"'; found 照片"),
]

MISSPELT = [
    ("train experiment=demo ~evaluation.views", 1, "evaluation.views: expected a value", "~evaluation.views"),
    ("train optimizer.lrr=1", 1, "optimizer.lrr: expected a key", "did you mean optimizer.lr?"),
    ("train rouns=null", 1, "rouns: expected a key", "(did you mean rounds?)"),
    ("train rouns.height=null", 1, "(did you mean rounds.height? model=recurrent has it)\n"),
    ("train data.rot=x", 1, "(did you mean data.root? data=humman or scans or"),
    ("train optimizer.learning_rate=1", 1, "found none of that name\n"),
    ("train lr=1e-3", 1, "lr: expected a key", "did you mean optimizer.lr?"),
    (
        "train experiment=demo callbacks=none callbacks.pictures.subjects=4",
        1,
        "callbacks.pictures.subjects: expected a key",
        "found none of that name (callbacks=default or ema has it)\n",
    ),
    ("train data.root={empty}", 1, "data.root", "(data=humman or scans or thuman2 or thuman2_ghg"),
    ("train rounds.count=2", 1, "found none of that name (model=recurrent has it)\n"),
    ("train hydra.job.env_set.A=b", 1, "; +hydra.job.env_set.A=... adds it"),
    ("train foo=1", 1, "foo: expected a key or group of this verb; found none of that name\n"),
    ("train optimizer.lr.x=3", 1, "optimizer.lr: expected a number > 0; found {{'x': 3}}"),
    ("train gaussian_head.attributes.inwards=0", 1, "(did you mean gaussian_head.attributes.inward?)\n"),
    ("train model=gps recalibration.k=3", 1, "(recalibration=paper or small has it)\n"),
    ("train --cfg job optimizer.lrr=1", 1, "optimizer.lrr: expected a key", "did you mean optimizer.lr?"),
    ("train -m optimizer.lrr=1,2", 1, "optimizer.lrr: expected a key", "did you mean optimizer.lr?"),
    ("train encodr=vggt_nano", 1, "encodr: expected a key or group", "did you mean encoder?"),
    ("evaluate optimizer.lr=1", 1, "optimizer.lr: expected a key or group of this verb"),
    ("export vgt=x.pt", 1, "vgt", "did you mean vggt?"),
    ("table runs={tmp} test.unt=1", 1, "test.unt", "did you mean test.unit?"),
    ("train encoder=vggt_nanoo", 1, "encoder: expected one of vggt_1b", "'vggt_nanoo'", "vggt_nano?"),
    ("train views=4", 1, "views: expected one of ", "v3, v4, v5", "; found 4 (did you mean v4?)\n"),
    ("train -m views=3,4", 1, "views: expected one of ", "; found 3,4 (did you mean v3?)\n"),
    ("train sweep=table5", 1, "sweep: expected one of table1", "found 'table5'"),
    ("train hydra/launcher=jobib", 1, "hydra/launcher: expected one of", "did you mean joblib?"),
    (
        "train hydra/sweeper=optuna_of_a_far_lab",
        1,
        "hydra/sweeper: expected",
        "install 'ghgs-lit[optuna]')",
    ),
    ("train +optimizer.lrr=1", 1, "optimizer", "lrr"),
    ("train +seed=3", 1, "+seed=3: expected", "already at 'seed'"),
    ("train ~sed", 1, "sed: expected a value", "~sed"),
]

MISSING = [
    ("train ~optimizer", 1, "optimizer: expected a value", "~optimizer"),
    ("train ~seed", 1, "seed: expected a value", "~seed"),
    ("train optimizer=null", 1, "optimizer: expected one of ", "; found null\n"),
    ("train 'seed=${{foo}}'", 1, "seed: expected a value that can be resolved", "'foo'"),
    ("train seed=", 1, "seed: expected an integer", "found ''"),
    ("train data=thuman2 model.pad=multiple", 1, "data.root: expected", "found null"),
    ("train data=scans data.root={tmp}/none", 1, "{tmp}/none: expected the folder of the data set"),
    (
        "train data=scans 'data.root={tmp}/${{data.name}}'",
        1,
        "{tmp}/scans: expected the folder",
    ),
    (
        "train data=humman model.pad=multiple data.root={empty} targets=cameras evaluation.targets=[cameras]",
        1,
        "{empty}: expected sequences such as",
    ),
    ("doctor", 1, "images: expected images=<folder", "task=machine or task=selfcheck; found None"),
    ("evaluate", 1, "data: expected data=<option>"),
    ("evaluate data=synthetic", 1, "checkpoint: expected a checkpoint or baselines=[...]; found neither"),
    (
        "evaluate data=synthetic checkpoint=shipped skip=temporal",
        1,
        "skip: expected one of",
        "temporal",
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
]

NUMBERS = [
    ("train optimizer.lr=abc", 1, "optimizer.lr: expected a number > 0; found 'abc'"),
    ("train seed=-1", 1, "seed: expected an integer >= 0", "found -1"),
    ("evaluate seed=null data=synthetic", 1, "seed: expected an integer", "found None"),
    ("train data.batch_size=0", 1, "data.batch_size: expected an integer >= 1 and <= 1024; found 0"),
    ("predict checkpoint=x subject=1.5", 1, "subject: expected a text (in quotes", "found 1.5"),
    ("import out=x dtype=float8", 1, "dtype: expected one of float32, bfloat16, float16; found 'float8'"),
    ("table runs={tmp} test.alpha=2", 1, "test.alpha: expected", "< 1", "found 2"),
    ("table runs={tmp} columns=[psnr,psnr]", 1, "columns: expected different values; found ['psnr', 'psnr']"),
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
    ("train -m seed=1,x", 1, "seed: expected an integer", "found 'x'"),
    ("train -m seed=1,2 data.batch_size=0", 1, "data.batch_size: expected", "found 0"),
    ("train hydra.mode=all", 1, "hydra.mode=all: expected", "RUN", "MULTIRUN"),
]

NAMES = [
    ("train depth_head.parameterization=inverse_linear", 1, "expected", "found"),
    ("train loss.weights.render_l2=1", 1, "loss.weights.render_l2: expected one of", "mean render_l1?"),
    ("train trainer.accelerator=abacus", 1, "trainer", "abacus"),
    ("train data.kind=os.system", 1, "data.kind: expected one of humman", "'os.system'"),
    ("evaluate data=synthetic baselines=[white]", 1, "baselines: expected one of black", "'white'"),
    ("evaluate checkpoint={ckpt} data=synthetic precision=int8", 1, "precision: expected one of", "'int8'"),
    ("prepare task=paint", 1, "task: expected one of render, check; found 'paint'"),
    ("table runs={tmp} test.unit=x", 1, "test.unit: expected a regular expression with a group"),
    ("table runs={tmp} 'test.unit=\"(\"'", 1, "test.unit: expected a regular expression"),
    ("table runs={tmp} 'subjects=\"(\"'", 1, "subjects: expected a regular expression"),
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
    ("export checkpoint={ckpt} release={tmp}/x.pth", 1, "{ckpt}", "expected", "found"),
    ("import out={tmp}/x.ckpt vggt={text} encoder=vggt_nano compat=none", 1, "{text}: expected weights"),
    ("table runs={text}", 1, "{text}: expected a directory of runs; found a file"),
    ("table runs={broken}", 1, "{broken}/run/metrics.json: expected"),
    ("table runs={empty} others={text} layout=table1", 1, "{text}: expected"),
    ("prepare data=thuman2 data.source={empty} data.root={tmp}/o data.split={text}", 1, "{empty}"),
]

SYSTEM = [
    ("train hydra.run.dir=/dev/null/run", 1, "/dev/null/run: expected a path below folders", "found a file"),
    ("train hydra.run.dir={text}/run", 1, "{text}/run: expected", "found a file in its place or above it"),
    (
        "export checkpoint={ckpt} vggt=/dev/null/x.pt",
        1,
        "/dev/null/x.pt: expected a path below folders",
        "found a file",
    ),
    ("export checkpoint={ckpt} vggt={empty}", 1, "{empty}: expected", "a directory"),
    (
        "train -m seed=1,2 hydra.sweep.dir=/dev/null/s",
        1,
        "hydra.sweep.dir: expected a folder that can be written to for the runs; found '/dev/null'\n",
    ),
]

# Values without end would run until somebody kills them, or take all memory.
ENDLESS = [
    ("benchmark data=synthetic timing.repeats=1000000000", 1, "timing.repeats: expected", "<= 1000"),
    ("stress workers=1000000000", 1, "workers: expected", "<= 1024"),
    ("adapt cameras=a minutes=1000000000", 1, "minutes: expected", "<= 1440"),
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
