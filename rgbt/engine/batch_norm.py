"""Batch normalisation of a run with several processes: over the whole batch, or over its parts."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn.modules.batchnorm import _BatchNorm

from rgbt.checks import InputError
from rgbt.processes import computed_once, num_processes, total

TORCH_LAYERS = (nn.BatchNorm1d, nn.BatchNorm2d, nn.BatchNorm3d)


def check_batch_norm_parts(parts: int, processes: int) -> None:
    """Refuse parts of a batch that this number of processes does not make."""
    if parts not in (1, processes):
        raise InputError(f"trainer.batch_norm_parts={parts}: expected 1 or {processes} (devices).")


def synchronise_batch_norm(model: nn.Module) -> nn.Module:
    """Let every batch normalisation read the batch of all processes; nothing with one process.

    The state keeps its keys; the model is changed in place, unless it is itself a normalisation.
    """
    if num_processes() == 1:
        return model
    known = (*TORCH_LAYERS, nn.SyncBatchNorm, SynchronisedBatchNorm)
    for name, module in model.named_modules():
        if isinstance(module, _BatchNorm) and type(module) not in known:
            said = f"model: several devices cannot synchronise '{name}' ({type(module).__name__})"
            raise InputError(f"{said}; set trainer.batch_norm_parts={num_processes()}.")
    if any(parameter.is_cuda for parameter in model.parameters()):
        on_cuda: nn.Module = nn.SyncBatchNorm.convert_sync_batchnorm(model)  # type: ignore[no-untyped-call]
        return on_cuda
    return _converted(model)


def _converted(module: nn.Module) -> nn.Module:
    """Replace every batch normalisation of torch in `module`, keeping its tensors."""
    if isinstance(module, TORCH_LAYERS):
        made = SynchronisedBatchNorm(module.num_features)
        made.__dict__ |= module.__dict__
        return made
    for name, child in module.named_children():
        module.add_module(name, _converted(child))
    return module


def share_running_statistics(model: nn.Module) -> None:
    """Give every process the running statistics of process 0; called by all."""
    buffers: list[Tensor] = []
    for module in model.modules():
        if isinstance(module, _BatchNorm):
            buffers += module.buffers(recurse=False)
    first = computed_once(lambda: [buffer.cpu() for buffer in buffers])
    for buffer, value in zip(buffers, first, strict=True):
        buffer.copy_(value)


class SynchronisedBatchNorm(_BatchNorm):
    """Normalises over the samples of all processes, as many each; torch has one for CUDA.

    The variance is computed from differences to the mean, so that the result equals that of one
    process to rounding.
    """

    def forward(self, input: Tensor) -> Tensor:  # noqa: A002 - the name in torch
        """Normalise (N, C, ...), in float32 for half precision too; same shape and dtype."""
        if not self.training:
            return super().forward(input)
        x = input.to(torch.promote_types(input.dtype, torch.float32))
        dims = (0, *range(2, x.dim()))
        by_channel = (1, -1, *(1 for _ in dims[1:]))
        count = x.numel() // x.shape[1] * num_processes()
        mean = total(x.sum(dims)) / count
        centred = x - mean.view(by_channel)
        variance = total(centred.square().sum(dims)) / count
        if self.track_running_stats:
            self._track(mean.detach(), variance.detach() * (count / (count - 1)))
        normed = centred * (variance + self.eps).rsqrt().view(by_channel)
        if self.affine:
            normed = normed * self.weight.view(by_channel) + self.bias.view(by_channel)
        return normed.to(input.dtype)

    @torch.no_grad()
    def _track(self, mean: Tensor, unbiased_variance: Tensor) -> None:
        tracked, number = (self.running_mean, self.running_var), self.num_batches_tracked
        assert number is not None, "running statistics are tracked"
        number.add_(1)
        share = 1.0 / float(number) if self.momentum is None else self.momentum
        for running, new in zip(tracked, (mean, unbiased_variance), strict=True):
            assert running is not None, "running statistics are tracked"
            running.mul_(1 - share).add_(new, alpha=share)

    def _check_input_dim(self, input: Tensor) -> None:  # noqa: A002 - the name in torch
        """Accept any number of dimensions."""
