"""Lightning's Trainer and its options."""

from typing import Annotated, Any, Literal

import lightning.pytorch as L
from lightning.pytorch.utilities.exceptions import MisconfigurationException
from pydantic import Field

from ghgs_lit.config.options import Count, Index, Options, Share, Text, Words
from ghgs_lit.errors import InputError
from ghgs_lit.kernels.precision import round_products

#: Limits that keep every duration in Python's range.
Duration = Annotated[
    Annotated[str, Field(pattern=r"^\d{1,8}(:\d{1,9}){3}$")]
    | dict[str, Annotated[float, Field(ge=0, le=1e8)]],
    Words("days:hours:minutes:seconds such as 00:00:10:00"),
]


class TrainerOptions(Options):
    """Duration and devices of a training, and intervals of validation and logging."""

    group = "trainer"
    accelerator: Text = "gpu"
    """gpu, cpu or auto."""
    devices: Annotated[int, Field(ge=1, le=64)] | tuple[Index, ...] | Literal[-1, "auto"] = 1
    """Number of processes, or a list of GPUs; several are DDP, in which each has all parameters. At most 64,
    as each starts at once on a CPU."""
    precision: Text | Literal[16, 32, 64] = "32-true"
    """32-true (the paper's; convolutions too), tf32, bf16-mixed or 16-mixed; geometry is float32 in each."""
    max_steps: int = Field(200000, ge=-1)
    """Steps of the optimizer (the paper's 200000); -1: no limit."""
    max_time: Duration | None = None
    """days:hours:minutes:seconds; the learning rate follows the budget that ends first; null: no limit."""
    val_check_interval: Count | Annotated[float, Field(gt=0, le=1)] = 5000
    """Steps between two validations."""
    limit_val_batches: Index | Share = 8
    """Batches of each validation; 0: none."""
    log_every_n_steps: Index = 50
    """Steps between two logged values."""
    accumulate_grad_batches: Count = 1
    """Batches of each step."""
    deterministic: bool | Literal["warn"] = False
    """true: only deterministic operations, where PyTorch has them."""

    def build(self, **arguments: Any) -> L.Trainer:
        """The Trainer with further ``arguments``. InputError: it refuses its options."""
        precision = "32-true" if self.precision == "tf32" else self.precision
        round_products(self.precision == "tf32")  # also back, after another run of the process
        alone = self.devices == 1 or (isinstance(self.devices, tuple) and len(self.devices) == 1)
        try:
            return L.Trainer(
                **(dict(self) | {"precision": precision}),
                # Not every parameter has a gradient in every step (ablations, skipped work).
                strategy="auto" if alone else "ddp_find_unused_parameters_true",
                max_epochs=-1,
                check_val_every_n_epoch=None,  # validations are counted in steps
                num_sanity_val_steps=0,
                enable_model_summary=False,
                use_distributed_sampler=False,  # the data module divides samples among processes
                **arguments,
            )
        except (MisconfigurationException, RuntimeError, TypeError, ValueError) as error:
            raise InputError(f"trainer: {error}") from None
