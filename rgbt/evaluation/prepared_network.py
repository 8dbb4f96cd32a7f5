"""One network on its device with a batch of random images, ready to predict; its peak memory."""

from __future__ import annotations

import multiprocessing
from collections.abc import Callable
from contextlib import suppress
from multiprocessing.connection import Connection
from pathlib import Path

import torch
from torch import Tensor, nn

from rgbt.build.session import open_fabric
from rgbt.checks import InputError, RunError, one_line
from rgbt.engine.allocator import keep_memory
from rgbt.engine.evaluate import class_maps
from rgbt.engine.threads import fix_threads
from rgbt.evaluation.profiled_network import ProfiledNetwork
from rgbt.exported.onnx_network import exported_network
from rgbt.randomness import derive, torch_generator
from rgbt.requirements import record_of
from rgbt.runtime.resources import is_out_of_memory
from rgbt.types import Batch

PREDICTION = (
    "A prediction is normalisation, forward pass, resizing of the class scores to the image, and "
    "argmax. Reading of files and transfer to the device are not part of it."
)
STATUS = Path("/proc/self/status")
"""Memory of the process, on Linux."""

PEAK, NOW = "VmHWM", "VmRSS"
"""Lines of `STATUS`: largest and present resident memory."""


class PreparedNetwork:
    """A network with random weights that predicts one batch again and again.

    Attributes:
        network: what it was built from.
        device: where it predicts.
        parameters: number of all parameters.
        trainable: number of those that are trained.

    Raises:
        InputError: the constructor refuses a setting, or the machine does not have the device.
    """

    def __init__(self, network: ProfiledNetwork, batch_size: int) -> None:
        keep_memory()
        fix_threads(network.trainer.threads)
        self.network = network
        self._fabric = open_fabric(network.trainer)
        self.device = self._fabric.device
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(derive(0, "weights"))
            model: nn.Module = network.model.build()
        self._allocated = _allocated(self.device)
        self.parameters = sum(each.numel() for each in model.parameters())
        self.trainable = sum(each.numel() for each in model.parameters() if each.requires_grad)
        # The counter of operations follows gradients otherwise, which a prediction does not have.
        self._model: nn.Module = model.eval().requires_grad_(False).to(self.device)
        self._view = network.view or record_of(model).views[0]
        self._batch = random_batch(batch_size, network.image_hw).to(self.device)

    def predict(self) -> Tensor:
        """(B, H, W) uint8: the class of every pixel; waits until the device has finished.

        Raises:
            InputError: the network cannot predict images of this size.
        """
        try:
            classes = class_maps(self._model, self._batch, self._fabric, self._view)
        except InputError as error:
            raise InputError(f"{self.network.name}: {error}") from error
        except (RuntimeError, ValueError) as error:
            raise self._sentence(error) from error
        if self.device.type == "cuda":
            torch.cuda.synchronize(self.device)
        elif self.device.type == "mps":
            torch.mps.synchronize()
        return classes

    def _sentence(self, error: Exception) -> InputError | RunError:
        if isinstance(error, RunError):
            return error
        name = self.network.name
        size = " x ".join(map(str, self.network.image_hw))
        if is_out_of_memory(error):
            return RunError(
                f"{name}: the memory of {self.device} is exhausted at {size} pixels "
                f"({one_line(error)}). Name fewer networks, or choose a smaller image_hw or "
                "batch_size."
            )
        return InputError(
            f"{name} cannot predict images of {size} pixels ({one_line(error)}). Choose another "
            "image_hw."
        )

    def use_onnx(self) -> None:
        """Predict with onnxruntime from now on.

        Raises:
            InputError: the network cannot be exported.
        """
        name, image_hw = self.network.name, self.network.image_hw
        self._model = exported_network(self._model, self._view, image_hw, name)

    def peak_on_gpu(self) -> int:
        """Bytes on a CUDA device: most that weights, batch and one prediction take together."""
        torch.cuda.reset_peak_memory_stats(self.device)
        self.predict()
        return torch.cuda.max_memory_allocated(self.device) - self._allocated


def random_batch(batch_size: int, image_hw: tuple[int, int]) -> Batch:
    """Images of random values; the speed of a prediction does not depend on them."""
    generator = torch_generator(0, "profile")
    shape = (batch_size, 4, *image_hw)
    images = torch.randint(256, shape, generator=generator, dtype=torch.uint8)
    return Batch(
        rgb=images[:, :3],
        thermal=images[:, 3:],
        label=torch.zeros((batch_size, *image_hw), dtype=torch.uint8),
        name=tuple(f"random {index}" for index in range(batch_size)),
        centre_yx=torch.zeros((batch_size, 2), dtype=torch.int64),
        position=None,
        original_hw=torch.tensor([image_hw] * batch_size),
    )


def peak_on_cpu(network: ProfiledNetwork, batch_size: int) -> int | None:
    """Bytes on the CPU: most that a fresh process needs to build the network and predict twice.

    It is the peak of the resident memory less what the process took before the network was built,
    which is Python with its libraries.

    Returns:
        None where the system does not report the peak: it is read from `STATUS`.

    Raises:
        RunError: the process was ended, which the system does where memory is exhausted.
    """
    if not STATUS.exists():
        return None
    return _in_fresh_process(_measure_peak, network, batch_size)


def _in_fresh_process(
    measure: Callable[[Connection, ProfiledNetwork, int], None],
    network: ProfiledNetwork,
    batch_size: int,
) -> int:
    context = multiprocessing.get_context("spawn")  # a fork has the memory of this process
    receiver, sender = context.Pipe(duplex=False)
    process = context.Process(target=measure, args=(sender, network, batch_size), daemon=True)
    process.start()
    sender.close()
    answer: int | str | None = None
    with suppress(EOFError):  # the process ended without an answer
        answer = receiver.recv()
    process.join()
    if isinstance(answer, str):
        raise InputError(answer)
    if answer is None:
        raise RunError(
            f"{network.name}: the process that measures its memory ended with code "
            f"{process.exitcode}. If memory is exhausted, choose a smaller image_hw or batch_size."
        )
    return answer


def _measure_peak(sender: Connection, network: ProfiledNetwork, batch_size: int) -> None:
    """Runs in the fresh process: sends the bytes, or the message of a mistake."""
    before = _status_bytes(NOW)
    try:
        prepared = PreparedNetwork(network, batch_size)
        for _ in range(2):
            prepared.predict()
    except InputError as error:
        sender.send(str(error))
        return
    sender.send(_status_bytes(PEAK) - before)


def _status_bytes(key: str) -> int:
    lines = dict(line.split(":", 1) for line in STATUS.read_text().splitlines())
    return int(lines[key].split()[0]) * 1024


def _allocated(device: torch.device) -> int:
    return torch.cuda.memory_allocated(device) if device.type == "cuda" else 0
