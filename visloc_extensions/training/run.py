"""The training loop."""

from __future__ import annotations

import dataclasses
import json
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Protocol

import torch
from torch import Tensor, nn

from visloc.errors import VislocError, refuse
from visloc_extensions.training.checkpoint import FILE_NAME, State, load_state, save_state
from visloc_extensions.training.distillation import Distillation
from visloc_extensions.training.from_scratch import FromScratch
from visloc_extensions.training.pairs import Sources
from visloc_extensions.training.recorded import RecordedStep
from visloc_extensions.training.settings import Settings
from visloc_extensions.training.validation import Score

LOG_NAME = "log.jsonl"
VALIDATION_NAME = "validation.jsonl"
BEFORE_DECAY_NAME = "before-decay.pt"
_LOG_EVERY_STEPS = 25  # reading a loss makes a GPU wait
# A run without a warm-up is timed over so many steps.
_LEAST_TIMED_STEPS = 2


class LossIsNaN(VislocError):
    """Training has diverged; what the last checkpoint holds is from before."""


def learning_rate(settings: Settings, step: int) -> float:
    """Return Adam's learning rate for a step: up in a line, level, down half a cosine."""
    highest, lowest = settings.learning_rate, settings.final_learning_rate
    if step < settings.warm_up_steps:
        return highest * (step + 1) / (settings.warm_up_steps + 1)
    first = max(settings.decay_from * settings.steps, settings.warm_up_steps)
    if step < first:
        return highest
    share = (step - first) / max(settings.steps - 1 - first, 1)
    return lowest + (highest - lowest) * 0.5 * (1 + math.cos(math.pi * share))


class Task(Protocol):
    """What a network learns in each step.

    Attributes:
        network: what learns, on the device.
    """

    @property
    def network(self) -> nn.Module: ...

    @property
    def names(self) -> tuple[str, ...]: ...

    def numbers(self, step: int) -> Tensor:
        """Draw what decides the step, a vector of float64 on the processor."""

    def losses(self, numbers: Tensor) -> Tensor:
        """Return the losses of a step, one for each name, from its numbers on the device."""


def make_task(settings: Settings, sources: Sources) -> Task:
    """Return what the settings' architecture learns from: a teacher, or nothing but photos."""
    if settings.architecture == "xfeat":
        return Distillation(settings, sources)
    return FromScratch(settings, sources)


class Trainer:
    """A network, its optimizer, and how far they are."""

    def __init__(self, settings: Settings, sources: Sources, described: dict[str, str]) -> None:
        torch.manual_seed(settings.seed)  # of the first weights
        self.settings = settings
        self.sources = sources
        self.described = described
        self.step = 0
        self.seconds = 0.0
        self.task = make_task(settings, sources)
        self.network = self.task.network
        on_gpu = sources.device.type == "cuda"
        if on_gpu:
            for weight in self.network.parameters():
                if weight.dim() == 4:
                    weight.data = weight.data.contiguous(memory_format=torch.channels_last)
        # A recorded step reads the learning rate from the device.
        self._rate = torch.tensor(settings.learning_rate, device=sources.device)
        self.optimizer = torch.optim.Adam(
            self.network.parameters(),
            lr=self._rate if on_gpu else settings.learning_rate,
            weight_decay=settings.weight_decay,
            fused=on_gpu,
            capturable=on_gpu,
        )
        self._learn: Callable[[Tensor], Tensor] = self._learned
        if on_gpu:
            torch.backends.cudnn.benchmark = True
            self._learn = RecordedStep(self._learned)

    def restore(self, state: State) -> None:
        """Go on where a checkpoint stands."""
        different = self.settings.difference_to(state.settings)
        if different is not None:
            raise refuse(
                "training.settings",
                field=different,
                expected=str(getattr(state.settings, different)),
                got=getattr(self.settings, different),
            )
        self.network.load_state_dict(state.network)
        # The options are those of this device.
        options = self.optimizer.state_dict()["param_groups"]
        self.optimizer.load_state_dict({**state.optimizer, "param_groups": options})
        for group in self.optimizer.param_groups:
            group["lr"] = self._rate if self._rate.is_cuda else group["lr"]
        self.step, self.seconds = state.step, state.seconds

    def start_from(self, state: State) -> None:
        """Begin with the weights of another run, at step 0."""
        self.network.load_state_dict(state.network)
        self.described = self.described | {
            "started_from": f"step {state.step} of {json.dumps(state.sources, sort_keys=True)}"
        }

    def state(self) -> State:
        """Return what a checkpoint keeps."""
        return State(
            self.settings,
            self.step,
            self.seconds,
            self.described,
            self.network.state_dict(),
            self.optimizer.state_dict(),
        )

    def advance(self) -> Tensor:
        """Do one step, and return the task's losses before it."""
        rate = learning_rate(self.settings, self.step)
        if self._rate.is_cuda:
            self._rate.fill_(rate)
        else:
            for group in self.optimizer.param_groups:
                group["lr"] = rate
        losses = self._learn(self.task.numbers(self.step))
        self.step += 1
        return losses

    def _learned(self, numbers: Tensor) -> Tensor:
        """Learn what numbers on the device decide: the same operations always."""
        self.optimizer.zero_grad(set_to_none=True)
        losses = self.task.losses(numbers)
        torch.autograd.backward(losses.sum())
        self.optimizer.step()
        return losses.detach()

    def fit(self, seconds: float, since_step: int, steps_took_s: float) -> None:
        """Take fewer steps if the rest would not end within seconds, as some steps took so long."""
        each = steps_took_s / (self.step - since_step)
        steps = self.step + max(1, int(seconds / each))
        self.settings = replace(self.settings, steps=min(self.settings.steps, steps))


def train(
    trainer: Trainer,
    folder: Path,
    *,
    seconds: float | None,
    checkpoint_every_s: float,
    should_stop: Callable[[], bool] = lambda: False,
    validate_every: int | None = None,
    validated: Callable[[State], Score] | None = None,
    fit_seconds: float | None = None,
) -> bool:
    """Do steps until the last one, or the time is over, or it should stop; True when finished.

    The folder gets ``checkpoint.pt``, ``log.jsonl`` with a line per step, ``validation.jsonl`` with
    a line per validation, and ``before-decay.pt``, the state in which the learning rate begins to
    fall: a longer run can start from there.

    Args:
        seconds: after which to stop; None for never.
        checkpoint_every_s: seconds.
        validate_every: steps; needs ``validated``. The last step is validated as well.
        fit_seconds: in which the last step is to be done, from now. The settings get as many steps
            as fit, if those are fewer.
    """
    folder.mkdir(parents=True, exist_ok=True)
    log = _Log(folder / LOG_NAME, trainer.step, trainer.task.names)
    scores = _Scores(folder / VALIDATION_NAME, trainer.step)
    started = saved = time.monotonic()
    stopped = False
    clock = None if fit_seconds is None else _Clock(trainer, log, fit_seconds)
    while trainer.step < trainer.settings.steps and not stopped:
        if clock is not None:
            clock.look()
        settings = trainer.settings
        if trainer.step == round(settings.decay_from * settings.steps) > 0:
            save_state(folder / BEFORE_DECAY_NAME, trainer.state())
        rate = learning_rate(settings, trainer.step)
        began = time.monotonic()
        log.note(trainer.step, rate, trainer.advance(), trainer.seconds)
        # A GPU is waited for where the log reads losses.
        trainer.seconds += time.monotonic() - began
        is_due = validate_every is not None and trainer.step % validate_every == 0
        if validated is not None and (is_due or trainer.step == settings.steps):
            scores.add(trainer.step, validated(trainer.state()))
        now = time.monotonic()
        stopped = should_stop() or (seconds is not None and now - started >= seconds)
        if now - saved >= checkpoint_every_s:
            log.write()
            save_state(folder / FILE_NAME, trainer.state())
            saved = time.monotonic()
    log.write()
    save_state(folder / FILE_NAME, trainer.state())
    return trainer.step == trainer.settings.steps


def resume(trainer: Trainer, folder: Path) -> None:
    """Go on with the run of a folder."""
    trainer.restore(load_state(folder / FILE_NAME, trainer.sources.device))


class _Clock:
    """Times steps while the learning rate rises, two at least; then the trainer takes what fits."""

    def __init__(self, trainer: Trainer, log: _Log, seconds: float) -> None:
        self._trainer, self._log, self._seconds = trainer, log, seconds
        self._started = self._since = time.monotonic()
        self._since_step = trainer.step
        self._until = max(trainer.settings.warm_up_steps, _LEAST_TIMED_STEPS)

    def look(self) -> None:
        """Be told of every step, before it."""
        step = self._trainer.step
        if step == self._until // 2:
            self._log.write()  # waits for the device
            self._since_step, self._since = step, time.monotonic()
        if step == self._until:
            self._log.write()
            now = time.monotonic()
            left = self._seconds - (now - self._started)
            self._trainer.fit(left, self._since_step, now - self._since)


class _Log:
    """Lines of JSON, one per step; those after the checkpoint that a run goes on from are cut."""

    def __init__(self, path: Path, step: int, names: Sequence[str]) -> None:
        self._path, self._names = path, names
        self._waiting: list[tuple[dict[str, Any], Tensor]] = []
        kept = path.read_text(encoding="utf-8").splitlines()[:step] if path.exists() else []
        path.write_text("".join(f"{line}\n" for line in kept), encoding="utf-8")

    def note(self, step: int, rate: float, losses: Tensor, seconds: float) -> None:
        self._waiting.append(
            ({"step": step, "learning_rate": rate, "seconds": round(seconds, 2)}, losses)
        )
        if len(self._waiting) == _LOG_EVERY_STEPS:
            self.write()

    def write(self) -> None:
        if not self._waiting:
            return
        lines = []
        read = torch.stack([losses for _, losses in self._waiting]).tolist()
        for (line, _), losses in zip(self._waiting, read, strict=True):
            line.update({n: round(v, 5) for n, v in zip(self._names, losses, strict=True)})
            line["total"] = round(sum(losses), 5)
            lines.append(json.dumps(line) + "\n")
            if not math.isfinite(line["total"]):
                raise LossIsNaN(
                    "training.diverged",
                    f"the loss is no number at step {line['step']}; try a smaller learning rate",
                )
        with self._path.open("a", encoding="utf-8") as file:
            file.writelines(lines)
        self._waiting.clear()


class _Scores:
    """Lines of JSON, one per validation; those after the checkpoint are cut."""

    def __init__(self, path: Path, step: int) -> None:
        self._path = path
        lines = path.read_text(encoding="utf-8").splitlines() if path.exists() else []
        kept = [line for line in lines if json.loads(line)["step"] <= step]
        path.write_text("".join(f"{line}\n" for line in kept), encoding="utf-8")

    def add(self, step: int, score: Score) -> None:
        with self._path.open("a", encoding="utf-8") as file:
            file.write(json.dumps({"step": step, **dataclasses.asdict(score)}) + "\n")
