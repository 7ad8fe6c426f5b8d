"""Options of Lightning's Trainer, and its construction."""

from typing import Annotated, Any, Literal

import lightning.pytorch as L
from lightning.pytorch.utilities.exceptions import MisconfigurationException
from pydantic import Field

from ghgs_lit.config.options import Count, Index, Options, Share, name_type
from ghgs_lit.errors import InputError
from ghgs_lit.geometry.precision import round_products

#: Durations in Lightning's notation, limited to the range of Python's timedelta.
Duration = Annotated[
    Annotated[str, Field(pattern=r"^\d{1,8}(:\d{1,9}){3}$")]
    | dict[str, Annotated[float, Field(ge=0, le=1e8)]],
    name_type("days:hours:minutes:seconds such as 00:00:10:00"),
]


#: Lightning's other precisions change the dtype of weights (``bf16-true``) or need another library.
Precision = Annotated[
    Literal["32-true", "tf32", "bf16-mixed", "16-mixed", "32", "bf16", "16", 32, 16],
    name_type("32-true, tf32, bf16-mixed or 16-mixed"),
]


class TrainerOptions(Options):
    """Duration and devices of a training, and intervals of validations and logs."""

    group = "trainer"
    accelerator: Literal["gpu", "cpu", "auto", "cuda"] = "gpu"
    """Kind of device: gpu, cpu or auto."""
    devices: Annotated[int, Field(ge=1, le=64)] | tuple[Index, ...] | Literal[-1, "auto"] = 1
    """Number of processes, or a list of GPUs (on a CPU: one process per entry). Several train with DDP, in
    which each holds all parameters. At most 64, as on a CPU all start at once."""
    num_nodes: int = Field(1, ge=1, le=1024)
    """Number of machines, each with the processes of devices; SLURM or torchrun starts them."""
    precision: Precision = "32-true"
    """32-true (the paper's, also for convolutions), tf32, bf16-mixed or 16-mixed; geometry is always
    float32."""
    max_steps: int = Field(200000, ge=-1)
    """Steps of the optimizer (the paper's 200000); -1: no limit."""
    max_time: Duration | None = None
    """Limit of time as days:hours:minutes:seconds; null: no limit. The learning rate follows the budget
    of steps or time, whichever ends first."""
    val_check_interval: Count = 5000
    """Steps of the optimizer between two validations."""
    limit_val_batches: Index | Share = 8
    """Batches of each validation, or their share; 0: no validation."""
    log_every_n_steps: Index = 50
    """Steps between two logged values."""
    accumulate_grad_batches: Count = 1
    """Batches whose gradients each step accumulates."""
    deterministic: bool | Literal["warn"] = False
    """true: use deterministic operations only, and raise where PyTorch has none; warn: warn there."""

    def build(self, **arguments: Any) -> L.Trainer:
        """Build a Trainer that counts validations in steps and has no limit of epochs.

        Args:
            **arguments: further arguments of Lightning's Trainer.

        Raises:
            InputError: Lightning rejects the options."""
        options = dict(self)
        options["val_check_interval"] *= self.accumulate_grad_batches  # Lightning counts batches
        if self.precision == "tf32":
            options["precision"] = "32-true"
        round_products(self.precision == "tf32")  # resets it after another run in the same process
        if self.accelerator == "cpu" and isinstance(self.devices, tuple):
            options["devices"] = len(self.devices)
        alone = self.devices == 1 or (isinstance(self.devices, tuple) and len(self.devices) == 1)
        if not (alone and self.num_nodes == 1):
            # Not every parameter has a gradient in every step (ablations, skipped work).
            options["strategy"] = "ddp_find_unused_parameters_true"
        try:
            return L.Trainer(
                **options,
                max_epochs=-1,
                check_val_every_n_epoch=None,  # validations are counted in steps
                num_sanity_val_steps=0,
                enable_model_summary=False,
                use_distributed_sampler=False,  # the data module divides samples among processes
                **arguments,
            )
        except (MisconfigurationException, RuntimeError, TypeError, ValueError) as error:
            if "No supported gpu backend" in str(error):
                expected = "a GPU, or cpu on a machine without (trainer=cpu)"
                raise InputError(f"trainer.accelerator: expected {expected}; found no GPU") from None
            raise InputError(f"trainer: {error}") from None
