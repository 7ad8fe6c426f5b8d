"""``ghgs doctor task=selfcheck``: whether a device computes as the CPU does, in one table."""

from omegaconf import DictConfig

from ghgs_lit.cli.inputs import pick_device
from ghgs_lit.cli.runtime import announce, output_dir
from ghgs_lit.config import resolve
from ghgs_lit.diagnostics.doctor.machine import machine_lines
from ghgs_lit.diagnostics.doctor.selfcheck import FAILED, selfcheck, table
from ghgs_lit.errors import InputError
from ghgs_lit.files import write_text_atomically


def run(cfg: DictConfig) -> None:
    """Print each outcome as soon as it is known; write all, and the machine, to ``selfcheck.md``. InputError:
    a check failed; the exit status says so."""
    config = resolve(cfg)
    device = pick_device(config["device"])
    outcomes = []
    for outcome in selfcheck(config, device):
        outcomes.append(outcome)
        print(f"{outcome.status} {outcome.check}: {outcome.found}", flush=True)
    machine = "\n".join(f"- {name}: {value}" for name, value in machine_lines(device))
    path = output_dir() / "selfcheck.md"
    write_text_atomically(path, f"{machine}\n\n{table(outcomes)}\n")
    announce(path)
    failed = [outcome.check for outcome in outcomes if outcome.status == FAILED]
    if failed:
        raise InputError(f"selfcheck: expected no failed check; found {len(failed)}: {', '.join(failed)}")
