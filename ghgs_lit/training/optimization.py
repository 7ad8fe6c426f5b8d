"""How the weights are trained: AdamW or Muon, a linear schedule over the run's budget, gradient clipping."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import lightning.pytorch as L
import torch
from lightning.pytorch.strategies import DeepSpeedStrategy, FSDPStrategy, ModelParallelStrategy
from torch import nn

from ghgs_lit.errors import require
from ghgs_lit.training.muon import Muon


@dataclass(frozen=True)
class Optimization:
    """AdamW or Muon, whose learning rate rises linearly to ``lr`` and then falls linearly.

    The schedule depends on the share of the run's budget that is used: of steps or of time, whichever is
    larger.

    Args:
        lr: highest learning rate.
        matrix_lr: highest learning rate of matrices, which then take the steps of
            :class:`~ghgs_lit.training.muon.Muon`; None: AdamW for all parameters.
        betas, eps, weight_decay: of AdamW.
        warmup: share of the run in which the learning rate rises.
        start_factor, end_factor: first and last learning rate as fractions of ``lr``.
        clip: maximum norm of the gradient.
        freeze_until: prefix of parameter names to the share of the run in which these parameters stay
            unchanged. Splats whose depth is still wrong reduce the loss most by becoming transparent, and
            do not recover from that.
        skip_nonfinite: steps in a row whose loss or gradient is not finite that are skipped before the run
            stops; 0: it stops at the first.

    Raises:
        InputError: a value that cannot work (names its key).
    """

    lr: float
    matrix_lr: float | None = None
    betas: Sequence[float] = (0.9, 0.999)
    eps: float = 1e-8
    weight_decay: float = 1e-5
    warmup: float = 0.01
    start_factor: float = 0.04
    end_factor: float = 0.0
    clip: float = 1.0
    freeze_until: Mapping[str, float] = field(default_factory=dict)
    skip_nonfinite: int = 0

    def __post_init__(self):
        require(self.lr > 0, "optimizer.lr", "a positive number", self.lr)
        positive = self.matrix_lr is None or self.matrix_lr > 0
        require(positive, "optimizer.matrix_lr", "a positive number or null", self.matrix_lr)
        betas_fit = len(self.betas) == 2 and all(0 <= beta < 1 for beta in self.betas)
        require(betas_fit, "optimizer.betas", "two numbers in [0, 1)", list(self.betas))
        require(self.eps > 0, "optimizer.eps", "a positive number", self.eps)
        require(self.weight_decay >= 0, "optimizer.weight_decay", "a number of at least 0", self.weight_decay)
        require(0 <= self.warmup < 1, "optimizer.warmup", "a share in [0, 1)", self.warmup)
        for name in ("start_factor", "end_factor"):
            value = getattr(self, name)
            require(0 <= value <= 1, f"optimizer.{name}", "a share in [0, 1]", value)
        require(self.clip > 0, "optimizer.clip", "a positive gradient norm", self.clip)
        require(self.skip_nonfinite >= 0, "optimizer.skip_nonfinite", "0 or more steps", self.skip_nonfinite)
        for prefix, share in self.freeze_until.items():
            require(0 <= share <= 1, f"optimizer.freeze_until.{prefix}", "a share in [0, 1]", share)

    def build(self, model: nn.Module, fused: bool = True) -> torch.optim.AdamW:
        """The optimizer of the parameters of ``model`` that are trained.

        Args:
            model: its parameters.
            fused: PyTorch's fastest AdamW. It undoes the scaling of a loss (``16-mixed``) inside its step,
                where gradients cannot be clipped any more.

        Raises:
            InputError: ``freeze_until`` names no parameter.
        """
        names = [name for name, _ in model.named_parameters()]
        for prefix in self.freeze_until:
            known = any(name.startswith(prefix) for name in names)
            require(known, f"optimizer.freeze_until.{prefix}", "the beginning of a parameter's name", prefix)
        parameters = [p for p in model.parameters() if p.requires_grad]
        options = {
            "lr": self.lr,
            "betas": tuple(self.betas),
            "eps": self.eps,
            "weight_decay": self.weight_decay,
            "fused": fused,
        }
        if self.matrix_lr is None:
            return torch.optim.AdamW(parameters, **options)
        return Muon(parameters, matrix_lr=self.matrix_lr, **options)

    def drop_frozen_gradients(self, model: nn.Module, progress: float) -> None:
        """Remove the gradients of the parameters that are frozen at the share ``progress`` of the run.

        The optimizer then leaves these parameters unchanged, without weight decay.
        """
        frozen = tuple(prefix for prefix, share in self.freeze_until.items() if progress < share)
        if not frozen:
            return
        for name, parameter in model.named_parameters():
            if name.startswith(frozen):
                parameter.grad = None

    def factor(self, progress: float) -> float:
        """Learning rate as a fraction of ``lr`` when the share ``progress`` of the budget is used."""
        if progress < self.warmup:
            return self.start_factor + (1 - self.start_factor) * progress / self.warmup
        fall = (progress - self.warmup) / (1 - self.warmup)
        return 1 + (self.end_factor - 1) * min(fall, 1.0)


def require_whole_parameters(trainer: L.Trainer) -> None:
    """Refuse strategies that divide parameters among processes: each would clip by the norm of its shard.

    Raises:
        InputError: such a strategy is configured.
    """
    sharded = isinstance(trainer.strategy, (FSDPStrategy, ModelParallelStrategy, DeepSpeedStrategy))
    expected = "auto or a kind of ddp, whose processes have all parameters to clip the gradient by"
    require(not sharded, "trainer.strategy", expected, type(trainer.strategy).__name__)
