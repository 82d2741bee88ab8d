"""Cells that a live kernel executed, held against those of the notebook."""

import json
import sys
from pathlib import Path
from typing import Any

_failed: set[int] = set()  # numbers of the cells that raised or were interrupted


def shell() -> Any | None:
    """The IPython shell of this process; None outside of a notebook."""
    return sys.modules["IPython"].get_ipython() if "IPython" in sys.modules else None


def watch(shell: Any) -> None:
    """Remember from now on which cells did not run to their end; IPython's history does not say it."""
    shell.events.register("post_run_cell", _remember)  # the same function twice counts once


def _remember(result: Any) -> None:
    if not result.success:
        _failed.add(result.execution_count)


def deviation(notebook: Path) -> str:
    """How the cells executed so far differ from a notebook's from its first to this one; '' where they do not.

    What ran before the notebook's first cell (its parameters aside) counts for nothing, so that it may run twice. ''
    also where no cell is being executed, or the kernel keeps no history.
    """
    if not (here := shell()):
        return ""
    history = enumerate(here.history_manager.input_hist_raw)
    ran = [None if number in _failed else source.strip() for number, source in history if source.strip()]
    cells = [cell for cell in json.loads(notebook.read_text(encoding="utf-8"))["cells"] if cell["cell_type"] == "code"]
    sources = {n: "".join(cell["source"]).strip() for n, cell in enumerate(cells, start=1)}
    wanted = [n for n, cell in enumerate(cells, start=1) if sources[n] and "parameters" not in _tags(cell)]
    ends = [end for end, n in enumerate(wanted, start=1) if ran and sources[n] == ran[-1]]
    if not ran or any(ran[-end:] == [sources[n] for n in wanted[:end]] for end in ends):
        return ""
    if not ends:
        return f"this cell is not in {notebook.name}"
    if missing := [str(n) for n in wanted[: ends[0]] if sources[n] not in ran]:
        cells_are = f"code cells {', '.join(missing)} have" if missing[1:] else f"code cell {missing[0]} has"
        return f"{cells_are} not run to the end, or not as in {notebook.name}"
    return f"cells of {notebook.name} ran in another order, twice, or with others between"


def _tags(cell: dict[str, Any]) -> list[str]:
    return cell.get("metadata", {}).get("tags", [])
