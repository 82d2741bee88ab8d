"""Parameters of the notebooks: names, types and ranges; one schema for every way in.

``python -m tsmlib run`` checks the text that was typed, and a notebook's first cell checks the values that arrived
there. Both happen before any file exists. papermill executes every name as code, and only warns of unknown ones:
``papermill_plugin`` refuses them where they were typed, ``require_declared`` in the notebook, however they came.
A notebook's ``parameters`` cell holds the defaults; a name in it that stands here too obeys the rule here.
"""

import ast
import contextlib
import difflib
import io
import json
import math
import re
import tokenize
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias

from tsmlib import zoo

SCALES = ("smoke", "laptop", "paper")
ENVS = tuple(
    f"tsm/{arm}"
    for arm in (
        "Reacher-v0",
        "ReacherObstacle-v0",
        "ReacherPush-v1",
        "PymunkReacher-v0",
        "PymunkObstacle-v0",
        "PymunkPush-v1",
    )
)
LONGEST = 1000  # characters
MOST_SEEDS = 1000
INJECTED = (
    "# Parameters\n"  # how the cell begins that papermill puts below the one tagged parameters
)
Value: TypeAlias = bool | int | float | str
_DEVICE = re.compile(r"(cpu|cuda(:(0|[1-9][0-9]?))?)?", re.ASCII)
_CLAIM = re.compile(r"C(0[1-9]|[1-4][0-9]|5[0-4])", re.ASCII)
_RESTORE = (
    "Restore it: git checkout -- notebooks in a clone; where tsmlib is installed, install it again"
)


class ParameterError(ValueError):
    """A parameter that is unknown, of the wrong type or out of range. Raised before any file exists."""


@dataclass(frozen=True)
class Rule:
    """What a parameter may be: its type, whether a value is allowed, and both in words."""

    type: type
    words: str
    allows: Callable[[Any], bool]


def _whole(low: int, high: int) -> Rule:
    return Rule(int, f"a whole number from {low} to {high}", lambda value: low <= value <= high)


def _one_of(*known: str) -> Rule:
    return Rule(str, f"one of {', '.join(known)}, or ''", lambda value: value in ("", *known))


def _some_of(*known: str) -> Rule:
    def allows(value: str) -> bool:
        words = [word.strip(" ") for word in value.split(",")]
        return value == "all" or all(word in known or standard_arm(word) in known for word in words)

    return Rule(str, f"some of {', '.join(known)}, with commas between; or all", allows)


def standard_arm(word: str) -> str:
    """The id of the standard arm of which ``word`` is a variant, without noise and delay; '' for any other word."""
    if not word.startswith("tsm/"):
        return ""
    from tsmlib.envs.spec import EnvSpec  # and with it Gymnasium, which most calls can do without

    try:
        spec = EnvSpec.parse(word)
    except ValueError:
        return ""
    return spec.standard.id if spec == spec.arm else ""


def _is_folder(value: str) -> bool:
    path = Path(value)
    reserved = any(
        re.fullmatch(r"(?i)(con|prn|aux|nul|com\d|lpt\d)(\..*)?", part) for part in path.parts
    )  # on Windows
    return (
        not value.startswith("~")
        and ".." not in path.parts
        and value.strip() == value
        and not reserved
    )


_REACH = 0.21  # m from the shoulder, the fingertip's

SCHEMA: dict[str, Rule] = {
    "scale": _one_of(*SCALES),
    "seed": _whole(0, 2**31 - 1),
    "device": Rule(
        str,
        "cpu, cuda, or one of several as in cuda:1",
        lambda value: bool(_DEVICE.fullmatch(value)),
    ),
    "run_dir": Rule(
        str,
        "an absolute or a relative path, without '..', a leading '~', control characters or names "
        "that Windows reserves",
        _is_folder,
    ),
    "env": _some_of(*ENVS),
    "envs": _some_of(*ENVS),
    "models": _some_of(*zoo.words()),
    "model": Rule(
        str, f"{zoo.OURS} or {zoo.PAPERS}", lambda value: value in (zoo.OURS, zoo.PAPERS)
    ),
    "target_x": Rule(
        float, f"metres from -{_REACH} to {_REACH}", lambda value: abs(value) <= _REACH
    ),
    "target_y": Rule(
        float, f"metres from -{_REACH} to {_REACH}", lambda value: abs(value) <= _REACH
    ),
    "n_targets": _whole(0, 100),
    "claim": Rule(str, "one of C01 to C54", lambda value: bool(_CLAIM.fullmatch(value))),
}
PLAIN = {  # for a parameter without a rule, by the type of its default
    bool: Rule(bool, "true or false", lambda value: True),
    int: Rule(int, "a whole number of at most 18 digits", lambda value: abs(value) < 10**18),
    float: Rule(float, "a finite number", math.isfinite),
    str: Rule(str, "text on one line", lambda value: True),
}


def check(name: str, value: object, *, default: object = None, origin: str = "") -> None:
    """ParameterError naming ``origin``, the value and the range, unless parameter ``name`` may have this value."""
    rule = SCHEMA.get(name) or PLAIN.get(type(default))
    if rule is None:
        raise ParameterError(
            f"{origin or name} cannot be given from outside: edit the notebook to change it."
        )
    text = len(value) <= LONGEST and value.isprintable() if isinstance(value, str) else True
    if type(value) is not rule.type or not text or not rule.allows(value):
        raise ParameterError(f"{origin or name} is {_shown(value)}, expected {rule.words}.")


def convert(name: str, text: str, *, default: object = None) -> Value:
    """The value of parameter ``name`` that ``text`` spells; the text itself where it spells none, for ``check``."""
    rule = SCHEMA.get(name) or PLAIN.get(type(default))
    kind = rule.type if rule else str
    if kind is bool and text.lower() in ("true", "false"):
        return text.lower() == "true"
    if kind is int and re.fullmatch(r"[+-]?[0-9]{1,18}", text, re.ASCII):
        return int(text)
    if kind is float and re.fullmatch(
        r"[+-]?([0-9]+\.?[0-9]*|\.[0-9]+)([eE][+-]?[0-9]+)?", text, re.ASCII
    ):
        return float(text)
    return text


def parse_seeds(text: str) -> list[int]:
    """The seeds that a text such as ``0-9`` or ``0,2,5-7`` names, in order. ParameterError for any other text."""
    found: list[int] = []
    for part in text.split(","):
        match = re.fullmatch(r"\s*([0-9]{1,10})(?:-([0-9]{1,10}))?\s*", part, re.ASCII)
        first, last = (int(match[1]), int(match[2] or match[1])) if match else (0, -1)
        if not 0 <= last - first < MOST_SEEDS:
            raise ParameterError(
                f"--seeds is {_shown(text)}, expected such as 0-9 or 0,2,5, at most {MOST_SEEDS} seeds."
            )
        found += range(first, last + 1)
    if len(set(found)) < len(found) or len(found) > MOST_SEEDS:
        raise ParameterError(
            f"--seeds is {_shown(text)}: each seed once, and at most {MOST_SEEDS}."
        )
    for seed in found:
        check("seed", seed)
    return found


def _shown(value: object) -> str:
    shown = ascii(value)
    return shown if len(shown) <= 80 else f"{shown[:77]}..."


def declared(notebook: Path) -> dict[str, object]:
    """Name -> default of every parameter: the literals in the cell tagged ``parameters``."""
    return {name: default for name, (default, _) in _cell(notebook).items()}


def explained(notebook: Path) -> str:
    """A line for every parameter: how its default would be given to ``run``, and the comment beside it."""
    given = {
        f"--{name} {default!r}" if name in ("scale", "seed") else f"-p {name}={default!r}": comment
        for name, (default, comment) in _cell(notebook).items()
    }
    width = min(30, max(map(len, given)))
    return "\n".join(f"  {text:{width}}  {comment}".rstrip() for text, comment in given.items())


def require_known(notebook: Path, names: Iterable[str]) -> None:
    """ParameterError for a name that is none of a notebook's parameters, naming the closest and all that there are."""
    _require_among(list(declared(notebook)), names, notebook.stem)


def require_declared(cells: Sequence[str], notebook: str) -> None:
    """ParameterError for a name that papermill's own cell sets and no cell before it; cells: those executed so far.

    Cells of others that begin like papermill's are left alone: before it stands a cell that sets scale and seed.
    """
    own = [index for index, cell in enumerate(cells) if cell.startswith(INJECTED)]
    known = (
        _set_by(*(cell for cell in cells[: own[-1]] if not cell.startswith(INJECTED)))
        if own
        else []
    )
    if {"scale", "seed"} <= set(known):
        _require_among(known, _set_by(cells[own[-1]]), notebook)


def _set_by(*cells: str) -> list[str]:
    """The names that cells assign, in order; of one that is no Python none."""
    found: list[str] = []
    for cell in cells:
        with contextlib.suppress(SyntaxError, ValueError):
            nodes = [node for node in ast.walk(ast.parse(cell)) if isinstance(node, ast.Name)]
            found += [node.id for node in nodes if isinstance(node.ctx, ast.Store)]
    return found


def _require_among(known: list[str], names: Iterable[str], notebook: str) -> None:
    for name in names:
        if name not in known:
            close = difflib.get_close_matches(name, known, n=1)
            raise ParameterError(
                f"{notebook} has no parameter {_shown(name)}"
                f"{f'; the closest is {close[0]}, and' if close else ';'} it has {', '.join(known)}."
            )


def typed(notebook: Path, given: Mapping[str, str]) -> dict[str, Value]:
    """Values for a notebook's parameters from their text, to be checked. Unknown names are refused."""
    require_known(notebook, given)
    defaults = declared(notebook)
    return {name: convert(name, text, default=defaults[name]) for name, text in given.items()}


def _cell(notebook: Path) -> dict[str, tuple[object, str]]:
    """Name -> default and comment of every parameter, in order."""
    try:
        cells = json.loads(notebook.read_text(encoding="utf-8"))["cells"]
        tagged = [cell for cell in cells if "parameters" in cell["metadata"].get("tags", [])]
        sources = ["".join(cell["source"]) for cell in tagged]
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise ParameterError(f"{notebook} is not a notebook: {error!r:.200}. {_RESTORE}") from error
    if len(sources) != 1:
        raise ParameterError(
            f"{notebook.name} has {len(sources)} cells tagged 'parameters', expected one. {_RESTORE}"
        )
    found: dict[str, tuple[object, str]] = {}
    try:
        statements = ast.parse(sources[0]).body
        comments = {
            token.start[0]: token.string.lstrip("# ")
            for token in tokenize.generate_tokens(io.StringIO(sources[0]).readline)
            if token.type == tokenize.COMMENT
        }
        for statement in statements:
            match statement:
                case ast.Assign(targets=[ast.Name(id=name)], value=value):
                    pass
                case ast.AnnAssign(target=ast.Name(id=name), value=ast.expr() as value):
                    pass
                case _:
                    raise ValueError(f"line {statement.lineno} is not 'name = literal'")
            found[name] = ast.literal_eval(value), comments.get(statement.end_lineno or 0, "")
    except (ValueError, SyntaxError, TypeError, RecursionError, MemoryError) as error:
        raise ParameterError(
            f"{notebook.name}, parameters cell: {error}; expected 'name = literal' only. {_RESTORE}"
        ) from error
    return found
