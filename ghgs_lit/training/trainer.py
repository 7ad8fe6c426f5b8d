"""Lightning's Trainer, and what of it can be told."""

from typing import Annotated, Any, Literal

import lightning.pytorch as L
from lightning.pytorch.strategies import DeepSpeedStrategy, FSDPStrategy, ModelParallelStrategy
from lightning.pytorch.utilities.exceptions import MisconfigurationException
from pydantic import Field

from ghgs_lit.config.describe import Words
from ghgs_lit.config.options import Amount, Count, Index, Options, Share, Text
from ghgs_lit.errors import InputError, require

Duration = Annotated[
    Annotated[str, Field(pattern=r"^\d+(:\d+){3}$")] | dict[str, Amount],
    Words("days:hours:minutes:seconds such as 00:00:10:00"),
]


class TrainerOptions(Options):
    """How long a run trains, on what, and how often it validates and logs."""

    group = "trainer"
    accelerator: Text = "gpu"
    """gpu, cpu or auto."""
    devices: Count | tuple[Index, ...] | Literal[-1, "auto"] = 1
    """Number of processes, or a list of GPUs."""
    strategy: Text = "auto"
    """auto, or for several processes ddp_find_unused_parameters_true."""
    precision: Text | Literal[16, 32, 64] = "32-true"
    """32-true (the paper's), bf16-mixed or 16-mixed."""
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
        """The Trainer, with further ``arguments`` of it.

        Raises:
            InputError: the Trainer refuses its options, or the strategy divides parameters among processes.
        """
        try:
            trainer = L.Trainer(
                **dict(self),
                max_epochs=-1,
                check_val_every_n_epoch=None,  # validations are counted in steps
                num_sanity_val_steps=0,
                enable_model_summary=False,
                use_distributed_sampler=False,  # the data divides its samples among processes itself
                **arguments,
            )
        except (MisconfigurationException, RuntimeError, TypeError, ValueError) as error:
            raise InputError(f"trainer: {error}") from None
        require_whole_parameters(trainer)
        return trainer


def require_whole_parameters(trainer: L.Trainer) -> None:
    """Refuse strategies that divide parameters among processes: each would clip by the norm of its shard.

    Raises:
        InputError: such a strategy is configured.
    """
    sharded = isinstance(trainer.strategy, (FSDPStrategy, ModelParallelStrategy, DeepSpeedStrategy))
    expected = "auto or a kind of ddp, whose processes have all parameters to clip the gradient by"
    require(not sharded, "trainer.strategy", expected, type(trainer.strategy).__name__)
