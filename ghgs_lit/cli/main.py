"""``ghgs <verb> [overrides]``: every verb is a Hydra application over ``conf/<verb>.yaml``."""

import importlib
import importlib.metadata
import keyword
import os
import re
import shutil
import signal
import sys
import time
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from omegaconf import DictConfig

from ghgs_lit.cli.messages import (
    BAD_INPUT,
    BadUsage,
    check_deletions,
    flags_first,
    one_line,
    raised_by_hydra,
    takes_value,
)
from ghgs_lit.config import check_groups, conf_dir, resolve
from ghgs_lit.config.options import did_you_mean
from ghgs_lit.kernels.allocation import keep_freed_memory
from ghgs_lit.runs.job import register_resolvers
from ghgs_lit.runs.signals import Interrupted, interruptible

register_resolvers()  # on import, so that the processes of a launcher have them too

# verb: (what it does, an example)
VERBS = {
    "prepare": (
        "render scans into training data, or make the built-in people",
        "ghgs prepare task=render data=scans data.source=scans data.root=rendered",
    ),
    "train": (
        "train a model (model=hull; the paper's method: model=paper) and evaluate it",
        "ghgs train model=hull data=synthetic trainer.max_time=00:00:10:00",
    ),
    "pretext": (
        "train the semantic branch of an encoder on the parts of built-in people",
        "ghgs pretext data=synthetic data/rig=varied trainer.max_time=00:00:15:00",
    ),
    "adapt": (
        "train the weights of the package further for your own cameras, in minutes",
        "ghgs adapt cameras=cameras.json images=photographs masks=masks out=mine.ckpt",
    ),
    "evaluate": (
        "measure a checkpoint or the baselines",
        "ghgs evaluate checkpoint=runs/train/.../checkpoints/last.ckpt",
    ),
    "predict": (
        "turn photographs into a splat, pictures and a page",
        "ghgs predict checkpoint=last.ckpt images=photographs cameras=cameras.json masks=masks out=splat",
    ),
    "doctor": (
        "find out whether cameras and masks fit together, a configuration this machine, a GPU the CPU",
        "ghgs doctor task=cameras images=photographs cameras=cameras.json masks=masks",
    ),
    "view": (
        "a page in the browser to look around in a prediction",
        "ghgs view path=runs/predict/...",
    ),
    "import": (
        "published weights to a checkpoint",
        "ghgs import vggt=facebook/VGGT-1B release=release.pth out=release.ckpt",
    ),
    "export": (
        "a checkpoint to a small one for prediction, or to the published names",
        "ghgs export checkpoint=checkpoints/last.ckpt inference=small.ckpt",
    ),
    "benchmark": (
        "run time against error of the presets of skip, by stage",
        "ghgs benchmark checkpoint=runs/train/.../checkpoints/last.ckpt presets=[none,exact,balanced]",
    ),
    "stress": ("every stage on adversarial inputs, against float64", "ghgs stress quick=true"),
    "table": ("collect a sweep into the paper's table", "ghgs table runs=runs/train/sweep_..."),
}


def module_of(verb: str) -> str:
    """The module of a verb; a keyword of Python gets an underscore."""
    return f"ghgs_lit.cli.{verb}" + "_" * keyword.iskeyword(verb)


def usage() -> str:
    """The text of ``ghgs --help``."""
    lines = ["usage: ghgs <verb> [key=value ...] [group=option ...] [-m]", ""]
    for verb, (summary, example) in VERBS.items():
        lines += [f"  {verb:<10}{summary}", f"  {'':<10}  {example}"]
    lines += [
        "",
        "ghgs <verb> --help lists the groups and keys of a verb; ghgs --version prints the version.",
    ]
    return "\n".join(lines)


def discard_unused(directory: Path, verb: str, since: float) -> None:
    """Remove a run's directory that holds only how the run began, all of it written after ``since``."""
    begun = {".hydra", ".lock", "config.yaml", "sessions.jsonl", f"{verb}.log"}
    paths = [] if directory == Path.cwd() else list(directory.glob("*"))
    if paths and all(path.name in begun and path.stat().st_mtime >= since for path in paths):
        shutil.rmtree(directory, ignore_errors=True)


@dataclass(frozen=True)
class Verb:
    """The function of one verb that Hydra calls, here or in the processes of a launcher."""

    name: str
    argv: tuple[str, ...]
    wants_trace: bool = False
    started: float = field(default_factory=time.time)

    def __call__(self, cfg: DictConfig) -> object:
        # Lightning starts the other processes of a DDP job by running sys.argv again, which needs the verb.
        sys.argv = list(self.argv)
        try:
            # Before the verb's module is imported, which takes seconds.
            resolve(cfg, self.name)
            check_groups(self.name, cfg)
            return importlib.import_module(module_of(self.name)).run(cfg)
        except BAD_INPUT as error:
            # In a sweep Hydra prints the error with the number of its job; elsewhere one line is enough.
            if HydraConfig.get().mode == RunMode.MULTIRUN:
                raise
            discard_unused(Path(HydraConfig.get().runtime.output_dir), self.name, self.started)
            if self.wants_trace:
                raise
            print(f"ghgs {self.name}: {one_line(error, self.name)}", file=sys.stderr)
            raise SystemExit(1) from error


def _completion_argv(argv: list[str]) -> list[str] | None:
    """Arguments of a shell-completion call (``ghgs -sc ...``) for the verb on the shell's line.

    Hydra completes that line without the verb. While the verb itself is being typed, the verbs are printed
    and None is returned.
    """
    if "query" not in argv[2]:
        return [argv[0], "train", *argv[1:]]
    line = os.environ.get("COMP_LINE", "")
    words = line.split()
    if len(words) < 2 or words[1] not in VERBS:
        print(" ".join(VERBS))
        return None
    os.environ["COMP_LINE"] = line.replace(f" {words[1]}", "", 1)
    return [argv[0], words[1], *argv[1:]]


def _for_hydra(verb: str, arguments: list[str]) -> list[str]:
    """Arguments in Hydra's terms.

    ``table sweep=<directory>`` is the key ``runs``: to Hydra ``sweep`` is a group. Where the data is that of
    a checkpoint, which Hydra does not know, its keys are forced.
    """
    if verb == "table":
        return [re.sub("^sweep=", "runs=", argument) for argument in arguments]
    has_data = any(argument.startswith("data=") for argument in arguments)
    if verb in ("evaluate", "predict", "view") and not has_data:
        return [re.sub(r"^data\.", "++data.", argument) for argument in arguments]
    return arguments


def _help(verb: str, arguments: list[str]) -> int:
    """``ghgs <verb> --help [group]``; of other arguments only ``--config-dir`` has a say."""
    from ghgs_lit.cli.help import print_group, print_verb

    words = flags_first(arguments)
    folders = [Path(folder) for flag, folder in pairwise(words) if flag in ("-cd", "--config-dir")]
    values = {word for flag, word in pairwise(words) if takes_value(flag)}
    groups = [word for word in words if not word.startswith("-") and "=" not in word and word not in values]
    for group in groups:
        print_group(verb, group, folders)
    if not groups:
        print_verb(verb, *VERBS[verb], folders)
    return 0


def _run(verb: str, argv: list[str]) -> int:
    # With this variable Hydra raises errors, which are handled below, instead of printing them.
    wants_trace = os.environ.get("HYDRA_FULL_ERROR") == "1"
    os.environ["HYDRA_FULL_ERROR"] = "1"
    task = Verb(verb, tuple(argv), wants_trace)
    try:
        if "--help" in argv or "-h" in argv:
            return _help(verb, argv[2:])
        sys.argv = [argv[0], *flags_first(_for_hydra(verb, argv[2:]))]
        check_deletions(sys.argv[1:])
        with interruptible():
            hydra.main(version_base="1.3", config_path=str(conf_dir()), config_name=verb)(task)()
        sys.stdout.flush()
    except BrokenPipeError:
        # The reader, such as `head`, has seen enough; Python must not write the rest when it exits.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 128 + signal.SIGPIPE
    except BadUsage as error:
        print(f"ghgs {verb}: {error}", file=sys.stderr)
        return 2
    except Exception as error:
        if wants_trace or not (isinstance(error, BAD_INPUT) or raised_by_hydra(error)):
            raise
        print(f"ghgs {verb}: {one_line(error, verb)}", file=sys.stderr)
        return 1
    except Interrupted as stop:
        if not stop.explained:
            print(f"ghgs {verb}: interrupted ({signal.Signals(stop.number).name})", file=sys.stderr)
        return stop.code
    except KeyboardInterrupt:
        print(f"ghgs {verb}: interrupted", file=sys.stderr)
        return 130
    return 0


def main() -> int:
    """The console script. Exit code 0, 1 for bad input, 2 for bad usage, 130 and 143 when interrupted."""
    argv = list(sys.argv)
    # Schedulers and daemons may close both.
    for name in ("stdout", "stderr"):
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, "w"))  # noqa: SIM115
    # OpenMP threads that spin while they wait slow down other processes on the same cores tenfold.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    keep_freed_memory()
    if len(argv) > 2 and argv[1] in ("-sc", "--shell-completion"):
        completed = _completion_argv(argv)
        return 0 if completed is None else _run(completed[1], completed)
    if len(argv) < 2 or argv[1] in ("-h", "--help", "help"):
        print(usage())
        return 0 if len(argv) > 1 else 2
    if argv[1] == "--version":
        print(importlib.metadata.version("ghgs-lit"))
        return 0
    if argv[1] not in VERBS:
        hint = did_you_mean(argv[1], VERBS)
        print(f"ghgs: expected a verb ({', '.join(VERBS)}); found {argv[1]!r}{hint}", file=sys.stderr)
        return 2
    return _run(argv[1], argv)


if __name__ == "__main__":
    sys.exit(main())
