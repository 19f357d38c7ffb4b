"""Runs the code of a notebook without Jupyter, and stores what it prints and draws in it.

Run it with `.venv/bin/python docs/notebook.py examples/tour.ipynb` after each change of the
notebook. The cells run in order and in one namespace, as Jupyter runs them.
"""

import base64
import contextlib
import io
import json
import sys
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
from PIL import Image

from darswin.utils.files import replace_file

DPI = 130  # on a page of 740 px, a figure of 6 inches is as sharp as the page


def run(notebook: dict) -> dict[str, Any]:
    """Runs all code cells, fills their `outputs`, and returns their namespace."""
    scope: dict[str, Any] = {"__name__": "__main__"}
    cells = [cell for cell in notebook["cells"] if cell["cell_type"] == "code"]
    for number, cell in enumerate(cells, start=1):
        printed = io.StringIO()
        with contextlib.redirect_stdout(printed):
            exec(compile("".join(cell["source"]), f"<cell {number}>", "exec"), scope)
        cell["execution_count"] = number
        cell["outputs"] = [text_output(printed.getvalue())] if printed.getvalue() else []
        cell["outputs"] += [picture_output(plt.figure(number)) for number in plt.get_fignums()]
        plt.close("all")
    return scope


def text_output(text: str) -> dict:
    return {"output_type": "stream", "name": "stdout", "text": text.splitlines(keepends=True)}


def picture_output(figure: plt.Figure) -> dict:
    drawn, small = io.BytesIO(), io.BytesIO()
    figure.savefig(drawn, format="png", dpi=DPI)
    Image.open(drawn).convert("RGB").quantize(256).save(small, "png", optimize=True)
    data = {"image/png": base64.b64encode(small.getvalue()).decode(), "text/plain": ["a figure"]}
    return {"output_type": "display_data", "data": data, "metadata": {}}


def main(path: Path) -> None:
    notebook = json.loads(path.read_text())
    run(notebook)
    replace_file(path, json.dumps(notebook, indent=1, ensure_ascii=False) + "\n")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
