from types import SimpleNamespace

import torch

from darswin.train.runs import RunCheckpoint


def test_a_moved_run_keeps_its_best(tmp_path):
    before, after = tmp_path / "before", tmp_path / "after"
    first = RunCheckpoint(before, filename="best", monitor="val/top1", mode="max")
    first.best_model_score = first.current_score = torch.tensor(0.9)
    first.best_model_path = first.kth_best_model_path = str(before / "best.ckpt")
    first.best_k_models = {str(before / "best.ckpt"): torch.tensor(0.9)}
    moved = RunCheckpoint(after, filename="best", monitor="val/top1", mode="max")
    moved.load_state_dict(first.state_dict())
    assert moved.best_model_score == 0.9 and moved.best_model_path == str(after / "best.ckpt")
    assert list(moved.best_k_models) == [str(after / "best.ckpt")]
    assert not moved.check_monitor_top_k(SimpleNamespace(strategy=Agrees()), torch.tensor(0.5))


class Agrees:
    def reduce_boolean_decision(self, decision, all=True):
        return decision


def test_an_epoch_s_last_step_waits_for_its_validation(tmp_path, monkeypatch):
    saved = []
    monkeypatch.setattr(
        "lightning.pytorch.callbacks.ModelCheckpoint.on_train_batch_end",
        lambda self, trainer, *rest: saved.append(trainer.is_last_batch),
    )
    checkpoint = RunCheckpoint(tmp_path, every_n_train_steps=1)
    for last in (False, True, False):
        trainer = SimpleNamespace(is_last_batch=last, accumulate_grad_batches=1)
        checkpoint.on_train_batch_end(trainer, None, None, None, 0)
    assert saved == [False, False]
