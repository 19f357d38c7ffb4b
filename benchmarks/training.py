"""Images per second in training and testing, and the share of time outside the model.

Runs `Classification` and `WideAngleData` like `darswin fit`, on a folder of JPEG files, for each of
the four models: with our operators and with their PyTorch reference. Before and after each training
it times bare steps: forward, backward and AdamW, on images that are there. It also measures the
loader.
"""

import argparse
import tempfile
import time
import warnings
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import torch
from kit.candidates import training_step
from kit.machine import machine, num_threads
from kit.record import write
from lightning.pytorch import Callback, Trainer
from peers import training_table
from torch.utils.data import DataLoader
from tqdm import tqdm

from darswin.data.augment import RandAugment, RandomErasing
from darswin.data.order import TrainingOrder
from darswin.data.samples import Draw
from darswin.ops import use_reference
from darswin.train.classification import Classification
from darswin.train.data import WideAngleData
from darswin.utils.malloc import keep_freed_memory

FAMILIES = ("darswin_a", "darswin_ra", "swin", "dat")
WARM_UP = 3  # steps before the measurement
IMAGE_SIZE = 64  # px, of all models


def write_pictures(root: Path, count: int) -> None:
    """Writes two classes of JPEG files of 500×375 pixels, with detail at every scale."""
    rng = np.random.default_rng(0)
    for k in range(count):
        picture = np.zeros((375, 500, 3), np.float32)
        for scale in (4, 16, 64):
            noise = rng.random((scale, scale, 3), dtype=np.float32)
            picture += cv2.resize(noise, (500, 375), interpolation=cv2.INTER_CUBIC) / 3
        folder = root / f"class{k % 2}"
        folder.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(folder / f"{k:04}.jpg"), np.clip(255 * picture, 0, 255).astype(np.uint8))


class Stopwatch(Callback):
    """Measures the time in steps and between steps, after a warm-up."""

    def __init__(self):
        self.inside, self.start, self.end, self.steps = 0.0, 0.0, 0.0, 0

    def on_train_batch_start(self, trainer, pl_module, batch, batch_idx, dataloader_idx=0):
        self.began = time.perf_counter()
        if batch_idx == WARM_UP:
            self.start = self.end

    def on_train_batch_end(self, trainer, pl_module, outputs, batch, batch_idx, dataloader_idx=0):
        self.end = time.perf_counter()
        if batch_idx >= WARM_UP:
            self.inside += self.end - self.began
            self.steps += 1

    on_test_batch_start, on_test_batch_end = on_train_batch_start, on_train_batch_end

    def result(self, batch: int) -> dict[str, float]:
        """Images per second, and the share of the time outside of steps."""
        wall = self.end - self.start
        return dict(images_per_second=self.steps * batch / wall, outside=1 - self.inside / wall)


def run(mode: str, name: str, data: dict, steps: int, reference: bool) -> dict[str, float]:
    """Trains or tests one model for some steps."""
    watch = Stopwatch()
    trainer = Trainer(
        accelerator="cpu", max_epochs=1, limit_train_batches=steps, limit_test_batches=steps,
        limit_val_batches=0, callbacks=[watch], logger=False, enable_checkpointing=False,
        enable_progress_bar=False, enable_model_summary=False, use_distributed_sampler=False,
    )  # fmt: skip
    module = WideAngleData(**data, test_lenses="low")
    with use_reference(reference):
        (trainer.fit if mode == "train" else trainer.test)(Classification(name), datamodule=module)
    return watch.result(data["batch_size"])


def bare_rate(name: str, batch: int, steps: int, reference: bool) -> float:
    """Images per second of training steps alone."""
    step = training_step(name, IMAGE_SIZE, torch.float32, batch, is_reference=reference)
    for _ in range(WARM_UP):
        step()
    start = time.perf_counter()
    for _ in range(steps):
        step()
    return steps * batch / (time.perf_counter() - start)


def loader_rates(data: dict) -> dict[str, float]:
    """Images per second of the loader on one core: in total, and for each part of the work."""
    module = WideAngleData(**data)
    dataset = module.dataset("train", augment=RandAugment(), erase=RandomErasing())
    rng = np.random.default_rng(0)
    image = dataset.shown(Draw(0, 0, 0)).image
    parts = {
        "read and decode": lambda k: dataset.source[k],
        "read, warp and reduce": lambda k: dataset.shown(Draw(0, k, k)),
        "RandAugment": lambda k: RandAugment()(image, rng),
        "all": lambda k: dataset[k],
    }
    rates, cv_threads = {}, cv2.getNumThreads()
    cv2.setNumThreads(1)
    with num_threads(1):
        for part, work in parts.items():
            start, count = time.perf_counter(), len(dataset)
            for k in range(count):
                work(k)
            rates[part] = count / (time.perf_counter() - start)
    cv2.setNumThreads(cv_threads)
    for workers in (1, 2):
        order = TrainingOrder(len(dataset), 16, rank=0, world=1)
        batches = DataLoader(dataset, 16, sampler=order, num_workers=workers, prefetch_factor=4)
        iterator = iter(batches)
        next(iterator)
        start, count = time.perf_counter(), sum(len(b[0]) for b in iterator)
        rates[f"{workers} worker processes"] = count / (time.perf_counter() - start)
    return rates


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--size", default="micro", help="of the models")
    parser.add_argument("--batch", type=int, default=32)
    parser.add_argument("--steps", type=int, default=24, help="timed, of each run")
    parser.add_argument("--quick", action="store_true", help="one model, few steps")
    parser.add_argument("--out", type=Path, help="folder of the record")
    args = parser.parse_args()
    warnings.filterwarnings("ignore")
    keep_freed_memory()  # as `darswin fit` does
    head = machine()
    print(" ".join(f"{k}={v}" for k, v in head.items()))
    families = FAMILIES[:1] if args.quick else FAMILIES
    steps = WARM_UP + (2 if args.quick else args.steps)
    models: dict[str, dict] = {}
    with tempfile.TemporaryDirectory() as folder:
        write_pictures(Path(folder), steps * args.batch * 9 // 4)
        data = dict(path=folder, batch_size=args.batch, holdout=0.1)
        loader = loader_rates(data)
        for part, rate in loader.items():
            print(f"loader, {part}: {rate:.0f} images/s")
        cases = [(f, mode, ref) for f in families for mode in ("train", "test") for ref in (0, 1)]
        for family, mode, reference in tqdm(cases, unit="run"):
            name = f"{family}_{args.size}"
            # Half of the folder is enough for testing.
            given = dict(data, holdout=0.49 if mode == "test" else 0.1)
            alone = partial(bare_rate, name, args.batch, steps - WARM_UP, bool(reference))
            before = alone() if mode == "train" else 0.0
            found = run(mode, name, given, steps, bool(reference))
            if mode == "train":
                found["bare_images_per_second"] = (before + alone()) / 2
            entry = models.setdefault(name, {}).setdefault(mode, {})
            entry["reference" if reference else "darswin"] = found
    print(training_table(models))
    if args.out:
        path = args.out / f"training--{args.size}.json"
        write(path, machine=head, size=args.size, batch=args.batch, models=models, loader=loader)
        print(path)


if __name__ == "__main__":
    main()
