"""The help of `fit`, `validate` and `test`: our options first, then the trainer's that people need.

`--help.all` shows those of Lightning's trainer that are left, too.
"""

import argparse
import textwrap
from collections.abc import Iterable

ALL = "--help.all"
# Options by what argparse calls them; a text stands in place of Lightning's own.
RUN = {
    "config": "",
    "run": "",
    "resume": "",
    "task": "",
    "checkpoint_steps": "",
    "xi": "",
    "devices": "",
    "ckpt_path": "a checkpoint to start from, in place of the run's own",
    "seed_everything": "of shuffles, lenses, augmentation, weights, jitter, drop path and mixing",
}
TRAINER = {
    "trainer.max_epochs": "epochs to train",
    "trainer.max_steps": "steps to train, in place of epochs; -1 is any number",
    "trainer.max_time": "time to train, as DD:HH:MM:SS",
    "trainer.accelerator": "cpu, gpu or auto",
    "trainer.precision": "32-true, bf16-mixed or 16-mixed",
    "trainer.accumulate_grad_batches": "batches of a step",
    "trainer.gradient_clip_val": "the norm that gradients are cut to; null is none",
    "trainer.limit_train_batches": "batches of an epoch, or the share of them",
    "trainer.limit_val_batches": "batches of a validation, or the share of them; 0 is none",
    "trainer.check_val_every_n_epoch": "epochs between validations",
    "trainer.log_every_n_steps": "steps between lines of the logs",
    "trainer.logger": "false writes no logs",
    "trainer.enable_progress_bar": "true or false",
}
GROUPS = {"data": "pictures and lenses", "model": "the model and its training"}
REQUIRED = ("run", "data.path")
WIDTH, COLUMN = 118, 34


def format_help(
    actions: Iterable[argparse.Action],
    formatter: argparse.HelpFormatter,
    command: str,
    whole: bool,
) -> str:
    """The help of a command, in lines of at most `WIDTH`.

    Args:
        actions: its options. formatter: an empty one, for the trainer's other options.
        whole: shows those too.
    """
    # What is linked to another option has a name that is none.
    typed = (a for a in actions if any(name.startswith("-") for name in a.option_strings))
    left = {action.dest: action for action in typed}
    lines = [f"usage: darswin {command} --run RUN [-c PRESET] --data.path PATH [options]"]

    def section(title: str, texts: dict[str, str]) -> None:
        lines.extend(("", f"{title}:"))
        for name, text in texts.items():
            if name in left:
                lines.extend(_option(left.pop(name), text))

    section("the run", RUN)
    for group, title in GROUPS.items():
        section(title, {name: "" for name in left if name.startswith(f"{group}.")})
    section("the trainer", TRAINER)
    if not whole:
        lines += ["", f"`darswin {command} {ALL}` shows all options of Lightning's trainer."]
        return "\n".join(lines) + "\n"
    formatter._width, formatter._max_help_position = WIDTH, COLUMN
    formatter.start_section("all others")
    formatter.add_arguments(list(left.values()))
    formatter.end_section()
    return "\n".join(lines) + "\n\n" + formatter.format_help()


def _option(action: argparse.Action, text: str) -> list[str]:
    """An option, what it is, and in brackets what it is by default."""
    names = ", ".join(name for name in action.option_strings if not name.endswith("+"))
    default = action.default
    if action.dest in REQUIRED:
        said = "required"
    elif isinstance(default, float):
        said = f"{default:g}"
    else:
        said = "null" if default is None else str(default).lower()
    lines = textwrap.wrap(f"{(text or str(action.help)).rstrip('.')} [{said}]", WIDTH - COLUMN)
    head = f"  {names}"
    if len(head) < COLUMN - 1:
        head = f"{head:<{COLUMN}}{lines.pop(0)}"
    return [head, *(" " * COLUMN + line for line in lines)]
