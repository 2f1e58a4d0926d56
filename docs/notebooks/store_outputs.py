"""Run the notebooks and store their outputs, after a change of them or of results."""

import os
from pathlib import Path

import nbclient
import nbformat

os.environ["TACITURN_PROGRESS"] = "0"  # a bar is not a result
for path in sorted(Path(__file__).parent.glob("*.ipynb")):
    notebook = nbformat.read(path, as_version=4)
    nbclient.NotebookClient(
        notebook,
        record_timing=False,
        resources={"metadata": {"path": str(path.parent)}},
    ).execute()
    for output in [one for cell in notebook.cells for one in cell.get("outputs", [])]:
        output.get("data", {}).pop("image/svg+xml", None)  # PNG is smaller
    nbformat.write(notebook, path)
