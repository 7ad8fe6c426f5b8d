"""``ghgs <verb> [overrides]``: the verbs, and how a command begins and ends.

:mod:`ghgs_lit.cli.application` runs a verb; it is imported where there is one.
"""

import gc
import os
import sys

from ghgs_lit.kernels.allocation import keep_freed_memory

#: What each verb does, and an example.
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


def collect_garbage_again() -> None:
    """Undo that :func:`main` turned the collector off; what was imported so far it leaves alone, at exit too.

    That once in a process: the next call of ``main`` finds objects that may become garbage.
    """
    if not gc.isenabled():
        if not gc.get_freeze_count():
            gc.freeze()
        gc.enable()


def _command(argv: list[str]) -> int:
    if len(argv) > 2 and argv[1] in ("-sc", "--shell-completion"):
        completed = _completion_argv(argv)
        return 0 if completed is None else _run(completed)
    if len(argv) < 2 or argv[1] in ("-h", "--help", "help"):
        print(usage())
        return 0 if len(argv) > 1 else 2
    if argv[1] == "--version":
        from importlib.metadata import version  # here: --help does not need it

        print(version("ghgs-lit"))
        return 0
    if argv[1] not in VERBS:
        from ghgs_lit.config.options import did_you_mean  # here: it loads pydantic

        hint = did_you_mean(argv[1], VERBS)
        print(f"ghgs: expected a verb ({', '.join(VERBS)}); found {argv[1]!r}{hint}", file=sys.stderr)
        return 2
    return _run(argv)


def _run(argv: list[str]) -> int:
    from ghgs_lit.cli.application import run  # here: it loads Hydra

    return run(argv[1], argv)


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
    # Modules are no garbage: looking for some among them takes a third of the start.
    gc.disable()
    try:
        return _command(argv)
    finally:
        collect_garbage_again()


if __name__ == "__main__":
    sys.exit(main())
